"""Pages of the reference that are made from the code: every verb with its options, every setting of every kind."""

from pathlib import Path
from typing import Any

import typer
from typer.cli import get_docs_for_click
from typer.main import get_command

from pipelines.cli.main import app
from pipelines.specs.fields import described
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.training import trainer


def write_reference(folder: Path) -> None:
    """Write `verbs.md` and `settings.md`, where they differ from what is there."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in {"verbs": verbs_page(), "settings": settings_page()}.items():
        page = folder / f"{name}.md"
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def verbs_page() -> str:
    """Every verb with its options, as its own help has them, as Markdown."""
    command = get_command(app)
    return get_docs_for_click(obj=command, ctx=typer.Context(command), name="rhmc", title="Every verb")


def settings_page() -> str:
    """Every setting of every method, of every task and of the trainer, as Markdown."""
    parts = ["# Settings", "What a study may write under `algo`, `env` and `trainer`."]
    for kind, method in ALGORITHMS.items():
        parts += [f"## {method.about.name}", f"`algo: {{kind: {kind}}}`. {method.about.source}.", _table(method.config)]
    for kind, task in ENVS.items():
        parts += [f"## Task {kind}", f"`env: {{kind: {kind}}}`.", _table(task.config)]
    return "\n\n".join([*parts, "## Trainer", "`trainer`.", _table(trainer.Config)]) + "\n"


def _table(model: Any) -> str:
    rows = [[cell.replace("|", "\\|") for cell in row] for row in described(model)]
    lines = [["setting", "allowed", "default", "meaning"], ["---"] * 4, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
