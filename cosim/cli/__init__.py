"""The verbs of the command line, in the order `cosim --help` shows them.

The module of each has `add(verbs)`, which registers one sub-command and its flags, and `work(args) -> int`,
which does it and returns the exit code. Only the module of the verb that was asked for is imported, and what
a verb needs is imported inside `work`.
"""

VERBS = (
    "run",
    "evaluate",
    "compare",
    "replay",
    "report",
    "record",
    "metrics",
    "train",
    "fit-predictors",
    "bench",
    "scenarios",
    "doctor",
)
