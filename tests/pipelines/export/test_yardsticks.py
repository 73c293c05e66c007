"""Yardsticks as runs: their names, which reports and verification find them by, and what a profile plays."""

from pipelines.export.yardsticks import Evaluation, _run, evaluations
from rhmc.envs import coverage, navigation


def test_a_run_is_named_by_all_that_decides_its_score() -> None:
    one = Evaluation(coverage.Config(), ("random", "hold"), 300)
    base = _run(one, "random", "c0de", "quick")["run"]
    assert base == "2e437e9d0cbc"
    others = [
        _run(one, "hold", "c0de", "quick"),
        _run(one._replace(episodes=301), "random", "c0de", "quick"),
        _run(one._replace(seed=1), "random", "c0de", "quick"),
        _run(one._replace(env=coverage.Config(agents=3)), "random", "c0de", "quick"),
        _run(one._replace(env=navigation.Config()), "random", "c0de", "quick"),
    ]
    assert len({base, *(other["run"] for other in others)}) == 6
    assert _run(one, "random", "0ther", "paper")["run"] == base, "the score is the same"


def test_what_a_profile_plays() -> None:
    for profile, most, slow in (("quick", 300, 60), ("paper", 1000, 300)):
        found = evaluations(profile)
        assert {(one.episodes, one.seed) for one in found if "planner" in one.policies} == {(slow, 0)}
        assert {(one.episodes, one.seed) for one in found if "planner" not in one.policies} == {(most, 0)}
        sizes = [(getattr(one.env, "preset", ""), one.env.agents * getattr(one.env, "targets", 1)) for one in found]
        assert sizes[:2] == [("coordinator", 20)] * 2
        assert [size for preset, size in sizes if preset == "flat"][:9] == [30, 28, 25, 24, 20, 16, 15, 12, 10]
