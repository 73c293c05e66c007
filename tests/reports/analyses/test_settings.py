"""The settings of arms, against configurations and defaults that were planted."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from reports.analyses import settings
from reports.data.frame import METHOD, METHODS, Results, load
from reports.pages.build import build
from tests.reports.factory import COVERAGE, noisy, study, write
from tests.reports.hostile import Page, markdown_words

pytestmark = pytest.mark.usefixtures("quick_resampling")
DEFAULTS = {
    "iql": {"kind": "iql", "lr": 5e-4, "gamma": 0.99, "batch_size": 256, "train_freq": 64, "share": True},
    "rhmc": {
        "kind": "rhmc",
        "lr": 5e-4,
        "filter": "on",
        "train_freq": 64,
        "coordinator": {"gamma": 0.99, "batch_size": 256, "update_every": 1},
        "executor": {"gamma": 0.99, "batch_size": 256},
    },
}
NAMES = {"iql": "IQL", "rhmc": "RHMC"}
SHOWN = settings.SETTINGS


def changed(kind: str, **blocks: Any) -> dict[str, Any]:
    """The defaults of a method with changes; a block changes as far as is said."""
    found: dict[str, Any] = dict(DEFAULTS[kind])
    for name, value in blocks.items():
        found[name] = found[name] | value if isinstance(value, dict) else value
    return found


def read(folder: Path, arms: Mapping[str, Mapping[str, Any]], *, defaults: bool = True) -> Results:
    """A study whose arms have these `algo`, or whole parts of a configuration where they name any."""
    points, runs = study("mix", {arm: noisy(60) for arm in arms}, points=2)
    parts = {arm: found if {"algo", "env", "trainer"} & set(found) else {"algo": found} for arm, found in arms.items()}
    both = zip(runs["arm"], runs["config"], strict=True)
    configs = [json.dumps(json.loads(text) | dict(parts[arm])) for arm, text in both]
    kinds = [str(parts[arm]["algo"].get("kind")) for arm in runs["arm"]]
    write(folder, (points, runs.assign(config=configs, algorithm=kinds)))
    about = [dict.fromkeys(METHOD, "x") | {"kind": kind, "name": name} for kind, name in NAMES.items()]
    more = {"actions": [], "parameters": []}
    records = [one | more | ({"defaults": DEFAULTS[one["kind"]]} if defaults else {}) for one in about]
    (folder / METHODS).write_text(json.dumps(records))
    return load(folder, "quick", "mix")


def test_a_row_has_what_differs_from_the_defaults_and_the_pace(tmp_path: Path) -> None:
    arms = {
        "IQL": changed("iql", gamma=0.97),
        "RHMC": changed("rhmc", lr=1e-3, executor={"batch_size": 128}, coordinator={"update_every": 4}),
    }
    table = settings.table(read(tmp_path, arms), "mix")
    rows = table.shown.set_index("Arm")
    assert rows["Method"].to_dict() == {"IQL": "IQL", "RHMC": "RHMC"}
    assert rows.loc["IQL", SHOWN] == "gamma=0.97"
    assert rows.loc["RHMC", SHOWN] == "coordinator.update_every=4, executor.batch_size=128, lr=0.001"
    pace = rows["Rows replayed per environment step"]
    assert pace.to_dict() == {"IQL": "4", "RHMC": "executors 2, coordinator 1"}
    numbers = table.numbers.set_index("arm")
    assert (numbers.loc["IQL", "replayed"], numbers.loc["RHMC", "replayed_executors"]) == (4, 2)
    assert json.loads(numbers.loc["RHMC", "settings"])["executor.batch_size"] == 128
    assert "Task of all arms: agents=4, kind=coverage, observation=extended, preset=flat, targets=5." in table.note
    assert "Trainer of all arms: evaluations=2, steps=150000." in table.note
    assert "In all arms" not in table.note


def test_what_all_arms_share_is_said_once(tmp_path: Path) -> None:
    arms = {"a": changed("iql", lr=1e-3, gamma=0.9), "b": changed("rhmc", lr=1e-3, filter="off")}
    table = settings.table(read(tmp_path, arms), "mix")
    assert "In all arms: lr=0.001." in table.note
    assert table.shown[SHOWN].tolist() == ["gamma=0.9", "filter=off"]
    alone = settings.table(read(tmp_path / "alone", {"a": arms["a"]}), "mix")
    assert alone.shown[SHOWN].tolist() == ["gamma=0.9, lr=0.001"]


def test_a_default_is_told_where_another_arm_of_the_method_differs(tmp_path: Path) -> None:
    arms = {"full": changed("rhmc"), "no filter": changed("rhmc", filter="off"), "IQL": changed("iql")}
    table = settings.table(read(tmp_path, arms), "mix")
    assert table.shown.set_index("Arm")[SHOWN].to_dict() == {"full": "filter=on", "no filter": "filter=off", "IQL": "–"}


def test_tasks_and_budgets_that_differ_stand_in_the_rows(tmp_path: Path) -> None:
    arms = {
        f"IQL, {n} sensors": {
            "algo": changed("iql"),
            "env": COVERAGE | {"agents": n, "boxes": [[0, 1, 2, 3]] * 12},
            "trainer": {"steps": 1000 * n},
        }
        for n in (2, 4)
    }
    table = settings.table(read(tmp_path, arms), "mix")
    assert table.shown[SHOWN].tolist() == [f"env.agents={n}, trainer.steps={1000 * n}" for n in (2, 4)]
    assert "boxes=(12 values)" in table.note
    assert "Trainer" not in table.note


def test_without_defaults_everything_is_shown_and_that_is_said(tmp_path: Path) -> None:
    table = settings.table(read(tmp_path, {"IQL": changed("iql")}, defaults=False), "mix")
    assert table.shown[SHOWN].tolist() == ["batch_size=256, gamma=0.99, lr=0.0005, share=true, train_freq=64"]
    assert "Defaults of IQL are not exported" in table.note
    (tmp_path / METHODS).unlink()
    bare = settings.table(load(tmp_path, "quick"), "mix")
    assert "Defaults of iql are not exported" in bare.note


def test_true_is_not_one(tmp_path: Path) -> None:
    table = settings.table(read(tmp_path, {"IQL": changed("iql", share=1)}), "mix")
    assert table.shown[SHOWN].tolist() == ["share=1"]


@pytest.mark.parametrize(
    "algo",
    [
        {},
        {"kind": "rhmc", "executor": "x", "train_freq": 0},
        {"kind": "hitmac", "pretrain": "many", "assignment_period": 1, "coordinator": {"epochs": 2}},
        {"kind": "iql", "train_freq": 64, "batch_size": True},
        {"kind": "iql", "train_freq": 10**400, "batch_size": 1},
        {"kind": "mappo", "epochs": [5]},
        {"kind": ["x"], "epochs": None},
    ],
)
def test_settings_that_say_nothing_give_no_pace(algo: dict[str, Any], tmp_path: Path) -> None:
    assert settings.replayed({"algo": algo, "trainer": {"steps": 1}}) == {}
    assert settings.replayed({"algo": algo | {"kind": "x"}, "trainer": "x"}) == {}
    assert settings.table(read(tmp_path, {"a": algo}), "mix").shown["Rows replayed per environment step"][0] == "–"


@pytest.mark.parametrize(("pretrain", "steps"), [(0, 1000), (300, 1000), (2000, 1000)])
def test_the_levels_of_hitmac_share_the_budget(pretrain: int, steps: int) -> None:
    coordinator = {"epochs": 6}
    algo = {"kind": "hitmac", "pretrain": pretrain, "train_freq": 64, "executor": {"batch_size": 128}}
    algo |= {"coordinator": coordinator, "assignment_period": 10}
    share = min(1, pretrain / steps)
    wanted = {"executors": 2 * share, "coordinator": 0.6 * (1 - share)}
    assert settings.replayed({"algo": algo, "trainer": {"steps": steps}}) == pytest.approx(wanted)


@pytest.mark.usefixtures("unpainted")
def test_the_table_is_folded_under_its_study_and_values_are_escaped(tmp_path: Path) -> None:
    value = "<b>*x*</b>|`_y_`"
    arms = {arm: {"algo": changed("iql", lr=lr), "env": COVERAGE | {"more": value}} for arm, lr in (("a", 1), ("b", 2))}
    read(tmp_path, arms)
    build(tmp_path, tmp_path / "out", "quick")
    page = Page((tmp_path / "out" / "index.html").read_text(encoding="utf-8"))
    assert "table-settings_mix" in page.values("id")
    assert f"more={value}" in page.words
    index = markdown_words((tmp_path / "out" / "index.md").read_text(encoding="utf-8"))
    assert "(tag" not in index
    assert "Settings of the arms, study mix" in index
    assert (tmp_path / "out" / "tables" / "settings_mix.tex").exists()
