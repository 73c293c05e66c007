"""Optuna's plots of a search: how the best value grew, and which settings it hung on."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.trial import TrialState

from pipelines.workspace.work_folder import StoreError
from reports.render import glyphs

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from optuna.visualization import matplotlib as drawn

DRAWN: dict[str, tuple[Callable[..., Any], int]] = {  # what draws it, and the finished trials that it needs
    "history": (drawn.plot_optimization_history, 1),
    "importance": (drawn.plot_param_importances, 2),
}


def plots(study: optuna.Study, title: str, stem: Path) -> list[Path]:
    """Write `<stem>.history.png` and `<stem>.importance.png`, as far as there are trials for them.

    Importance (PED-ANOVA) says how much the values found depend on each setting within the space that was searched.

    Raises:
        StoreError: the folder cannot be written to.
    """
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    wanted = {name: draw for name, (draw, needed) in DRAWN.items() if len(done) >= needed}
    if len({trial.value for trial in done}) < 2:
        wanted.pop("importance", None)  # nothing to explain
    files = []
    with warnings.catch_warnings(), matplotlib.rc_context(glyphs.settings()):  # Optuna sets a style for everyone
        warnings.simplefilter("ignore", ExperimentalWarning)
        for name, draw in wanted.items():
            axes = draw(study)
            axes.set_title("", loc="left")
            axes.set_title(title)
            files.append(stem.with_name(f"{stem.name}.{name}.png"))
            _save(axes.figure, files[-1])
    return files


def _save(figure: Any, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        glyphs.settle(figure)
        figure.savefig(path, dpi=120, bbox_inches="tight")
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        plt.close(figure)
