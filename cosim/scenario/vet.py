"""Vet everything a scenario hands to SUMO before SUMO sees it: bad input becomes one clear sentence.

SUMO answers bad input with "Process Error", silence or SIGSEGV (docs/sumo.md). Here every
file is read once as a stream (memory does not grow with the demand's size, except for its names), its
numbers are checked, and every name it refers to must exist. Files that have not changed are not read again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from cosim.errors import BadInput, hint
from cosim.files.xml_input import regular_file
from cosim.scenario import Scenario
from cosim.scenario.sumocfg import FILE_OPTIONS
from cosim.scenario.vet_demand import Demand, Use, read_demand
from cosim.scenario.vet_net import Net, read_net

MAX_INCLUDES = 64  # files; more is a cycle
# Types SUMO always has.
DEFAULT_TYPES = frozenset(
    {
        "DEFAULT_VEHTYPE",
        "DEFAULT_PEDTYPE",
        "DEFAULT_BIKETYPE",
        "DEFAULT_TAXITYPE",
        "DEFAULT_RAILTYPE",
        "DEFAULT_CONTAINERTYPE",
    }
)


@dataclass(frozen=True, slots=True)
class VetReport:
    """What the vetted files hold; `warnings` belong into a result's validity."""

    edges: int  # internal ones not counted
    vehicles: int  # single vehicles and trips
    flows: int
    warnings: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()  # files the additional files would have SUMO write


def vet(scenario: Scenario) -> VetReport:
    """Read and check every file of `scenario`.

    Raises:
        BadInput: the first thing that is wrong, with file, field and value.
    """
    config = scenario.config
    net = _net(*_stamp(regular_file(scenario.net, file=config, field="net-file")))
    demands = [*_all(scenario.additional, config, additional=True), *_all(scenario.demand, config)]
    _check_options(scenario)
    _check_references(net, demands)
    _check_drivers(demands)
    types = DEFAULT_TYPES.union(*(d.types for d in demands))
    if scenario.fleet.type is not None and scenario.fleet.type not in types:
        where = ", ".join(path.name for path in scenario.demand) or "the demand"
        problem = f"no such vehicle type in {where}{hint(scenario.fleet.type, sorted(types))}"
        raise BadInput(problem, file=config, field="--av-type", value=scenario.fleet.type)
    flows = sum(d.flows for d in demands)
    return VetReport(
        edges=sum(1 for edge in net.lanes if not edge.startswith(":")),
        vehicles=sum(len(d.drivers) for d in demands) - flows,
        flows=flows,
        warnings=(*(w for d in demands for w in d.warnings), *_gaps(net, demands)),
        outputs=tuple(output for d in demands for output in d.outputs),
    )


def vetted(scenario: Scenario) -> Scenario:
    """The scenario with the vetting's warnings, which become reasons not to compare its results.

    Raises:
        BadInput: see `vet`.
    """
    return replace(scenario, warnings=vet(scenario).warnings)


def _all(paths: Iterable[Path], config: Path, *, additional: bool = False) -> list[Demand]:
    """The files and what they include, in SUMO's order of loading."""
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


def _check_references(net: Net, demands: list[Demand]) -> None:
    """Every edge, lane, junction, type and route that is used must exist."""
    types = DEFAULT_TYPES.union(*(d.types for d in demands))
    routes = frozenset[str]().union(*(d.routes for d in demands))
    for demand in demands:
        for edge, use in demand.used_edges.items():
            if edge not in net.lanes:
                near = hint(edge, net.lanes) if len(net.lanes) < 5000 else ""
                _refuse(demand.path, use, edge, f"no such edge in {net.path.name}{near}")
        for lane, use in demand.used_lanes.items():
            if not net.has_lane(lane):
                _refuse(demand.path, use, lane, f"no such lane in {net.path.name}")
        for junction, use in demand.used_junctions.items():
            if junction not in net.junctions:
                _refuse(demand.path, use, junction, f"no such junction in {net.path.name}")
        for name, use in demand.used_types.items():
            if name not in types:
                _refuse(demand.path, use, name, f"no such vehicle type{hint(name, sorted(types))}")
        for name, use in demand.used_routes.items():
            if name not in routes:
                _refuse(demand.path, use, name, f"no such route{hint(name, sorted(routes)[:5000])}")


def _check_drivers(demands: list[Demand]) -> None:
    """No vehicle may be in two files: SUMO would stop in mid-run when the second one departs."""
    seen: dict[str, Path] = {}
    for demand in demands:
        for name in demand.drivers:
            if name in seen:
                problem = f"is also in {seen[name]}"
                raise BadInput(problem, file=demand.path, field="vehicle.id", value=name)
            seen[name] = demand.path


def _gaps(net: Net, demands: list[Demand]) -> list[str]:
    """Routes that cannot be driven: SUMO finds out only when the vehicle departs, so these are warnings."""
    found = []
    for demand in demands:
        broken = [(pair, use) for pair, use in demand.steps.items() if pair not in net.links]
        for (a, b), use in broken[:3]:
            found.append(
                f"{demand.path}: impossible route ({_place(use)}): no connection from {a!r} to {b!r}"
            )
        if len(broken) > 3:
            found.append(f"{demand.path}: {len(broken) - 3} further pairs of edges without a connection")
    return found


def _refuse(path: Path, use: Use, value: str, problem: str) -> None:
    raise BadInput(f"{problem} ({_place(use)})", file=path, field=use.field, value=value)


def _place(use: Use) -> str:
    return f"{use.owner}, line {use.line}" if use.owner else f"line {use.line}"


def _stamp(path: Path) -> tuple[Path, int, int]:
    """A key that changes when the file does: path, modification time in ns, size in bytes."""
    status = path.stat()
    return path, status.st_mtime_ns, status.st_size


@lru_cache(maxsize=8)
def _net(path: Path, modified: int, size: int) -> Net:  # noqa: ARG001 - a changed file is read anew
    return read_net(path)


@lru_cache(maxsize=64)
def _demand(path: Path, modified: int, size: int, additional: bool) -> Demand:  # noqa: ARG001
    return read_demand(path, additional=additional)
