"""The documentation as a site, by Sphinx: the repository's pages where they lie, and a reference made from the code.

The sources are the whole repository, so links are those that one sees there. `make docs` writes `build/site`. With the
tag `pages` the reference of modules is left out, which takes most of the time.
"""

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from pipelines.cli.reference import write_reference  # noqa: E402

REFERENCE = "build/reference"  # pages that are made, inside the sources
RESULTS = "results/paper"

project, author, html_title = "rhmc", "the rhmc contributors", "rhmc"
root_doc = "README"
whole = not tags.has("pages")  # type: ignore[name-defined]  # noqa: F821  # Sphinx gives this module its tags
extensions = ["myst_parser", "sphinx.ext.napoleon", *(["autoapi.extension"] if whole else [])]
include_patterns = ["*.md", "docs/*.md", "benchmarks/README.md", "examples/*/README.md", f"{REFERENCE}/**"]
include_patterns += [f"{RESULTS}/*.md", f"{RESULTS}/tables/*.md", f"{RESULTS}/measured/*.md"]
exclude_patterns = [".*", "work", "tests", "studies", "rhmc", "pipelines", "reports", "build/site", "build/doctrees"]
html_theme = "furo"
html_theme_options = {"sidebar_hide_name": False}
html_show_sphinx = False
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header", "autoapi.python_import_resolution", "toc.not_included", "toc.excluded"]
suppress_warnings += ["misc.highlighting_failure"]  # Mermaid stays text: its script would come from the network
autoapi_dirs = [str(ROOT / "rhmc")]  # what a method or a task of one's own builds on
autoapi_root = f"{REFERENCE}/modules"
autoapi_options = ["members", "show-module-summary"]
autoapi_member_order = "bysource"
autoapi_add_toctree_entry = False
autoapi_keep_files = True

CONTENTS = {
    "Tutorials": [
        "docs/reproduce",
        "docs/walkthrough",
        "docs/search",
        "docs/extending",
        "examples/hungarian/README",
        "examples/warehouse/README",
        "docs/pettingzoo",
        "docs/scaling",
    ],
    "Concepts": [
        *(
            "docs/reproducibility",
            "docs/readings",
            "docs/report",
            "docs/deviations",
            "docs/theorem1",
            "docs/faults",
            "SECURITY",
        ),
        "docs/overhead",
    ],
    "Results": ["docs/learning", f"{RESULTS}/index", "docs/speed"],
    "Reference": ["docs/cli", f"{REFERENCE}/verbs", "docs/ui", "docs/dvc", f"{REFERENCE}/settings"],
    "Project": ["docs/architecture", "CONTRIBUTING", "CHANGELOG", "benchmarks/README"],
}

if whole:
    CONTENTS["Reference"].append(f"{REFERENCE}/modules/rhmc/index")


def contents(app: Any, page: str, source: list[str]) -> None:
    """Put the table of contents, which the sidebar shows, behind the first page."""
    if page == root_doc:
        parts = [
            f":::{{toctree}}\n:hidden:\n:caption: {name}\n\n" + "\n".join(pages) for name, pages in CONTENTS.items()
        ]
        source[0] += "\n" + "".join(f"\n{part}\n:::\n" for part in parts)


def setup(app: Any) -> None:
    """Make the reference, then read."""
    write_reference(ROOT / REFERENCE)
    app.connect("source-read", contents)
