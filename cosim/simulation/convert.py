"""Converts SUMO's data: front bumper and degrees clockwise from north become centre and radians."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.files.xml_input import scan
from cosim.road import ConflictZone, Crossing, Lane, Link, RoadMap, Rule
from cosim.road.lane import limit
from cosim.scenario import Zone
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import centres
from cosim.types import Actor, Bytes, Due, Events, Floats, Kind, Snapshot

# Getters of every vehicle.
READ = (
    *("Position", "Angle", "Speed", "Acceleration", "LaneID", "LanePosition"),
    *("TimeLoss", "CO2Emission", "Signals"),  # s, mg/s, bits
)
# Substitutes for persons: SUMO has no acceleration of persons, and persons have no lane. They walk beside,
# along, against and across the lanes of vehicles.
PERSON_DEFAULTS: tuple[Callable[[str], Any], ...] = (
    *(lambda _: 0.0, lambda _: "", lambda _: 0.0),
    *(lambda _: 0.0, lambda _: 0.0, lambda _: 0),
)
# Bits of a vehicle's signals, right and left (SUMO, TraCI/Vehicle_Signalling), -> `Snapshot.indicator`
INDICATOR = np.array([0, -1, 1, 0], np.int8)
PERSON = "person:"  # prefix of a person's id in a snapshot: a vehicle may have the same id
GIVE_WAY = "mswZ"  # link states: minor, stop, all-way stop, zipper (SUMO, Networks/SUMO_Road_Networks)
# link states at a stop line without signals (SUMO, Networks/SUMO_Road_Networks)
RULES = {"m": Rule.YIELD, "s": Rule.STOP, "w": Rule.ALL_WAY_STOP, "=": Rule.EQUAL, "Z": Rule.ZIPPER}
CROSSING = re.compile(r":.+_c\d+")  # netconvert's name for a pedestrian crossing
CAR = "passenger"  # SUMO's class of cars, AVs among them
MOTOR_CLASSES = frozenset({CAR, "private", "taxi", "bus", "truck", "trailer", "delivery", "motorcycle"})
# SUMO's vehicle classes (Definition_of_Vehicles, Abstract Vehicle Class); all others are cars
ACTORS = {
    name: actor
    for actor, names in {
        Actor.TRUCK: "truck trailer delivery",
        Actor.BUS: "bus coach",
        Actor.MOTORCYCLE: "motorcycle moped",
        Actor.BICYCLE: "bicycle scooter",
        Actor.PERSON: "pedestrian wheelchair",
        Actor.OTHER: "tram rail rail_urban rail_electric rail_fast subway cable_car ship aircraft drone "
        "container",
    }.items()
    for name in names.split()
}


@dataclass(frozen=True, slots=True)
class Body:
    """Constants of a vehicle."""

    kind: Kind
    mission: bool
    length: float  # m
    width: float  # m
    actor: Actor = Actor.CAR
    guessed: bool = False  # a mission vehicle guessed from the net


class SnapshotReader:
    """Reads every vehicle with plain getters (measured faster than subscriptions, docs/reference/sumo.md)."""

    def __init__(self, road: RoadMap, variable: Iterable[int] = ()) -> None:
        """`variable`: lanes with a changeable speed limit."""
        self._lane_index = road.index
        self._variable = [(k, road.lanes[k].id, road.lanes[k].speed_limit) for k in variable]
        self._limit_of = sumo.getter("lane", "MaxSpeed")
        self._edges = road.contact.edges
        self._lights = Counter(light for light, _ in road.signals)  # -> how many signals, in their order
        self._of_vehicles = tuple(sumo.getter("vehicle", name) for name in READ)
        self._of_persons = (*(sumo.getter("person", name) for name in READ[:3]), *PERSON_DEFAULTS)
        self._ids: tuple[str, ...] | None = None
        self._persons: tuple[str, ...] | None = None
        # kind, mission, length m, width m, actor [n] of `_ids`
        self._static: tuple[np.ndarray, ...] = ()

    def bodies_changed(self) -> None:
        """Rebuild the constant columns at the next read (new episode, new mission vehicle)."""
        self._ids = None
        self.persons_changed()

    def persons_changed(self) -> None:
        """Query the persons again at the next read. The query is slow: SUMO searches all loaded persons, with
        a flow those of the whole day."""
        self._persons = None

    def read(
        self, bodies: dict[str, Body], events: Events, waiting: Mapping[str, Due] | None = None
    ) -> Snapshot:
        """One snapshot of every vehicle and every walking person on the road, sorted by id.

        Args:
            bodies: constants of every departed vehicle, by id; new persons are added.
            events: events since the last snapshot.
            waiting: see `Snapshot`.
        """
        persons = self._walking() if sumo.person.getIDCount() else {}
        ids = tuple(sorted((*sumo.vehicle.getIDList(), *persons)))
        if ids != self._ids:
            present = [bodies.get(i) or bodies.setdefault(i, _person(persons[i])) for i in ids]
            self._static = (
                np.array([b.kind for b in present], np.int8),
                np.array([b.mission for b in present], np.bool_),
                np.array([b.length for b in present], np.float64),
                np.array([b.width for b in present], np.float64),
                np.array([b.actor for b in present], np.int8),
            )
            self._ids = ids
        kind, mission, length, width, actor = self._static
        position, angle, speed, accel, lane, lane_position, time_loss, co2, lights = (
            list(map(vehicle, ids))
            if not persons
            else [person(persons[i]) if i in persons else vehicle(i) for i in ids]
            for vehicle, person in zip(self._of_vehicles, self._of_persons, strict=True)
        )
        on = np.fromiter(map(self._lane_index.get, lane, repeat(-1)), np.int32, len(ids))
        off = np.flatnonzero(on < 0)
        place = on.copy() if len(off) else on
        for k in off:
            person = persons.get(ids[k])
            edge = lane[k].rpartition("_")[0] if person is None else sumo.person.getRoadID(person)
            place[k] = -2 - self._edges.get(edge, -1)
        front = np.array(position, np.float64).reshape(-1, 2)  # [n,2] m
        x, y, heading = centres(front[:, 0], front[:, 1], np.array(angle), 0.5 * length)
        return Snapshot(
            time=sumo.simulation.getTime(),
            ids=ids,
            kind=kind,
            mission=mission,
            x=x,
            y=y,
            heading=heading,
            speed=np.array(speed, np.float64),
            accel=np.array(accel, np.float64),
            length=length,
            width=width,
            lane=on,
            lane_position=np.array(lane_position, np.float64),
            events=events,
            actor=actor,
            place=place,
            signals=self._signals(),
            switches=self._switches(),
            time_loss=np.array(time_loss, np.float64),
            co2=np.array(co2, np.float64) * 1e-3,
            indicator=INDICATOR[np.array(lights, np.int64) & 3],
            waiting=waiting,
            limits={k: m for k, name, usual in self._variable if (m := self._limit_of(name)) != usual},
        )

    def _walking(self) -> dict[str, str]:
        """Name -> SUMO's id of every walking person: not riding, not waiting for a ride, at no other
        stage."""
        get, on_foot = sumo.person, sumo.constants.STAGE_WALKING
        if self._persons is None:
            self._persons = get.getIDList()
        return {PERSON + i: i for i in self._persons if get.getStage(i).type == on_foot}

    def _signals(self) -> Bytes:
        """[s] the state of every signal; a traffic light may have more states than links."""
        get = sumo.trafficlight
        states = (get.getRedYellowGreenState(light)[:count] for light, count in self._lights.items())
        return np.frombuffer("".join(states).encode(), np.uint8)

    def _switches(self) -> Floats:
        """[s] s until the next phase of every signal's traffic light."""
        get, now = sumo.trafficlight.getNextSwitch, sumo.simulation.getTime()
        left = np.array([get(light) for light in self._lights], np.float64) - now
        return np.repeat(left, np.fromiter(self._lights.values(), np.int64))


def _person(person: str) -> Body:
    get = sumo.person
    return Body(Kind.PERSON, False, get.getLength(person), get.getWidth(person), Actor.PERSON)


def read_road(zones: Sequence[Zone], scenario_file: object) -> RoadMap:
    """The loaded net as a RoadMap (m, m/s): every lane that is open to motor vehicles.

    Args:
        zones: conflict zones by their edges; if empty, minor approaches and ending lanes form one.
        scenario_file: named in errors.

    Raises:
        BadInput: a conflict zone names an edge that the net does not have.
    """
    get = sumo.lane
    ids = [i for i in get.getIDList() if not (a := get.getAllowed(i)) or MOTOR_CLASSES.intersection(a)]
    place = {name: k for k, name in enumerate(ids)}
    lanes = []
    for name in ids:
        edge, _, number = name.rpartition("_")
        followers = [link[4] or link[0] for link in get.getLinks(name)]
        lanes.append(
            Lane(
                id=name,
                edge=edge,
                index=int(number),
                shape=np.array(get.getShape(name), np.float64)[:, :2],
                length=get.getLength(name),
                width=get.getWidth(name),
                speed_limit=limit(get.getMaxSpeed(name)),
                successors=tuple(place[i] for i in dict.fromkeys(followers) if i in place),
                left=_beside(name, place, 1),
                right=_beside(name, place, -1),
                internal=name.startswith(":"),
                start=sumo.edge.getFromJunction(edge),
                end=sumo.edge.getToJunction(edge),
            )
        )
    found = tuple(_zone(z, lanes, scenario_file) for z in zones)
    outlines = tuple(
        np.array(shape, np.float64)[:, :2]
        for j in sumo.junction.getIDList()
        if not j.startswith(":") and len(shape := sumo.junction.getShape(j)) > 2
    )
    links, signals = _links(lanes, place)
    crossings = _crossings(place, signals)
    road = RoadMap(tuple(lanes), found, outlines, links, signals, crossings, _closed(lanes))
    return road if found else replace(road, zones=(_struggling_zone(road),))


def _links(
    lanes: Sequence[Lane], place: Mapping[str, int]
) -> tuple[tuple[Link, ...], tuple[tuple[str, int], ...]]:
    """Every link with its rule and foes, and the (traffic light, link index) of every signal."""
    get, lights = sumo.lane, sumo.trafficlight
    signals: list[tuple[str, int]] = []
    signal_of: dict[tuple[str, str], int] = {}  # (origin, target) -> index into `signals`
    for light in lights.getIDList():
        for index, ways in enumerate(lights.getControlledLinks(light)):
            signal_of.update(((way[0], way[1]), len(signals)) for way in ways)
            signals.append((light, index))
    requests = _requests()
    links: list[Link] = []
    row_of: dict[str, int] = {}  # the last lane of a link inside its junction -> the link
    yields: list[tuple[str, ...]] = []  # per link: the last lanes of the links with priority over it
    for lane in lanes:
        for target, _, _, _, via, state, *_ in () if lane.internal else get.getLinks(lane.id):
            if target not in place:
                continue
            signal = signal_of.get((lane.id, target), -1)
            last = via
            while last and (inner := next((way[4] for way in get.getLinks(last) if way[0] == target), "")):
                last = inner
            before, foes = requests.get(last, ((), ()))
            rule = RULES.get(state, Rule.PRIORITY) if signal < 0 else Rule.YIELD if before else Rule.PRIORITY
            row_of[last] = len(links)
            yields.append(tuple(name for name in before if name in foes))
            links.append(Link(place[lane.id], place.get(via, -1), place[target], signal, rule))
    found = [tuple(row_of[name] for name in names if name in row_of) for names in yields]
    return tuple(replace(k, foes=f) for k, f in zip(links, found, strict=True)), tuple(signals)


def _closed(lanes: Sequence[Lane]) -> tuple[Lane, ...]:
    """One lane of every edge closed to motor vehicles: footpaths, cycleways, rails."""
    get, known = sumo.lane, {lane.edge for lane in lanes}
    found = []
    for edge in sumo.edge.getIDList():
        if edge in known:
            continue
        name = f"{edge}_0"
        shape = np.array(get.getShape(name), np.float64)[:, :2]
        size = get.getLength(name), get.getWidth(name), get.getMaxSpeed(name)
        ends = sumo.edge.getFromJunction(edge), sumo.edge.getToJunction(edge)
        internal = edge.startswith(":")
        found.append(Lane(name, edge, 0, shape, *size, internal=internal, start=ends[0], end=ends[1]))
    return tuple(found)


def _requests() -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """The right-of-way tables of the net file, since TraCI has them per lane only. The last internal lane of
    a link -> such lanes of the links with priority over it, and of all conflicting links (foes)."""
    found: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}
    inside: list[str] = []

    def start(tag: str, attributes: dict[str, str], _line: int) -> None:
        if tag == "junction":
            inside[:] = attributes.get("intLanes", "").split()
        elif tag == "request" and int(attributes["index"]) < len(inside):
            before, foes = (
                tuple(
                    name for name, bit in zip(inside, reversed(attributes[row]), strict=False) if bit == "1"
                )
                for row in ("response", "foes")
            )
            found[inside[int(attributes["index"])]] = before, foes

    scan(Path(sumo.simulation.getOption("net-file")), ("net",), start)
    return found


def _crossings(place: Mapping[str, int], signals: Sequence[tuple[str, int]]) -> tuple[Crossing, ...]:
    """Every pedestrian crossing of the net."""
    get, found = sumo.lane, []
    signal_of: dict[str, int] = {}
    for number, (light, index) in enumerate(signals):
        for way in sumo.trafficlight.getControlledLinks(light)[index]:
            signal_of[way[1]] = signal_of[way[2]] = number
    for edge in sumo.edge.getIDList():
        if CROSSING.fullmatch(edge):
            lane = f"{edge}_0"
            crossed = tuple(place[i] for i in get.getInternalFoes(lane) if i in place)
            shape = np.array(get.getShape(lane), np.float64)[:, :2]
            found.append(Crossing(edge, shape, get.getWidth(lane), crossed, signal_of.get(lane, -1)))
    return tuple(found)


def may_change(lane: str, offset: int, vehicle_class: str) -> bool:
    """Whether SUMO permits this vehicle class a lane change to that side (+1 left), given a lane there."""
    return not lane.startswith(":") and vehicle_class in sumo.lane.getChangePermissions(lane, offset)


def _beside(lane: str, place: Mapping[str, int], offset: int) -> int:
    """The lane to that side (+1 left) that a car may change to; -1: none, SUMO would refuse the command. For
    lanes closed to cars, the permitted vehicle classes decide."""
    edge, _, number = lane.rpartition("_")
    other = f"{edge}_{int(number) + offset}"
    if other not in place:
        return -1
    here, there = (frozenset(sumo.lane.getAllowed(i)) or MOTOR_CLASSES for i in (lane, other))
    classes = {CAR} if CAR in here else MOTOR_CLASSES & here
    return place[other] if any(may_change(lane, offset, c) for c in classes & there) else -1


def struggling_lanes(road: RoadMap) -> frozenset[int]:
    """Lanes on which drivers depend on others: the lane ends beside a continuing one, or must yield.

    Used to guess the mission vehicle of a user's own net.
    """
    return frozenset(
        i for i, lane in enumerate(road.lanes) if not lane.internal and _needs_help(lane, road.lanes)
    )


def _needs_help(lane: Lane, lanes: Sequence[Lane]) -> bool:
    if not lane.successors:
        return any(o >= 0 and lanes[o].successors for o in (lane.left, lane.right))
    links = sumo.lane.getLinks(lane.id)
    return bool(links) and all(link[5] in GIVE_WAY for link in links)


def _struggling_zone(road: RoadMap) -> ConflictZone:
    """The conflict zone without a scenario.yaml: the lanes entered from minor approaches and ending lanes."""
    ways = [road.lanes[i] for i in struggling_lanes(road)]
    entered = (o for way in ways for o in way.successors or (way.left, way.right) if o >= 0)
    return ConflictZone("found", frozenset(entered))


def _zone(zone: Zone, lanes: Sequence[Lane], scenario_file: object) -> ConflictZone:
    members = set()
    for edge in zone.edges:
        mine = {
            k
            for k, lane in enumerate(lanes)
            if lane.edge == edge or (edge.startswith(":") and lane.edge.startswith(f"{edge}_"))
        }
        if not mine:
            raise BadInput("the net has no such edge", file=scenario_file, field="conflict_zones", value=edge)
        members |= mine
    return ConflictZone(zone.name, frozenset(members))
