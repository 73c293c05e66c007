"""The page in a real browser: it opens without a word on the console, sorts, and its links lead somewhere.

A script that is added to a copy of the page clicks and looks; what it found stands in the page that comes back.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest

from reports.data.paper import read

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(
    BROWSER is None, reason=f"no browser here: none of {', '.join(BROWSERS)} is on the path"
)

PROBE = """
<script>
const column = (id, n) => [...document.querySelectorAll(`#${id} tbody tr`)].map((row) => row.cells[n].textContent);
const click = (id, n) => document.querySelectorAll(`#${id} th button`)[n].click();
const found = {before: column("table-final_ablation", 1)};
click("table-final_ablation", 1);
found.up = column("table-final_ablation", 1);
found.said = document.getElementById("said").textContent;
found.state = [...document.querySelectorAll("#table-final_ablation th")].map((head) => head.getAttribute("aria-sort"));
click("table-final_ablation", 1);
found.down = column("table-final_ablation", 1);
click("table-final_reach", 1);
found.reach = column("table-final_reach", 1);
const field = document.querySelector("#table-runs").parentElement.previousElementSibling.querySelector("input");
const seen = () => [...document.querySelectorAll("#table-runs tbody tr")].filter((row) => !row.hidden);
const type = (text) => { field.value = text; field.dispatchEvent(new Event("input")); };
found.rows_of = {all: seen().length};
type("REGULATION  finished");
found.rows_of.some = seen().length;
found.rows_of.right = seen().every((row) => row.textContent.includes("no regulation"));
found.rows_of.said = document.getElementById("said").textContent;
type("");
found.rows_of.again = seen().length;
found.fields = document.querySelectorAll("input[type=search]").length;
const chart = document.querySelector("#fig_10 .chart"), value = (key) => button(key).querySelector("b").textContent;
const button = (key) => [...chart.querySelectorAll(".names button")].find((one) => one.dataset.key === key);
const line = (key) => [...chart.querySelectorAll("g[data-key]")].find((one) => one.dataset.key === key);
const drawn = (key) => line(key).getBoundingClientRect().width;
const press = (words) => [...chart.querySelectorAll(".bar button")].find((one) => one.textContent === words).click();
const read = (share) => {
  const slide = chart.querySelector("input");
  slide.value = share * slide.max;
  slide.dispatchEvent(new Event("input"));
  const said = slide.getAttribute("aria-valuetext");
  return [chart.querySelector("output").textContent, value("full"), value("random"), said];
};
const pressed = (key) => button(key).getAttribute("aria-pressed");
found.chart = {still: value("full"), whole: drawn("full"), half: read(0.5), end: read(1), first: read(0)};
button("full").click();
found.chart.off = [pressed("full"), drawn("full"), pressed("no filter")];
press("Show all");
found.chart.on = [pressed("full"), drawn("full")];
const wide = (one) => one.getBoundingClientRect().width;
const seeds = () => [...line("full").querySelectorAll(".seed")].filter(wide).length;
found.chart.seeds = [seeds(), (press("Every seed"), seeds())];
press("Processor time");
const tick = getComputedStyle(chart.querySelector(".xs .step"));
found.chart.timed = [drawn("full"), drawn("no filter"), read(0.5)[0], read(1)[1], tick.display];
press("Steps");
found.chart.again = [drawn("full"), value("full")];
chart.querySelector(".area").dispatchEvent(new PointerEvent("pointermove", {clientX: 0}));
found.chart.hover = value("full");
chart.querySelector(".area").dispatchEvent(new PointerEvent("pointerleave"));
found.chart.left = value("full");
const named = [...document.querySelectorAll("svg[role=img]")].map((one) => one.getAttribute("aria-label").length);
found.named = named.filter((letters) => letters < 20).length;
const link = document.querySelector("#table-final_ablation tbody a").getAttribute("href");
found.link = [document.getElementById(link.slice(1)).textContent.trim()];
const links = [...document.querySelectorAll("a[href]")].map((link) => link.getAttribute("href"));
found.lost = links.filter((href) => href.startsWith("#") && !document.getElementById(href.slice(1)));
found.files = links.filter((href) => !href.startsWith("#"));
found.blank = [...document.images].filter((image) => !image.naturalWidth).length;
found.unnamed = [...document.images].filter((image) => image.alt.length < 20).length;
found.images = document.images.length;
const rows = [...document.querySelectorAll(".forest li a")].map((row) => row.getBoundingClientRect());
found.rows = {count: rows.length, end: rows.at(-1).bottom, least: Math.min(...rows.map((row) => row.height))};
found.spoken = [...document.querySelectorAll(".forest li a .sr")].filter((one) => one.textContent.length < 30).length;
const letters = (image) => 6.5 / 72 * 160 * image.getBoundingClientRect().width / image.getAttribute("width");
const plates = [...document.images].filter((image) => image.getBoundingClientRect().width && image.src.includes("svg"));
found.letters = Math.min(...plates.map(letters));
document.querySelector(".forest li a").focus({focusVisible: true});
found.ring = getComputedStyle(document.activeElement).outlineStyle;
found.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
const run = document.querySelector("#C8a a[href^='#run-']").getAttribute("href");
found.folded = !document.querySelector(run).closest("details").open;
location.hash = run;
setTimeout(() => {
  found.unfolded = document.querySelector(run).closest("details").open;
  location.hash = link;
}, 200);
setTimeout(() => {
  found.link.push(line("full").classList.contains("on"));
  document.title = "FOUND" + JSON.stringify(found) + "END";
}, 400);
</script>
"""


class Seen(NamedTuple):
    """The findings of the probe, and the console's text."""

    found: dict[str, Any]
    console: list[str]


def visit(page: Path, size: str = "1280,900", scheme: str = "light") -> Seen:
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += [f"--window-size={size}", "--virtual-time-budget=4000", f"--user-data-dir={page.parent / 'profile'}"]
    command += ["--force-dark-mode"] if scheme == "dark" else []
    done = subprocess.run([*command, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]
    match = re.search(r"<title>FOUND(.*?)END</title>", done.stdout, re.DOTALL)
    assert match, done.stderr[-500:]
    found = json.loads(match[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    return Seen(found, [line for line in done.stderr.splitlines() if "CONSOLE" in line])


def copy(made: Path, folder: Path, more: str = "") -> Path:
    page = folder / "index.html"
    page.write_text((made / "index.html").read_text().replace("</body>", f"{PROBE}{more}</body>"))
    return page


def test_it_opens_sorts_and_leads_on(made: Path, tmp_path: Path) -> None:
    found, console = visit(copy(made, tmp_path))
    assert console == []
    assert found["before"] == ["70.0 (69.0 to 71.0)", "64.0 (63.0 to 65.0)", "60.0 (59.0 to 61.0)"]
    assert found["up"] == found["before"][::-1]
    assert found["down"] == found["before"]
    assert found["state"] == [None, "ascending", None, None, None]
    assert found["said"].startswith("Final results of study ablation sorted by Final return")
    assert found["reach"] == ["63.0 (62.0 to 64.0)", "68.0"]
    rows = found["rows_of"]
    assert (rows["some"], rows["right"], rows["again"]) == (3, True, rows["all"])
    assert rows["said"] == f"3 of {rows['all']} rows"
    assert 1 <= found["fields"] < 5  # long tables alone
    assert found["lost"] == []
    assert len(found["files"]) > 20
    paper = f"https://doi.org/{read().source.doi}"
    assert [name for name in found["files"] if not (made / name).exists()] == [paper]
    assert (found["blank"], found["unnamed"]) == (0, 0)
    assert found["images"] > 8
    assert found["named"] == 0
    assert found["link"] == ["full 70.0", True]  # a row leads to its curve, which then stands out
    assert (found["rows"]["count"], found["spoken"], found["ring"]) == (23, 0, "solid")
    assert found["folded"]
    assert found["unfolded"]


def test_a_chart_is_chosen_from_read_and_stretched(made: Path, tmp_path: Path) -> None:
    chart = visit(copy(made, tmp_path)).found["chart"]
    rows = pd.read_csv(made / "figures" / "fig_10.csv").set_index(["name", "step"])
    values = [f"{rows[column]['full', 0]:.2f}" for column in ("value", "low", "high")]
    first = "{} ({} to {})".format(*values)
    assert chart["still"] == chart["left"] == "70.0"  # the final return
    assert chart["half"] == ["at 75 k steps: mean (interval)", "70.00 (69.00 to 71.00)", "30.4", "at 75 k steps"]
    assert chart["first"][:2] == ["at 0 steps: mean (interval)", first]
    assert (chart["end"][0], chart["hover"]) == ("at 150 k steps: mean (interval)", first)
    whole = chart["whole"]
    assert whole > 300
    assert (chart["off"], chart["on"]) == (["false", 0, "true"], ["true", whole])
    assert chart["seeds"] == [0, 3]
    assert chart["timed"] == [  # the other arm takes twice as long
        *(pytest.approx(whole / 2), whole, "after 1.5 s: mean (interval)", "–", "none")
    ]
    assert chart["again"] == [whole, "70.0"]


@pytest.mark.parametrize(("size", "scheme"), [("500,900", "light"), ("1280,900", "dark")])
def test_nothing_reaches_out_of_a_narrow_or_dark_page(made: Path, tmp_path: Path, size: str, scheme: str) -> None:
    found, console = visit(copy(made, tmp_path), size, scheme)
    assert found["wide"] <= 0
    assert found["letters"] >= 9
    assert found["rows"]["least"] >= 22
    assert found["rows"]["end"] <= 800  # the first screen has the whole answer
    assert console == []


def test_an_error_on_the_console_would_be_seen(made: Path, tmp_path: Path) -> None:
    assert "nowhere" in visit(copy(made, tmp_path, "<script>console.error('nowhere')</script>")).console[0]
