"""Human drivers in SUMO: classes really drive as Table II says, on a short three-lane highway."""

from __future__ import annotations

import statistics
import subprocess
from collections.abc import Iterator
from pathlib import Path

import libsumo
import pytest
import sumo

import sumo_scenarios
from cosim.errors import BadInput
from cosim.scenario.behaviors import load_behaviors
from cosim.simulation.derived_types import IDM_TYPE
from cosim.simulation.drivers import Drivers
from cosim.simulation.mobil import STRATEGIC_ONLY, idm_acceleration

CLASSES = ("aggressive", "moderate", "conservative")
TEST_SEED = 200_000
BASE_TYPE_FILE = sumo_scenarios.TYPES


@pytest.fixture(scope="module")
def highway(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a net (3 lanes, 1.5 km, 25 m/s) and 3,600 of SUMO's default cars an hour."""
    folder = tmp_path_factory.mktemp("highway")
    (folder / "n.nod.xml").write_text(
        '<nodes><node id="a" x="0" y="0"/><node id="b" x="1500" y="0"/></nodes>'
    )
    (folder / "e.edg.xml").write_text('<edges><edge id="e" from="a" to="b" numLanes="3" speed="25"/></edges>')
    netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    files = ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.xml"]
    subprocess.run([netconvert, *files], cwd=folder, check=True, capture_output=True)
    (folder / "flow.rou.xml").write_text(
        '<routes><vType id="car" length="4.5" width="2"/>'
        '<vType id="idm_car" carFollowModel="IDM" length="4.5" width="2" maxSpeed="12"/>'
        '<route id="r" edges="e"/>'
        '<flow id="f" type="car" route="r" begin="0" end="600" period="exp(1.0)" departLane="random"'
        ' departSpeed="max"/></routes>'
    )
    return folder


@pytest.fixture
def start(highway: Path) -> Iterator[object]:
    """Starts SUMO on the highway; closes it after the test."""

    def begin(seed: int = TEST_SEED, base_type: bool = True) -> None:
        extra = ["-a", str(BASE_TYPE_FILE)] if base_type else []
        options = "--step-length 0.1 --lanechange.duration 2 --no-step-log --no-warnings "
        options += "--time-to-teleport -1 --collision.action warn --collision.mingap-factor 0"
        net, flow = str(highway / "net.xml"), str(highway / "flow.rou.xml")
        libsumo.start(["sumo", "-n", net, "-r", flow, *extra, *options.split(), "--seed", str(seed)])

    yield begin
    libsumo.close()


def drive(drivers: Drivers, steps: int) -> tuple[set[tuple[str, str]], int, dict[str, list[float]]]:
    """Collided pairs, lane changes begun, and time headways in s per class (sampled once a second)."""
    collided: set[tuple[str, str]] = set()
    headways: dict[str, list[float]] = {name: [] for name in CLASSES}
    changes, before = 0, set()
    for step in range(steps):
        libsumo.simulationStep()
        for vehicle in libsumo.simulation.getDepartedIDList():
            drivers.apply(vehicle)
        drivers.step(libsumo.simulation.getTime())
        collided.update((c.collider, c.victim) for c in libsumo.simulation.getCollisions())
        now = {v for v in libsumo.vehicle.getIDList() if libsumo.vehicle.getLateralSpeed(v) != 0.0}
        changes += len(now - before)
        before = now
        if step % 10 == 0:
            for vehicle in libsumo.vehicle.getIDList():
                leader = libsumo.vehicle.getLeader(vehicle, 0.0)
                speed = libsumo.vehicle.getSpeed(vehicle)
                if leader and leader[0] and speed > 5.0:
                    gap = leader[1] + libsumo.vehicle.getMinGap(vehicle)
                    headways[drivers.classes[vehicle]].append(gap / speed)
    return collided, changes, headways


@pytest.mark.parametrize("model", ["lc2013", "mobil"])
@pytest.mark.parametrize("behavior", [*CLASSES, "mixed"])
def test_human_drivers_do_not_crash_into_one_another(start, behavior, model) -> None:
    start()
    collided, changes, _ = drive(Drivers(behavior, model, TEST_SEED), 900)
    assert collided == set()
    assert libsumo.vehicle.getIDCount() > 15
    if behavior in ("aggressive", "mixed"):
        assert changes > 0


def test_aggressive_drivers_keep_shorter_headways_than_conservative_ones(start) -> None:
    start()
    _, _, headways = drive(Drivers("mixed", "lc2013", TEST_SEED), 900)
    tightest = {name: statistics.quantiles(values, n=10)[0] for name, values in headways.items()}
    assert tightest["aggressive"] < tightest["moderate"] < tightest["conservative"]
    assert tightest["conservative"] > 2.0


@pytest.mark.parametrize("model", ["lc2013", "mobil"])
@pytest.mark.parametrize("behavior", CLASSES)
def test_the_parameters_of_the_class_are_really_set_in_sumo(start, behavior, model) -> None:
    start()
    drivers = Drivers(behavior, model, TEST_SEED)
    driver = load_behaviors().classes[behavior]
    while not libsumo.simulation.getDepartedIDList():
        libsumo.simulationStep()
    vehicle = libsumo.simulation.getDepartedIDList()[0]
    assert drivers.apply(vehicle) == behavior
    libsumo.simulationStep()
    get = libsumo.vehicle
    assert get.getTau(vehicle) == driver.idm.time_headway
    assert get.getMinGap(vehicle) == driver.idm.minimum_gap
    assert get.getAccel(vehicle) == driver.idm.max_acceleration
    assert get.getDecel(vehicle) == get.getApparentDecel(vehicle) == driver.idm.comfortable_deceleration
    assert get.getEmergencyDecel(vehicle) == max(9.0, driver.idm.comfortable_deceleration)
    assert get.getImperfection(vehicle) == -1.0  # IDM: no driver noise
    assert get.getSpeedFactor(vehicle) == pytest.approx(
        drivers.behaviors.desired_speed.draw(drivers.draws(vehicle)[1])
    )
    assert (get.getLength(vehicle), get.getWidth(vehicle)) == (4.5, 2.0)  # its own size is kept
    for key, value in driver.lc2013:  # SUMO answers with two decimals
        assert float(get.getParameter(vehicle, f"laneChangeModel.{key}")) == pytest.approx(value, abs=0.0051)
    assert (get.getLaneChangeMode(vehicle) == STRATEGIC_ONLY) == (model == "mobil")


def test_the_car_following_is_the_idm_of_the_equation(start) -> None:
    """A free conservative car at 0.6 v0 gains a_max (1 - 0.6^4) in m/s2."""
    start()
    drivers = Drivers("conservative", "lc2013", TEST_SEED)
    while not libsumo.simulation.getDepartedIDList():
        libsumo.simulationStep()
    vehicle = libsumo.simulation.getDepartedIDList()[0]
    drivers.apply(vehicle)
    desired = libsumo.vehicle.getAllowedSpeed(vehicle)
    libsumo.vehicle.setPreviousSpeed(vehicle, 0.6 * desired)
    libsumo.simulationStep()
    gained = (libsumo.vehicle.getSpeed(vehicle) - 0.6 * desired) / 0.1
    assert gained == pytest.approx(1.0 - 0.6**4, abs=0.01)


@pytest.mark.parametrize("behavior", CLASSES)
def test_a_driver_closing_up_on_a_slower_leader_brakes_as_the_idm_equation_says(start, behavior) -> None:
    """The interaction term holds sqrt(a b) of the class, not of the vehicle's original type."""
    start()
    drivers = Drivers(behavior, "lc2013", TEST_SEED)
    for name, place in (("back", "100"), ("front", "205")):
        libsumo.vehicle.add(name, "r", "car", departLane="1", departPos=place, departSpeed="20")
    libsumo.simulationStep()
    for name in ("back", "front"):
        drivers.apply(name)
        libsumo.vehicle.setLaneChangeMode(name, 0)
    libsumo.vehicle.setPreviousSpeed("front", 15.0)
    get, idm = libsumo.vehicle, load_behaviors().classes[behavior].idm
    gap = get.getLeader("back", 0.0)[1] + idm.minimum_gap
    speed, desired = get.getSpeed("back"), get.getAllowedSpeed("back")
    libsumo.simulationStep()
    expected = idm_acceleration(idm, speed, desired, gap, 15.0)
    assert (get.getSpeed("back") - speed) / 0.1 == pytest.approx(expected, abs=0.02)


def test_without_the_idm_base_type_a_foreign_car_following_model_is_refused_by_name(start) -> None:
    start(base_type=False)
    assert IDM_TYPE not in libsumo.vehicletype.getIDList()
    while not libsumo.simulation.getDepartedIDList():
        libsumo.simulationStep()
    with pytest.raises(BadInput, match="car"):
        Drivers("moderate", "lc2013", 1).apply(libsumo.simulation.getDepartedIDList()[0])


def test_a_type_that_already_uses_idm_needs_no_base_type_and_keeps_its_body(start) -> None:
    start(base_type=False)
    libsumo.vehicle.add("slow", "r", "idm_car", departLane="1", departPos="100", departSpeed="10")
    libsumo.simulationStep()
    Drivers("conservative", "lc2013", TEST_SEED).apply("slow")
    assert libsumo.vehicle.getTau("slow") == 3.0
    assert libsumo.vehicle.getMaxSpeed("slow") == 12.0
    assert libsumo.vehicle.getLength("slow") == 4.5


def test_a_lane_change_of_a_human_driver_takes_two_seconds(start) -> None:
    start()
    libsumo.vehicle.add("alone", "r", "car", departLane="0", departPos="300", departSpeed="20")
    libsumo.simulationStep()
    Drivers("moderate", "lc2013", TEST_SEED).apply("alone")
    libsumo.vehicle.changeLaneRelative("alone", 1, 0.0)
    moving = 0
    for _ in range(40):
        libsumo.simulationStep()
        moving += libsumo.vehicle.getLateralSpeed("alone") != 0.0
    assert moving == pytest.approx(20, abs=1)


def test_as_is_touches_nothing(start) -> None:
    start()
    drivers = Drivers("as-is", "lc2013", TEST_SEED)
    while not libsumo.simulation.getDepartedIDList():
        libsumo.simulationStep()
    vehicle = libsumo.simulation.getDepartedIDList()[0]
    before = (libsumo.vehicle.getTypeID(vehicle), libsumo.vehicle.getSpeedFactor(vehicle))
    assert drivers.apply(vehicle) == "as-is"
    assert (libsumo.vehicle.getTypeID(vehicle), libsumo.vehicle.getSpeedFactor(vehicle)) == before


def test_the_class_of_a_vehicle_depends_on_the_seed_and_its_id_alone(start) -> None:
    def classes(seed: int, order: int) -> dict[str, str]:
        drivers = Drivers("mixed", "lc2013", seed)
        for vehicle in sorted(vehicles, reverse=order < 0):
            drivers.apply(vehicle)
        return drivers.classes

    start()
    for _ in range(300):
        libsumo.simulationStep()
    vehicles = libsumo.vehicle.getIDList()
    assert classes(TEST_SEED, 1) == classes(TEST_SEED, -1)
    assert classes(TEST_SEED, 1) != classes(TEST_SEED + 1, 1)


def test_the_mixture_has_equal_parts() -> None:
    drivers = Drivers("mixed", "lc2013", TEST_SEED)
    drawn = [drivers.behaviors.draw("mixed", drivers.draws(f"v{i}")[0]).name for i in range(3000)]
    for name in CLASSES:
        assert drawn.count(name) == pytest.approx(1000, abs=100)  # 4 standard deviations


@pytest.mark.parametrize(
    ("behavior", "model", "named"),
    [("angry", "lc2013", "angry"), ("mixed", "gipps", "gipps"), ("as-is", "mobil", "mobil")],
)
def test_unknown_drivers_are_refused_by_name(behavior, model, named) -> None:
    with pytest.raises(BadInput, match=named):
        Drivers(behavior, model, 1)


def test_two_mobil_drivers_do_not_take_one_gap_from_both_sides(start) -> None:
    """Two standing lanes left and right of a free one: all want the middle, nobody touches."""
    start()
    drivers = Drivers("aggressive", "mobil", TEST_SEED)
    for i in range(12):
        for lane in (0, 2):
            name = f"x{lane}.{i}"
            libsumo.vehicle.add(name, "r", "car", departLane=str(lane), departPos=str(700 - 30 * i))
            libsumo.vehicle.setSpeedMode(name, 31)
    libsumo.simulationStep()
    for lane in (0, 2):  # the first of either lane stands
        libsumo.vehicle.setSpeed(f"x{lane}.0", 0.0)
    collided: set[tuple[str, str]] = set()
    for vehicle in libsumo.vehicle.getIDList():
        drivers.apply(vehicle)
        libsumo.vehicle.setLaneChangeMode(vehicle, STRATEGIC_ONLY)
    used_middle = set()
    for _ in range(200):
        libsumo.simulationStep()
        for vehicle in libsumo.simulation.getDepartedIDList():
            drivers.apply(vehicle)
        drivers.step(libsumo.simulation.getTime())
        collided.update((c.collider, c.victim) for c in libsumo.simulation.getCollisions())
        used_middle.update(v for v in libsumo.vehicle.getIDList() if libsumo.vehicle.getLaneIndex(v) == 1)
    assert collided == set()
    assert len([v for v in used_middle if v.startswith("x")]) >= 10
