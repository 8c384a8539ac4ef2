"""Checks all input files of a scenario before SUMO reads them, with one clear error for bad input.

SUMO answers bad input with "Process Error", nothing or SIGSEGV (docs/reference/sumo.md). Here every file is
read once as a stream, in memory that grows only with the number of names. Numbers are checked, and every
name that is referred to must exist. Unchanged files are not read again.
"""

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from cosim.errors import BadInput, hint
from cosim.files.xml_input import Progress, is_there, regular_file
from cosim.scenario import Scenario
from cosim.scenario.sumocfg import FILE_OPTIONS
from cosim.scenario.vet_demand import WALKED, Demand, read_demand
from cosim.scenario.vet_net import Net, read_net
from cosim.scenario.vet_rules import OFF_ROAD, some
from cosim.scenario.vet_signals import check_lengths

MAX_WARNINGS = 20  # of one kind
MAX_INCLUDES = 64  # files; more indicate a cycle
# SUMO's default types and their vehicle classes.
DEFAULT_TYPES: Mapping[str, str] = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_CONTAINERTYPE": "container",
}


@dataclass(frozen=True, slots=True)
class VetReport:
    """Content of the vetted files; `warnings` belong into a result's validity."""

    edges: int  # internal ones not counted
    vehicles: int  # single vehicles and trips
    flows: int
    warnings: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()  # files that the additional files make SUMO write


def vet(scenario: Scenario) -> VetReport:
    """Read and check every file of `scenario`.

    Raises:
        BadInput: the first fault, with file, field and value.
    """
    config = scenario.config
    _read.set(_Read(scenario.net, *scenario.additional, *scenario.demand))
    net = _net(*_stamp(regular_file(scenario.net, file=config, field="net-file")))
    demands = [*_all(scenario.additional, config, additional=True), *_all(scenario.demand, config)]
    _check_options(scenario)
    types = frozenset(DEFAULT_TYPES).union(*(d.types for d in demands))
    _check_references(net, demands, types)
    for demand in demands:
        check_lengths(demand.path, demand.programs, net.signals)
    _check_mission(scenario, demands)
    clashes = _check_drivers(demands)
    if scenario.fleet.type is not None and scenario.fleet.type not in types:
        where = ", ".join(path.name for path in scenario.demand) or "the demand"
        problem = f"no such vehicle type in {where}{hint(scenario.fleet.type, sorted(types))}"
        raise BadInput(problem, file=config, field="--av-type", value=scenario.fleet.type)
    return VetReport(
        edges=sum(1 for edge in net.lanes if not edge.startswith(":")),
        vehicles=sum(len(d.vehicles) for d in demands),
        flows=sum(len(d.flows) for d in demands),
        warnings=(
            *net.warnings,
            *(w for d in demands for w in d.warnings),
            *clashes,
            *_gaps(net, demands),
            *_unsupported(scenario, demands),
        ),
        outputs=tuple(output for d in demands for output in d.outputs),
    )


def vetted(scenario: Scenario) -> Scenario:
    """The scenario with the vetting's warnings, which become reasons not to compare its results.

    Raises:
        BadInput: see `vet`.
    """
    return replace(scenario, warnings=vet(scenario).warnings)


@contextlib.contextmanager
def watched(progress: Progress) -> Iterator[None]:
    """In this block `progress` receives the MB read of a scenario's files, and the total."""
    before = _progress.set(progress)
    try:
        yield
    finally:
        _progress.reset(before)


def _all(paths: Iterable[Path], config: Path, *, additional: bool = False) -> list[Demand]:
    """The files and their includes, in SUMO's order of loading."""
    waiting = [
        regular_file(path, file=config, field="additional-files" if additional else "route-files")
        for path in paths
    ]
    found: list[Demand] = []
    while waiting:
        demand = _demand(*_stamp(waiting.pop(0)), additional)
        found.append(demand)
        waiting[:0] = demand.includes
        if len(found) > MAX_INCLUDES and demand.includes:
            href = str(demand.includes[0])
            raise BadInput("includes never end", file=demand.path, field="include.href", value=href)
    return found


def _check_options(scenario: Scenario) -> None:
    for name, value in scenario.options:
        if name in FILE_OPTIONS:
            for path in value.split(","):
                regular_file(Path(path), file=scenario.config, field=name)


def _check_references(net: Net, demands: list[Demand], types: frozenset[str]) -> None:
    """Raises BadInput unless every used edge, lane, junction, type and route exists."""
    routes = frozenset[str]().union(*(d.routes for d in demands))
    here = f" in {net.path.name}"
    near = net.lanes if len(net.lanes) < 5000 else ()
    kinds: tuple[tuple[str, Callable[[str], bool], str, Iterable[str]], ...] = (
        ("edge", net.lanes.__contains__, here, near),
        ("lane", net.has_lane, here, ()),
        ("junction", net.junctions.__contains__, here, ()),
        ("vehicle type", types.__contains__, "", sorted(types)),
        ("route", routes.__contains__, "", sorted(routes)[:5000]),
        (WALKED, routes.__contains__, "", sorted(routes)[:5000]),
    )
    for demand in demands:
        for kind, exists, where, known in kinds:
            for name, place in demand.used[kind].items():
                if not exists(name):
                    raise place.wrong(f"no such {kind}{where}{hint(name, known)}", name)


def _check_drivers(demands: list[Demand]) -> list[str]:
    """Raises BadInput for a vehicle or flow in two files: SUMO would stop when the second one departs.

    A vehicle and a flow may share an id. A vehicle with the id of a flow's vehicle (FLOW.0, FLOW.1, ...)
    stops SUMO if both depart, which is a warning.
    """
    for field in ("vehicles", "flows"):
        seen: dict[str, Path] = {}
        for demand in demands:
            for name in getattr(demand, field):
                if name in seen:
                    problem = f"is also in {seen[name]}"
                    raise BadInput(problem, file=demand.path, field=f"{field[:-1]}.id", value=name)
                seen[name] = demand.path
    most = {name: number for demand in demands for name, (_, number) in demand.flows.items()}
    found = []
    for demand in demands:
        for name in demand.vehicles:
            flow, _, index = name.rpartition(".")
            if flow in most and index.isdigit() and int(index) < most[flow]:
                found.append(f"{demand.path}: {name!r} is the name of a vehicle of the flow {flow!r} too")
    return found[:MAX_WARNINGS]


def _gaps(net: Net, demands: list[Demand]) -> list[str]:
    """Warnings about gaps in routes and walks, which SUMO finds only under way or never."""
    found = []
    driven = frozenset[str]().union(*(d.driven for d in demands))
    on_foot = frozenset[str]().union(*(d.used[WALKED] for d in demands)) - driven  # both directions, any edge
    for demand in demands:
        steps, walks = dict(demand.steps), dict(demand.walks)
        for name, (edges, place) in demand.named.items():
            for pair in pairwise(edges.split()):
                (walks if name in on_foot else steps).setdefault(pair, place)
        broken = [(pair, place) for pair, place in steps.items() if pair not in net.links]
        for (a, b), place in broken[:3]:
            found.append(f"{demand.path}: impossible route ({place}): no connection from {a!r} to {b!r}")
        if len(broken) > 3:
            found.append(f"{demand.path}: {len(broken) - 3} further pairs of edges without a connection")
        apart = [
            (pair, place)
            for pair, place in walks.items()
            if not set(net.ends.get(pair[0], ())) & set(net.ends.get(pair[1], ()))
            and not any(edge.startswith(":") for edge in pair)
        ]
        for (a, b), place in apart[:3]:
            found.append(
                f"{demand.path}: a walk with a gap ({place}): SUMO moves the person from {a!r} to {b!r}"
            )
    return found


def _unsupported(scenario: Scenario, demands: list[Demand]) -> list[str]:
    """Warnings about features that SUMO supports but cosim does not (formats.md, Not supported)."""
    found = []
    found += [
        f"{scenario.config}: {c.option}={c.file}: without SUMO's sublane model the traffic is another"
        for c in scenario.changed
        if c.option == "lateral-resolution"
    ]
    used = {name for demand in demands for name in (*demand.used["vehicle type"], *demand.mixtures)}
    off_road = {
        name: kind for d in demands for name, kind in d.classes.items() if kind in OFF_ROAD and name in used
    }
    if off_road:
        types = some([f"{name} ({kind})" for name, kind in sorted(off_road.items())])
        found.append(
            f"{scenario.config}: no road vehicles: {types}: each is taken to be one straight, stiff box"
        )
    return found


def _check_mission(scenario: Scenario, demands: list[Demand]) -> None:
    """Raises BadInput if the mission vehicle is not in the demand, as far as ids are known in advance."""
    mission = scenario.mission
    wanted = mission.vehicles
    own = scenario.built_in and scenario.asked.mission is None  # a file of the user may lack its vehicle
    if not wanted or own or any(demand.makes_vehicles for demand in demands):
        return
    vehicles = [name for demand in demands for name in demand.vehicles]
    flows = {name for demand in demands for name in demand.flows}  # their vehicles are FLOW.0, FLOW.1, ...
    unknown = wanted.rpartition(".")[0] in flows if re.fullmatch(r"[\w.:-]+", wanted) else bool(flows)
    if not unknown and not any(map(mission.includes, vehicles)):
        near = hint(wanted, [*vehicles[:5000], *(f"{flow}.0" for flow in flows)])
        raise BadInput(
            f"no such vehicle in the demand{near}", file=scenario.config, field="--mission", value=wanted
        )


class _Read:
    """Read progress over a scenario's files."""

    def __init__(self, *files: Path) -> None:
        self._all = sum(path.stat().st_size for path in files if is_there(path))  # bytes, without includes
        self._done = 0  # bytes, of whole files

    def next(self, size: int) -> Progress:
        """The progress of the next file, of `size` bytes."""
        before, self._done = self._done, self._done + size
        tell = _progress.get()
        return lambda read, _: tell((before + read) / 1e6, max(self._all, self._done) / 1e6)


_progress: ContextVar[Progress] = ContextVar("progress", default=lambda _, __: None)
_read: ContextVar[_Read] = ContextVar("read")


def _stamp(path: Path) -> tuple[Path, int, int]:
    """A cache key of a file: path, modification time in ns, size in bytes."""
    status = path.stat()
    return path, status.st_mtime_ns, status.st_size


@lru_cache(maxsize=8)
def _net(path: Path, modified: int, size: int) -> Net:  # noqa: ARG001 - a changed file is read anew
    return read_net(path, _read.get().next(size))


@lru_cache(maxsize=64)
def _demand(path: Path, modified: int, size: int, additional: bool) -> Demand:  # noqa: ARG001
    return read_demand(path, additional=additional, progress=_read.get().next(size))
