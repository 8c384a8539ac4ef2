"""A three-lane highway with human drivers, on which every lane change is measured at its beginning.

3 lanes, 3 km, 25 m/s, demand 3,600 vehicles/h. Conservative drivers with T = 3 s cannot all enter: their
headway limits the flow. A lane change of any model is evaluated by the IDM and MOBIL formulas of Table II, in
the state at its beginning.
"""

from __future__ import annotations

import math
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import libsumo

import sumo_scenarios
from cosim.scenario.behaviors import Behaviors, DriverClass, IdmParameters
from cosim.simulation.drivers import Drivers
from cosim.simulation.mobil import (
    LEFT,
    RIGHT,
    accelerations,
    changing,
    incentive,
    is_safe,
    read_beside,
    read_own_lane,
)

CLASSES = ("aggressive", "moderate", "conservative")
LENGTH = 3000.0  # m
MEASURED = (500.0, 2500.0)  # m, section away from the insertion and removal of vehicles
FLOW = 3600.0  # vehicles/h
WARM_UP = 120.0  # s: the time to cross the road at the speed limit
STEP = 0.1  # s

Known = Callable[[str], IdmParameters | None]


@dataclass(frozen=True, slots=True)
class Change:
    """One lane change at its beginning."""

    driver: str  # class
    egoistic: float  # m/s2, incentive without politeness
    polite: float  # m/s2, incentive with the class's p
    worth: bool  # the polite incentive exceeds a_th
    worth_egoistic: bool  # the egoistic incentive exceeds a_th
    safe: bool  # the new follower need not brake harder than b_safe
    front_gap: float  # m, to the new leader; nan: none
    rear_gap: float  # m
    imposed: float  # m/s2, IDM deceleration of the new follower (0: no follower, or no braking)


@dataclass
class Traffic:
    """Measurements: lane changes, vehicle-kilometres and headways per class, colliding pairs."""

    changes: list[Change] = field(default_factory=list)
    kilometres: dict[str, float] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0.0))
    headways: dict[str, list[tuple[int, float]]] = field(  # (block: seed and minute, s)
        default_factory=lambda: {name: [] for name in CLASSES}
    )
    collisions: set[tuple[int, str, str]] = field(default_factory=set)
    vehicles: int = 0

    def add(self, other: Traffic) -> None:
        self.changes += other.changes
        self.collisions |= other.collisions
        self.vehicles += other.vehicles
        for name in CLASSES:
            self.kilometres[name] += other.kilometres[name]
            self.headways[name] += other.headways[name]


def build_highway(folder: Path) -> None:
    """The net in `folder`; needs netconvert (extra `tools`)."""
    import sumo

    nodes = f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{LENGTH}" y="0"/></nodes>'
    (folder / "n.nod.xml").write_text(nodes)
    (folder / "e.edg.xml").write_text('<edges><edge id="e" from="a" to="b" numLanes="3" speed="25"/></edges>')
    netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    files = ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.xml"]
    subprocess.run([netconvert, *files], cwd=folder, check=True, capture_output=True)


def _flow(folder: Path, driver: DriverClass, duration: float) -> Path:
    """Route file that inserts vehicles with the gaps of `driver`, at random times and lanes."""
    idm = driver.idm
    path = folder / "flow.rou.xml"
    path.write_text(
        f'<routes><vType id="car" length="5" width="2" carFollowModel="IDM" tau="{idm.time_headway}"'
        f' minGap="{idm.minimum_gap}" accel="{idm.max_acceleration}" decel="{idm.comfortable_deceleration}"'
        f' emergencyDecel="{max(9.0, idm.comfortable_deceleration)}" speedDev="0"/>'
        f'<route id="r" edges="e"/><flow id="f" type="car" route="r" begin="0" end="{duration:g}"'
        f' period="exp({FLOW / 3600.0:g})" departLane="random" departSpeed="max"/></routes>'
    )
    return path


def measure(
    folder: Path, behavior: str, model: str, seed: int, duration: float, behaviors: Behaviors
) -> Traffic:
    """Drive one episode of `duration` s after the warm-up."""
    inserted_as = behaviors.classes.get(behavior) or behaviors.classes["moderate"]
    flow = _flow(folder, inserted_as, WARM_UP + duration)
    options = "--step-length 0.1 --lanechange.duration 2 --no-step-log --no-warnings --time-to-teleport -1 "
    options += "--collision.action warn --collision.mingap-factor 0 --max-depart-delay 10"
    net, types = str(folder / "net.xml"), str(sumo_scenarios.TYPES)
    libsumo.start(["sumo", "-n", net, "-r", str(flow), "-a", types, *options.split(), "--seed", str(seed)])
    try:
        return _drive(Drivers(behavior, model, seed, behaviors), duration)
    finally:
        libsumo.close()


def _drive(drivers: Drivers, duration: float) -> Traffic:
    traffic = Traffic()
    known: Known = drivers.mobil.known if drivers.mobil else lambda _vehicle: None
    get, before = libsumo.vehicle, set[str]()
    first, warm = MEASURED[0], round(WARM_UP / STEP)
    for step in range(round((WARM_UP + duration) / STEP)):
        libsumo.simulationStep()
        for vehicle in libsumo.simulation.getDepartedIDList():
            drivers.apply(vehicle)
            traffic.vehicles += 1
        traffic.collisions.update(
            (drivers.seed, c.collider, c.victim) for c in libsumo.simulation.getCollisions()
        )
        vehicles = get.getIDList()
        now = {vehicle for vehicle in vehicles if changing(vehicle)}
        if step >= warm:
            for vehicle in now - before:
                if first <= get.getLanePosition(vehicle) <= MEASURED[1]:
                    traffic.changes.append(_judge(drivers, vehicle, known))
            if step % 10 == 0:
                _sample(drivers, traffic, vehicles, drivers.seed * 1000 + step // 600)
        before = now
        drivers.step(libsumo.simulation.getTime())
    return traffic


def _judge(drivers: Drivers, vehicle: str, known: Known) -> Change:
    """The lane change of `vehicle` that began in this step, with SUMO's neighbours at this time."""
    name = drivers.classes[vehicle]
    mobil = drivers.behaviors.classes[name].mobil
    direction = LEFT if libsumo.vehicle.getLateralSpeed(vehicle) > 0.0 else RIGHT
    s = read_beside(read_own_lane(vehicle, known), vehicle, direction, known)
    a = accelerations(s)
    egoistic, polite = incentive(a, 0.0), incentive(a, mobil.politeness)
    return Change(
        name,
        egoistic,
        polite,
        polite > mobil.threshold,
        egoistic > mobil.threshold,
        is_safe(a, mobil),
        s.new_leader.gap if s.new_leader else math.nan,
        s.new_follower.gap if s.new_follower else math.nan,
        max(0.0, -a.new_follower_after),
    )


def _sample(drivers: Drivers, traffic: Traffic, vehicles: Iterable[str], block: int) -> None:
    """Once a second: distance driven and time headway (front to front) on the measured section."""
    get = libsumo.vehicle
    for vehicle in vehicles:
        if not MEASURED[0] <= get.getLanePosition(vehicle) <= MEASURED[1]:
            continue
        name, speed = drivers.classes[vehicle], get.getSpeed(vehicle)
        traffic.kilometres[name] += speed / 1000.0
        leader = get.getLeader(vehicle, 0.0)
        if leader and leader[0] and speed > 1.0:
            gap = leader[1] + get.getMinGap(vehicle) + get.getLength(leader[0])
            traffic.headways[name].append((block, gap / speed))
