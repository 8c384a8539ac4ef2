"""The commands of the command line, in the order `cosim --help` shows them.

The module of each has `add(commands)`, which registers one sub-command and its flags, and
`work(args) -> int`, which runs it and returns the exit code. Only the module of the requested command is
imported, and its dependencies are imported inside `work`.
"""

COMMANDS = (
    "run",
    "join",
    "evaluate",
    "estimate",
    "compare",
    "replay",
    "report",
    "record",
    "metrics",
    "train",
    "fit-predictors",
    "serve",
    "bench",
    "scenarios",
    "doctor",
)
