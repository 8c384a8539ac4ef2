"""Reads a route or additional file as a stream: checks numbers and names, and collects references."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from cosim.errors import BadInput, hint
from cosim.files.xml_input import Progress, regular_file, scan
from cosim.scenario.sumocfg import time_of
from cosim.scenario.vet_rules import (
    DEMAND,
    LANE_CHANGE,
    SL2015_ONLY,
    VEHICLE_TYPE,
    VEHICLE_TYPE_TEXT,
    Place,
    Reader,
    words,
)
from cosim.scenario.vet_signals import SignalReader

# SUMO accepts any root element; these indicate a file of another kind, given by mistake.
OTHER_ROOTS = frozenset(
    {"net", "nodes", "edges", "connections", "types", "configuration", "sumoConfiguration", "html", "project"}
)
_STAGES = words("walk personTrip ride stop transport tranship access")
_PERSONS = words("person personFlow container containerFlow")
_STOPS = words("busStop trainStop containerStop chargingStation parkingArea")
_DRIVERS = frozenset({"vehicle", "trip", "flow"})
_MOVING = _DRIVERS | {"person", "personFlow", "container", "containerFlow"}
_TRAVEL = _DRIVERS | {"route", "walk", "ride", "personTrip", "transport", "tranship", "stop"}
_EDGE_LISTS = ("edges", "via")
_PLACES = {"from": "edge", "to": "edge", "edge": "edge", "fromJunction": "junction", "toJunction": "junction"}
_ON_A_LANE = words(
    "stop busStop trainStop containerStop chargingStation parkingArea inductionLoop e1Detector "
    "instantInductionLoop laneAreaDetector e2Detector detEntry detExit"
)
WALKED = "route of a walk"  # a key of `Demand.used`
# Attributes that name output files; `file` of other elements is an input.
OUTPUTS: Mapping[str, str] = {
    **dict.fromkeys(
        words(
            "edgeData laneData inductionLoop e1Detector instantInductionLoop laneAreaDetector e2Detector "
            "entryExitDetector e3Detector routeProbe vTypeProbe"
        ),
        "file",
    ),
    "timedEvent": "dest",
    "calibrator": "output",
}
OUTPUT_PARAMETERS = frozenset({"device.ssm.file", "device.toc.file", "device.rerouting.output"})


@dataclass(slots=True)
class Demand:
    """Definitions and references of one route or additional file."""

    path: Path
    types: set[str] = field(default_factory=set)
    routes: set[str] = field(default_factory=set)
    vehicles: dict[str, int] = field(default_factory=dict)  # vehicle or trip -> line
    flows: dict[str, tuple[int, float]] = field(default_factory=dict)  # -> line, vehicles at most
    used: defaultdict[str, dict[str, Place]] = field(default_factory=lambda: defaultdict(dict))
    # kind (edge, lane, junction, vehicle type, route, `WALKED`) -> name -> place of its first use
    steps: dict[tuple[str, str], Place] = field(default_factory=dict)  # (edge, next edge) of vehicles' routes
    named: dict[str, tuple[str, Place]] = field(default_factory=dict)  # named route -> its edges as written
    driven: set[str] = field(default_factory=set)  # routes that vehicles may take
    includes: list[Path] = field(default_factory=list)
    walks: dict[tuple[str, str], Place] = field(default_factory=dict)  # (edge, next edge) of walks
    classes: dict[str, str] = field(default_factory=dict)  # vehicle type -> vClass, "" if not given
    mixtures: set[str] = field(default_factory=set)  # members of type distributions
    programs: dict[tuple[str, str], int] = field(default_factory=dict)  # as `SignalReader.programs`
    makes_vehicles: bool = False  # by calibrators, with ids chosen by SUMO
    outputs: list[str] = field(default_factory=list)  # files that SUMO would write, as written
    warnings: list[str] = field(default_factory=list)


def read_demand(path: Path, *, additional: bool, progress: Progress | None = None) -> Demand:
    """Check the file `path` and collect its definitions and references; `progress` in bytes.

    Raises:
        BadInput: a file that `cosim.files.xml_input.scan` refuses; NaN, infinite or negative numbers; unknown
            lane-change attributes (with the nearest name); the same vehicle twice; a missing include; a
            person without a plan, a walk without origin or destination; malformed signal programs.
    """
    reader = _DemandReader(path, additional)
    scan(path, (), reader.start, reader.end, progress=progress)
    return reader.finish()


class _DemandReader(Reader):
    """The handlers of one pass over a route or additional file."""

    def __init__(self, path: Path, additional: bool) -> None:
        super().__init__(path)
        self._additional = additional
        self.found = Demand(path)
        self._owners: list[tuple[str, str]] = []  # (tag, id) of every open element
        self._seen_lists: set[tuple[str, bool, str]] = set()  # tag, whether it has a name, edges
        self._last_depart = 0.0  # s
        self._unsorted: list[str] = []
        self._signals = SignalReader(path)
        self._person: Place | None = None  # person or container of the present plan
        self._stages = 0  # of that plan so far
        self._picked_up = False  # departs in a vehicle, at that vehicle's place

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if not self._owners and tag in OTHER_ROOTS:
            wanted = "additional" if self._additional else "routes"
            problem = f"wrong root element, <{wanted}> is needed"
            raise BadInput(problem, file=self._path, field="root", value=tag)
        owner = attributes.get("id") or (self._owners[-1][1] if self._owners else "")
        is_type = tag == "vType" or tag.startswith("carFollowing-")
        rules = VEHICLE_TYPE if is_type else DEMAND.get(tag)
        self._check(tag, attributes, rules or {}, owner, line)
        if is_type:
            for name in attributes:
                if name not in VEHICLE_TYPE and name not in VEHICLE_TYPE_TEXT:
                    self._unknown(tag, name, attributes[name], owner, line)
            if idle := sorted(SL2015_ONLY & attributes.keys()):
                self._warn(f"vType {owner!r}: {', '.join(idle)} only work with SL2015, LC2013 drives here")
            self.found.classes[owner] = attributes.get("vClass", "")
            if self._owners and self._owners[-1][0] == "vTypeDistribution":
                self.found.mixtures.add(owner)
        elif tag in _MOVING:
            self._driver(tag, attributes, owner, line)
            if "id" in attributes:  # flows inside a calibrator have none
                self._departs(tag, attributes)
        elif tag in ("tlLogic", "phase"):
            self._signals.start(tag, attributes, line)
        elif tag == "vTypeDistribution":
            self.found.mixtures.update(attributes.get("vTypes", "").split())
        elif tag == "include":
            self._include(attributes, line)
        if "id" in attributes and (is_type or tag == "vTypeDistribution"):
            self.found.types.add(attributes["id"])
        elif "id" in attributes and tag in ("route", "routeDistribution"):
            self.found.routes.add(attributes["id"])
        elif tag == "calibrator":
            self.found.makes_vehicles = True
        self.found.driven.update(self._driven(tag, attributes))
        if tag in _PERSONS:
            self._person, self._stages = Place(self._path, f"{tag}.id", "", line), 0
            self._picked_up = attributes.get("depart") == "triggered"
        elif tag in _STAGES and self._person is not None:
            self._stage(tag, attributes, owner, line)
        if tag in _TRAVEL:
            self._edges(tag, attributes, owner, line)
        if tag in _ON_A_LANE and "lane" in attributes:
            self._use("lane", attributes["lane"], tag, "lane", owner, line)
        if tag in OUTPUTS and OUTPUTS[tag] in attributes:
            self.found.outputs.append(attributes[OUTPUTS[tag]])
        elif tag == "param" and attributes.get("key") in OUTPUT_PARAMETERS and attributes.get("value"):
            self.found.outputs.append(attributes["value"])
        self._owners.append((tag, owner))

    def _driven(self, tag: str, attributes: dict[str, str]) -> list[str]:
        """The routes that an element assigns to vehicles."""
        if tag == "routeDistribution":
            return attributes.get("routes", "").split()
        in_distribution = tag == "route" and self._parent == "routeDistribution"
        name = "id" if in_distribution or tag == "routeProbReroute" else "route" if tag in _DRIVERS else ""
        return [attributes[name]] if name in attributes else []

    def end(self, tag: str) -> None:
        _, owner = self._owners.pop()
        self._signals.end(tag)
        if tag in _PERSONS and self._person is not None:
            if not self._stages:
                raise self._person.wrong("has no plan: a walk, ride or stop is needed", owner)
            self._person = None

    def _stage(self, tag: str, attributes: dict[str, str], owner: str, line: int) -> None:
        """Check a stage of a plan: the first one needs an origin, each a destination."""
        self._stages += 1
        if "route" in attributes:
            self._use(WALKED, attributes["route"], tag, "route", owner, line)
        if tag in ("stop", "access"):
            return
        if not attributes.get("edges", "x").strip():
            self._refuse(tag, "edges", "", "is empty", owner, line)
        given = {"edges", "route"} & attributes.keys()
        if self._stages == 1 and not self._picked_up and not given | _named(attributes, "from"):
            self._refuse(tag, "from", "", "is missing: the plan begins nowhere", owner, line)
        if not given | _named(attributes, "to") | (_STOPS & attributes.keys()):
            self._refuse(tag, "to", "", "is missing: it leads nowhere", owner, line)

    def finish(self) -> Demand:
        self.found.programs = self._signals.programs
        if self._unsorted:
            some = ", ".join(self._unsorted[:3]) + (", ..." if len(self._unsorted) > 3 else "")
            self.found.warnings.append(
                f"{self._path}: not sorted by departure: SUMO drops {len(self._unsorted)} of them ({some})"
            )
        return self.found

    def _unknown(self, tag: str, name: str, value: str, owner: str, line: int) -> None:
        """Refuse or report an attribute of a vehicle type that SUMO would ignore silently."""
        if name.startswith("xsi:") or name.startswith("xmlns"):
            return
        lane_change = name.lower().startswith("lc")
        if lane_change or name.startswith("jm"):
            kind, known = ("lane-change", LANE_CHANGE) if lane_change else ("junction", VEHICLE_TYPE.keys())
            problem_ = f"unknown {kind} attribute{hint(name, sorted(known))}"
            self._refuse(tag, name, value, problem_, owner, line)
        near = hint(name, [*VEHICLE_TYPE, *VEHICLE_TYPE_TEXT])
        self._warn(f"vType {owner!r}: SUMO ignores the unknown attribute {name!r}{near}")

    def _driver(self, tag: str, attributes: dict[str, str], owner: str, line: int) -> None:
        if "type" in attributes:
            self._use("vehicle type", attributes["type"], tag, "type", owner, line)
        if tag not in _DRIVERS or "id" not in attributes:
            return
        name = attributes["id"]
        first = self.found.flows.get(name, (None,))[0] if tag == "flow" else self.found.vehicles.get(name)
        if first is not None:
            self._refuse(tag, "id", name, f"is there twice, first in line {first}", "", line)
        if tag == "flow":
            self.found.flows[name] = (line, float(attributes.get("number", "inf")))
        else:
            self.found.vehicles[name] = line
        if "route" in attributes:
            self._use("route", attributes["route"], tag, "route", owner, line)

    def _departs(self, tag: str, attributes: dict[str, str]) -> None:
        """Note vehicles and persons that follow a later departure in the file: SUMO drops them."""
        # a flow without begin starts with the simulation, so it is late after any later departure
        is_flow = tag.lower().endswith("flow")
        depart = attributes.get("begin", "0") if is_flow else attributes.get("depart", "")
        if self._additional or not depart[:1].isdigit():  # additional files are loaded at once, in any order
            return
        when = time_of(depart, self._path, f"{tag}.depart")
        if when < self._last_depart:
            self._unsorted.append(attributes["id"])
        else:
            self._last_depart = when

    def _edges(self, tag: str, attributes: dict[str, str], owner: str, line: int) -> None:
        for name, kind in _PLACES.items():
            if name in attributes and (tag != "stop" or name not in ("from", "to")):
                self._use(kind, attributes[name], tag, name, owner, line)
        for name in _EDGE_LISTS:
            value = attributes.get(name)
            if value is None:
                continue
            place = Place(self._path, f"{tag}.{name}", owner, line)
            named = tag == "route" and "id" in attributes and self._parent not in _DRIVERS
            if named:
                self.found.named[owner] = value, place
            if (tag, named, value) in self._seen_lists:
                continue
            self._seen_lists.add((tag, named, value))
            edges = value.split()
            for edge in edges:
                self.found.used["edge"].setdefault(edge, place)
            if name == "edges" and tag in ("route", "walk") and not named:
                steps = self.found.steps if tag == "route" else self.found.walks
                for pair in pairwise(edges):
                    steps.setdefault(pair, place)

    @property
    def _parent(self) -> str:
        """The tag of the parent of the present element."""
        return self._owners[-1][0] if self._owners else ""

    def _use(self, kind: str, used: str, tag: str, name: str, owner: str, line: int) -> None:
        self.found.used[kind].setdefault(used, Place(self._path, f"{tag}.{name}", owner, line))

    def _include(self, attributes: dict[str, str], line: int) -> None:
        href = attributes.get("href", "")
        try:
            found = regular_file(self._path.parent / href, file=self._path, field="include.href")
        except BadInput as error:
            problem_ = f"{error.problem} (line {line})"
            raise BadInput(problem_, file=self._path, field="include.href", value=href) from None
        self.found.includes.append(found)

    def _warn(self, text: str) -> None:
        if len(self.found.warnings) < 20:  # a type may be written a thousand times
            self.found.warnings.append(f"{self._path}: {text}")


def _named(attributes: Mapping[str, str], begin: str) -> set[str]:
    """Attributes such as from, fromJunction, fromTaz."""
    return {name for name in attributes if name.startswith(begin)}
