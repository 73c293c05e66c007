"""The columns of the exported tables and their types: the exporter writes by them, the reports check by them."""

import pyarrow as pa

WORDS, WHOLE, NUMBER = pa.string(), pa.int64(), pa.float64()
VERSION = {
    "rhmc.tables": "2"
}  # of the names in the tables of runs and trials; the report sets tables of an older one aside

TASKS = ".tasks.json"  # after a study's name: what its tasks of other packages say of themselves

PLACE = pa.schema([("study", WORDS), ("arm", WORDS), ("seed", WHOLE), ("run", WORDS)])  # run: spec id
METRICS = pa.schema([*PLACE, ("step", WHOLE), ("metric", WORDS), ("value", NUMBER)])
RUNS = pa.schema(  # the planned runs: nothing here depends on commit, machine or time
    [
        *PLACE,
        ("status", WORDS),  # finished, failed, partial or missing
        ("algorithm", WORDS),
        ("task", WORDS),
        ("profile", WORDS),
        ("config", WORDS),  # the spec as canonical JSON
        ("fingerprint", WORDS),  # code id
        ("question", WORDS),
    ],
    metadata=VERSION,
)
MADE = pa.schema(  # the runs that are there: how and where each was made
    [
        *PLACE,
        ("commit", WORDS),
        ("seconds", NUMBER),  # of processor time, spent training
        ("machine", WORDS),
        ("versions", WORDS),
        ("adopted", WORDS),  # from which code, where older code made it
    ]
)
READINGS = pa.schema(  # the level of each factor, of every arm of a study with readings
    [
        ("study", WORDS),
        ("arm", WORDS),
        ("contrast", WORDS),  # the arm as the study's file has it
        ("reading", WORDS),
        ("factor", WORDS),
        ("place", WHOLE),  # of the factor among the factors, from 0
        ("level", WORDS),
        ("number", WHOLE),  # of the level in its factor, from 0
    ]
)
TRIALS = pa.schema(  # the budget of a search: like runs, nothing depends on commit, machine or time
    [
        ("search", WORDS),
        ("arm", WORDS),
        ("trial", WHOLE),  # in the budget of its arm, from 0
        ("state", WORDS),  # complete, pruned, failed, partial or missing
        ("value", NUMBER),  # mean final return over the seeds; NaN unless complete
        ("steps", WHOLE),  # environment steps of each seed, to the last finite point of the curve
        ("seeds", WHOLE),  # that a trial trains
        ("params", WORDS),  # what was tried, as canonical JSON
        ("algorithm", WORDS),
        ("task", WORDS),
        ("profile", WORDS),
        ("config", WORDS),  # the setting as canonical JSON; the file's own where nothing was tried yet
        ("fingerprint", WORDS),  # code id
        ("question", WORDS),
    ],
    metadata=VERSION,
)
TRANSFER = pa.schema(  # trained policies with other numbers of agents and targets
    [
        *PLACE,
        ("task", WORDS),  # kind and preset
        ("agents", WHOLE),
        ("targets", WHOLE),
        ("trained_agents", WHOLE),
        ("trained_targets", WHOLE),
        ("episodes", WHOLE),
        ("value", NUMBER),  # mean return
        ("sem", NUMBER),  # its standard error over episodes
    ]
)
