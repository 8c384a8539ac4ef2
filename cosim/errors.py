"""The whole error tree: every failure a user can meet is one of these, with one clear sentence.

    CosimError                      4   what cosim cannot go on with (results that cannot be written, ...)
    |-- BadInput                    2   the user's input: file, field and value are named
    |   `-- WeightsMismatch         2   a checkpoint that does not fit its network
    |-- SimulationError             3   SUMO failed
    |   |-- SimulationInUse         3   a second simulation in one process
    |   |-- SimulationEnded         3   another program ended the simulation (docs/guides/traci.md)
    |   `-- SimulationCrashed       3   the process that ran SUMO ended
    |       `-- SimulationTimeout   3   ... or did not answer and was killed
    `-- ReplayDiffers               1   `cosim replay`: not the recorded episode (cosim.report.replay.episode)

The number is `exit_code`, which the command line returns; success is 0, and a gate that fails is 1.
"""

import contextlib
import difflib
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

LISTED = 16  # known names at most that an error lists


class CosimError(Exception):
    """Base of every error cosim raises on purpose; `exit_code` is what the command line returns."""

    exit_code = 4


class BadInput(CosimError):
    """The user's input is wrong: names the file, the field and the value where they are known.

    `BadInput("missing net file", file="a.sumocfg", field="net-file", value="x.net.xml")` reads
    `a.sumocfg: net-file='x.net.xml': missing net file`.
    """

    exit_code = 2

    def __init__(
        self,
        problem: str,
        *,
        file: object = None,
        field: str | None = None,
        value: object = None,
    ) -> None:
        self.problem = problem
        self.file = None if file is None else str(file)
        self.field = field
        self.value = value
        where = [] if self.file is None else [self.file]
        if field is not None:
            where.append(field if value is None else f"{field}={value!r}")
        elif value is not None:
            where.append(repr(value))
        super().__init__(": ".join([*where, problem]))

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_bad_input, (self.problem, self.file, self.field, self.value)


def _rebuild_bad_input(problem: str, file: object, field: str | None, value: object) -> BadInput:
    return BadInput(problem, file=file, field=field, value=value)


class SimulationError(CosimError):
    """SUMO failed while running: carries SUMO's own words, taken from its stderr."""

    exit_code = 3


class SimulationCrashed(SimulationError):
    """The worker process that ran the simulation ended (signal, limit) or did not answer in time.

    `exitcode` is the process's (negative: the signal that killed it; None: not known), `stderr` the end of
    what it wrote there.
    """

    def __init__(self, problem: str, *, exitcode: int | None = None, stderr: str = "") -> None:
        super().__init__(problem)
        self.exitcode = exitcode
        self.stderr = stderr


class SimulationTimeout(SimulationCrashed):
    """The worker process gave no heartbeat for too long and was killed."""


class SimulationInUse(SimulationError):
    """A second simulation was started in this process: libsumo would silently replace the first."""


class SimulationEnded(SimulationError):
    """Another client ended a shared simulation; what was driven until then counts."""


class WeightsMismatch(BadInput):
    """A checkpoint's layout (names, shapes, hash) is not the one that the network needs."""


@contextlib.contextmanager
def extra(name: str, *, field: str, value: object = None) -> Iterator[None]:
    """Around imports of what the extra `name` of this distribution installs.

    Raises BadInput with the command that installs it: a module is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        problem = f"needs the package {error.name}: pip install 'cosim-sumo[{name}]'"
        raise BadInput(problem, field=field, value=value) from None


@contextlib.contextmanager
def inside(place: str, file: object = None) -> Iterator[None]:
    """Name in a BadInput of the block the field `place` that its own field is part of, and the `file`."""
    try:
        yield
    except BadInput as error:
        parts = [part for part in (place, error.field) if part]
        field = ".".join(parts).replace(".[", "[")
        raise BadInput(
            error.problem, file=file or error.file, field=field or None, value=error.value
        ) from None


@dataclass(frozen=True, slots=True)
class Range:
    """The bounds of a finite number."""

    low: float = -math.inf
    above: bool = False  # strictly more than `low`
    high: float = math.inf

    def problem(self, number: float) -> str | None:
        """What is wrong with `number`; None when nothing is."""
        if not math.isfinite(number):
            return "must be finite"
        if number < self.low or (self.above and number == self.low):
            return f"must be {'more than' if self.above else 'at least'} {self.low:g}"
        return f"must be at most {self.high:g}" if number > self.high else None


def in_range(config: object, *, positive: str = "", not_negative: str = "", share: str = "") -> None:
    """Refuse a configuration whose fields of these names (with spaces between) are out of range; a share is
    from 0 to 1.

    Raises BadInput naming the field and the value.
    """
    for name in f"{positive} {not_negative}".split():
        value, zero = getattr(config, name), name in not_negative.split()
        if value < 0 or (value == 0 and not zero):
            problem = "must be 0 or more" if zero else "must be above 0"
            raise BadInput(problem, field=name, value=value)
    for name in share.split():
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise BadInput("must be a share from 0 to 1", field=name, value=getattr(config, name))


def hint(name: str, known: Iterable[str]) -> str:
    """ ", did you mean 'x'?" for the known name nearest to `name`; all of few when nothing is near."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f", did you mean {close[0]!r}?"
    return f", there are: {', '.join(names)}" if 0 < len(names) <= LISTED else ""


def one_of(value: str, allowed: Iterable[str], field: str, file: object = None) -> str:
    """`value` if it is one of the words `allowed`; raises BadInput with the nearest one."""
    words = tuple(allowed)
    if value not in words:
        raise BadInput(f"unknown{hint(value, words)}", file=file, field=field, value=value)
    return value


def check_pattern(pattern: str, field: str, file: object = None) -> str:
    """`pattern`; raises BadInput unless it is a regular expression."""
    try:
        re.compile(pattern)
    except re.error as error:
        raise BadInput(f"not a regular expression: {error}", file=file, field=field, value=pattern) from None
    return pattern
