"""Reads a .sumocfg and the SUMO options of the command line, and keeps those that change the traffic.

A user's configuration is never passed to SUMO unchanged: its outputs could write anywhere, and its
`remote-port` would wait for ever (docs/reference/sumo.md).
"""

import difflib
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.errors import BadInput
from cosim.files.xml_input import is_there, regular_file, scan

# SUMO's own synonyms (sumo --help).
_SYNONYMS = {
    "c": "configuration-file",
    "configuration": "configuration-file",
    "n": "net-file",
    "net": "net-file",
    "r": "route-files",
    "routes": "route-files",
    "a": "additional-files",
    "additional": "additional-files",
    "w": "weight-files",
    "weights": "weight-files",
    "b": "begin",
    "e": "end",
    "v": "verbose",
    "X": "xml-validation",
    "W": "no-warnings",
    "l": "log",
    "s": "seed",
    "srand": "seed",
    "h": "help",
    "V": "version",
    "C": "save-configuration",
    "save-config": "save-configuration",
}
# SUMO accepts any root element; these indicate a file of another kind, given by mistake.
OTHER_ROOTS = frozenset(
    {"net", "nodes", "edges", "connections", "types", "routes", "trips", "additional", "add"}
)
INPUTS = ("net-file", "route-files", "additional-files")
CLOCK = ("begin", "end", "step-length")
SAME_WORD = 0.75  # similarity to one of these names; at most 0.7 for SUMO's other options
# Options with a list of input files, relative to the configuration's folder.
FILE_OPTIONS = frozenset(
    {
        "weight-files",
        "load-state",
        "astar.all-distances",
        "astar.landmark-distances",
        "device.fcd-replay.files",
    }
)
# All options of SUMO's topics `processing`, `routing` and `emissions`, and of devices that affect driving or
# tripinfo; not of devices that only write their own file (ssm, fcd, btreceiver).
_KEPT = re.compile(
    r"""weight-(files|attribute) | load-state(\..+)? | junction-taz | step-method\.ballistic
    | extrapolate-departpos | route-steps | no-internal-links
    | ignore-(junction-blocker|route-errors|accidents)
    | step-length | lateral-resolution
    | collision\.(action|stoptime|check-junctions|check-junctions\.mingap|mingap-factor)
    | intermodal-collision\.(action|stoptime) | keep-after-arrival | max-num-(vehicles|persons|teleports)
    | scale | scale-suffix | time-to-(teleport|impatience)(\..+)? | waiting-time-memory
    | startup-wait-threshold | max-depart-delay | (sloppy|eager|emergency)-insert | insertion-checks
    | random-depart-offset | lanechange\.(duration|overtake-right)
    | (tls|railsignal|default|overhead-wire|pedestrian|ride|mapmatch|weights|persontrip|railway|astar)\..+
    | railsignal-moving-block | slope-centered | emergencydecel\.warning-threshold | parking\.maneuver
    | use-stop-(ended|started) | routing-algorithm | replay-rerouting
    | emissions\..+ | phemlight-(year|temperature)
    | (person-)?device\.(rerouting|toc|driverstate|bluelight|taxi|glosa|friction|stationfinder|battery
        |elechybrid|fcd-replay|emissions|tripinfo|vehroute)\..+""",
    re.VERBOSE,
)
_NEVER_KEPT = re.compile(
    r".+[.-](output|file)|.*output.*|tls\.actuated\.show-detectors|.*\.wkt|.*jupedsim\.py"
)
# Refused options of the command line, with the reason (docs/reference/sumo.md).
_REFUSED = {
    "configuration-file": "name the .sumocfg in place of a scenario",
    "seed": "use cosim's own --seed",
    "random": "an episode is repeatable by its --seed; SUMO's --random is not",
    "remote-port": "cosim steps the simulation itself; other clients cannot connect",
    "num-clients": "cosim steps the simulation itself; other clients cannot connect",
    "save-configuration": "SUMO would write its options and stop",
    "save-template": "SUMO would write its options and stop",
    "save-schema": "SUMO would write its schema and stop",
    "help": "SUMO would print its help and stop",
    "version": "use `cosim doctor`",
    "mesosim": "the mesoscopic model has no vehicle positions",
    "lateral-resolution": "say it in a .sumocfg: AVs change lanes by LC2013, which has no sublane model",
}
# Reasons for ignored options of a .sumocfg that are not obvious.
_SET_ASIDE = {
    "seed": " (the episode's --seed decides)",
    "random": " (the episode's --seed decides)",
}


@dataclass(frozen=True, slots=True)
class SumoConfig:
    """A parsed .sumocfg with absolute paths. Times in s; None: not set in the file."""

    path: Path
    net: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...]
    begin: float
    end: float | None
    options: tuple[tuple[str, str], ...]  # kept, since they change the traffic
    ignored: tuple[str, ...]  # "name=value", with the reason if there is one


def read(path: Path, replaced: Collection[str] = ()) -> SumoConfig:
    """The configuration `path`, with relative paths resolved against its folder.

    `replaced`: names of `INPUTS` given elsewhere; the file's own values are not checked.

    Raises:
        BadInput: the file is missing or malformed, names no net, or names missing files.
    """
    path = path.absolute()
    unread = {*INPUTS} & {*replaced}
    values = {name: value for name, value in _values(path).items() if name not in unread}
    folder = path.parent
    net = files(values.get("net-file", ""), folder, path, "net-file")
    if len(net) != 1 and "net-file" not in replaced:
        raise BadInput("one net is needed", file=path, field="net-file", value=values.get("net-file", ""))
    kept, ignored = [], []
    for name, value in values.items():
        if name in (*INPUTS, "begin", "end"):
            continue
        if name == "mesosim" and boolean(value):
            raise BadInput(_REFUSED["mesosim"], file=path, field=name, value=value)
        _check_finite(value, path, name)
        if name == "lateral-resolution" and _off(value, path):
            continue
        if not keeps(name):
            if near := difflib.get_close_matches(name, (*INPUTS, *CLOCK), 1, SAME_WORD):
                problem = f"SUMO has no such option, did you mean {near[0]!r}?"
                raise BadInput(problem, file=path, field=name, value=value)
            ignored.append(f"{name}={value}{_SET_ASIDE.get(name, '')}")
        elif name in FILE_OPTIONS:
            kept.append((name, ",".join(str(p) for p in files(value, folder, path, name))))
        else:
            kept.append((name, value))
    end = time_of(values["end"], path, "end") if "end" in values else None
    return SumoConfig(
        path=path,
        net=(*net, path)[0],
        routes=files(values.get("route-files", ""), folder, path, "route-files"),
        additional=files(values.get("additional-files", ""), folder, path, "additional-files"),
        begin=time_of(values["begin"], path, "begin") if "begin" in values else 0.0,
        end=end if end is not None and end >= 0.0 else None,  # SUMO's default end is -1: no end
        options=tuple(kept),
        ignored=tuple(ignored),
    )


def command_line(arguments: Sequence[str]) -> dict[str, str]:
    """SUMO options as typed after `--` -> {long name: value}; an option without a value is "true".

    Outputs are permitted here, since the user requests them by name.

    Raises:
        BadInput: not an option, or an option that is impossible in a co-simulation.
    """
    options: dict[str, str] = {}
    rest = list(arguments)
    while rest:
        word = rest.pop(0)
        match = re.fullmatch(r"--([A-Za-z][\w.-]*)(?:=(.*))?|-([A-Za-z])(?:=(.*))?", word, re.DOTALL)
        if match is None:
            raise BadInput("is not a SUMO option (expected --name value)", field="SUMO options", value=word)
        name = match[1] or match[3]
        name = _SYNONYMS.get(name, name)
        value = match[2] if match[1] else match[4]
        if value is None:
            value = rest.pop(0) if rest and not re.match(r"--?[A-Za-z]", rest[0]) else "true"
        if name in _REFUSED and boolean(value):
            raise BadInput(_REFUSED[name], field=f"--{name}", value=value)
        _check_finite(value, None, f"--{name}")
        options[name] = value
    return options


def keeps(name: str) -> bool:
    """Whether an option of a .sumocfg changes the traffic and writes nothing."""
    return _KEPT.fullmatch(name) is not None and _NEVER_KEPT.fullmatch(name) is None


def boolean(value: str) -> bool:
    """A boolean as SUMO parses it; any other value than a clear no is True."""
    return value.strip().lower() not in ("false", "f", "0", "no", "off", "-", "x")


def time_of(value: str, file: object, field: str) -> float:
    """SUMO's time formats, in s: "90", "0:01:30", "0:00:01:30" (days first).

    Raises:
        BadInput: not a time, NaN or infinite.
    """
    parts = value.strip().split(":")
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3, 4) or not all(map(math.isfinite, numbers)):
        raise BadInput("is not a time (seconds or H:M:S)", file=file, field=field, value=value)
    sign = -1.0 if parts[0].strip().startswith("-") else 1.0
    weights = (1.0, 60.0, 3600.0, 86400.0)
    seconds = sum(abs(n) * w for n, w in zip(reversed(numbers), weights, strict=False))
    return sign * seconds


def _values(path: Path) -> dict[str, str]:
    """Every option with its value: `<name value="x"/>` or `<name v="x"/>`; SUMO's groups have none."""
    regular_file(path, file=path, field="scenario")
    values: dict[str, str] = {}
    root = ""

    def start(tag: str, attributes: dict[str, str], line: int) -> None:
        nonlocal root
        if not root and tag in OTHER_ROOTS:
            problem = "wrong root element, <configuration> is needed"
            raise BadInput(problem, file=path, field="root", value=tag)
        root = root or tag
        value = attributes.get("value", attributes.get("v"))
        if value is None:
            return
        name = _SYNONYMS.get(tag, tag)
        if name in values and values[name] != value:
            raise BadInput(f"is given twice (line {line})", file=path, field=name, value=value)
        values[name] = value

    scan(path, (), start)
    return values


def files(value: str, folder: Path, file: object, field: str) -> tuple[Path, ...]:
    """SUMO's comma (or space) separated list of files, as absolute paths, each checked to exist."""
    # Spaces separate only if the whole text is not a file, since paths may contain spaces.
    found: list[Path] = []
    for name in filter(None, map(str.strip, value.split(","))):
        for part in [name] if is_there(folder / name) else name.split():
            try:
                found.append(regular_file((folder / part).absolute(), file=file, field=field))
            except BadInput as error:
                raise BadInput(error.problem, file=file, field=field, value=part) from None
    return tuple(found)


def _off(lateral_resolution: str, file: object) -> bool:
    """Whether the sublane model is off. Raises BadInput."""
    try:
        return float(lateral_resolution) <= 0.0
    except ValueError:
        field = "lateral-resolution"
        raise BadInput("is not a number", file=file, field=field, value=lateral_resolution) from None


def _check_finite(value: str, file: object, field: str) -> None:
    """Raises BadInput for NaN and infinities, which SUMO accepts silently (such as `scale`)."""
    if value.strip().lstrip("+-").lower() in ("nan", "inf", "infinity"):
        raise BadInput("must be finite", file=file, field=field, value=value)
