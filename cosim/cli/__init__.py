"""The verbs of the command line, in the order `cosim --help` shows them.

Each module has `add(verbs)`, which registers one sub-command and its flags, and `work(args) -> int`, which
does it and returns the exit code. What a verb needs is imported inside `work`: `cosim --help` stays quick.
"""

from __future__ import annotations

from cosim.cli import (
    bench,
    compare,
    doctor,
    evaluate,
    fit_predictors,
    metrics,
    record,
    replay,
    report,
    run,
    scenarios,
    train,
)

VERBS = (
    run,
    evaluate,
    compare,
    replay,
    report,
    record,
    metrics,
    train,
    fit_predictors,
    bench,
    scenarios,
    doctor,
)
