"""The tables of a report by the names of their files; those with nothing to show are left out."""

from reports.analyses import alpha, beyond, comparison, readings, scaling, searches, settings
from reports.data.escaping import stem
from reports.data.frame import Results
from reports.data.paper import Paper
from reports.render import tables
from reports.render.tables import Table

KINDS = (  # of tables of a study
    *("effects", "factors", "readings", "mechanism"),
    *("final", "pairs", "efficiency", "time", "assignments", "steadiness", "agents", "settings"),
)
LAST = ("provenance", "runs", "made")  # tables with a part of their own at the end


def whole(results: Results, paper: Paper) -> dict[str, Table]:
    """Tables by file name; those with nothing to show are left out."""
    made = {"table_1": tables.table_1(results)} if results.methods else {}
    made |= {"table_2": tables.table_2(results, paper)} if results.arms("ablation") else {}
    for study in results.studies:
        made |= of_study(results, study)
    for search in results.searches:
        made |= of_search(results, search)
    made |= {"yardsticks": tables.yardsticks(results)} if results.yardsticks else {}
    every = {
        "numbers": beyond.table_numbers(results),
        "transfer": beyond.table_transfer(results),
        "encoder": beyond.table_encoder(results),
        "theorem": tables.theorem(results),
    }
    made |= {name: table for name, table in every.items() if table}
    return made | last(results)


def last(results: Results) -> dict[str, Table]:
    return {"provenance": tables.provenance(results), "runs": tables.runs(results), "made": tables.made(results)}


def of_study(results: Results, study: str) -> dict[str, Table]:
    """The tables that a study has. One with readings has too many arms for those that compare each pair."""
    if results.has_readings(study):
        made = readings.tables(results, study) | {"final": tables.finals(results, study)}
        return {f"{name}_{stem(study)}": table for name, table in made.items()}
    found = scaling.sweep(results, study)
    steadiness = tables.steadiness(results, study)
    every: dict[str, Table | None] = {
        "effects": alpha.table_effects(results, study) if alpha.is_of(study) else None,
        "mechanism": alpha.table_mechanism(results, study) if alpha.is_of(study) else None,
        "final": tables.finals(results, study),
        "pairs": comparison.pairs_table(results, study),
        "efficiency": comparison.efficiency(results, study),
        "time": comparison.time_to_level(results, study),
        "assignments": beyond.table_assignments(results, study),
        "steadiness": steadiness if len(steadiness.shown) else None,
        "agents": scaling.table(results, found) if found else None,
        "settings": settings.table(results, study),
    }
    return {f"{name}_{stem(study)}": table for name, table in every.items() if table}


def of_search(results: Results, search: str) -> dict[str, Table]:
    return {winners(search): searches.table_winners(results, search)}


def winners(search: str) -> str:
    """The name of a search's table."""
    return f"winners_{stem(search)}"
