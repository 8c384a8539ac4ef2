"""A user's vehicle stays itself: whoever drives it, SUMO does with it what plain SUMO does."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import libsumo
import pytest
import sumo

from cosim.host import Host
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.vet import vetted
from cosim.types import Decision, History, MetaAction, ObservationConfig, PolicyContext, Preset
from cosim.workers.worker import Worker

# Two lanes with a way off at b; at c a side road comes in at a signal, and behind it the road is faster.
NODES = """<nodes>
    <node id="o" x="-100" y="0"/>
    <node id="a" x="0" y="0"/><node id="b" x="400" y="0"/><node id="off" x="600" y="-80"/>
    <node id="c" x="900" y="0" type="traffic_light" tl="c"/><node id="side" x="900" y="-300"/>
    <node id="far" x="900" y="-500"/><node id="d" x="1500" y="0"/>
</nodes>"""
EDGES = """<edges>
    <edge id="pre" from="o" to="a" numLanes="2" speed="25"/>
    <edge id="in" from="a" to="b" numLanes="2" speed="25"/>
    <edge id="main" from="b" to="c" numLanes="2" speed="25"/>
    <edge id="out" from="c" to="d" numLanes="2" speed="25"/>
    <edge id="exit" from="b" to="off" numLanes="1" speed="20"/>
    <edge id="far" from="far" to="side" numLanes="1" speed="14"/>
    <edge id="side" from="side" to="c" numLanes="1" speed="14"/>
</edges>"""
# the side road's green grows while buses come, and not for others
SIGNAL = """<tlLogics><tlLogic id="c" type="actuated" programID="0" offset="0">
    <param key="vTypes" value="bus"/><param key="max-gap" value="6"/>
    <phase duration="40" minDur="40" maxDur="40" state="rGG"/>
    <phase duration="5" minDur="5" maxDur="60" state="Grr"/>
</tlLogic></tlLogics>"""
PLACES = """<additional>
    <busStop id="here" lane="in_0" startPos="200" endPos="230"/>
    <busStop id="there" lane="main_0" startPos="100" endPos="130"/>
    <containerStop id="pier" lane="in_0" startPos="240" endPos="270"/>
    <containerStop id="yard" lane="main_0" startPos="140" endPos="170"/>
    <parkingArea id="lot" lane="in_0" startPos="280" endPos="300" roadsideCapacity="2" acceptedBadges="gold"/>
    <rerouter id="leave" edges="in" vTypes="fleet">
        <interval begin="0" end="1000"><destProbReroute id="exit" probability="1"/></interval>
    </rerouter>
    <e3Detector id="count" file="e3.xml" period="1000" vTypes="van">
        <detEntry lane="in_0" pos="50"/><detEntry lane="in_1" pos="50"/>
        <detExit lane="in_0" pos="380"/><detExit lane="in_1" pos="380"/>
    </e3Detector>
    <variableSpeedSign id="faster" lanes="out_0 out_1"><step time="0" speed="33.3"/></variableSpeedSign>
</additional>"""
ROUTES = """<routes>
    <vType id="bus" vClass="bus" personCapacity="12" boardingDuration="0.5" color="red">
        <param key="has.ssm.device" value="false"/><param key="owner" value="city"/>
    </vType>
    <vType id="truck" vClass="truck" containerCapacity="2" loadingDuration="5"/>
    <vType id="guest" parkingBadges="gold silver" emissionClass="HBEFA4/PC_diesel_Euro-6ab"/>
    <vType id="limo" speedDev="0"/>
    <vTypeDistribution id="fleet">
        <vType id="car" probability="0.5"/><vType id="van" vClass="delivery" probability="0.5"/>
    </vTypeDistribution>
    <route id="through" edges="pre in main out"/>
    <personFlow id="rider" begin="0" end="1" number="8">
        <stop busStop="here" duration="1"/><ride busStop="there" lines="1"/>
    </personFlow>
    <container id="box0" depart="0">
        <stop containerStop="pier" duration="1"/><transport containerStop="yard" lines="2"/>
    </container>
    <container id="box1" depart="0">
        <stop containerStop="pier" duration="1"/><transport containerStop="yard" lines="2"/>
    </container>
    <vehicle id="bus" type="bus" route="through" depart="0" line="1">
        <stop busStop="here" duration="10"/><stop busStop="there" duration="10"/>
    </vehicle>
    <vehicle id="limo" type="limo" depart="0"><route edges="out"/></vehicle>
    <flow id="queue" type="bus" begin="0" end="1" number="8"><route edges="far side out"/></flow>
    <vehicle id="truck" type="truck" route="through" depart="3" line="2">
        <stop containerStop="pier" duration="20"/><stop containerStop="yard" duration="20"/>
    </vehicle>
    <vehicle id="guest" type="guest" route="through" depart="6">
        <stop parkingArea="lot" duration="10"/>
    </vehicle>
    <flow id="fleet" type="fleet" route="through" begin="9" period="3" number="6" departLane="1"/>
</routes>"""
CRASH = """<routes>
    <vType id="bus" vClass="bus"/>
    <person id="waits" depart="0"><stop busStop="there" duration="900"/></person>
    <vehicle id="broken" depart="0" departPos="300"><route edges="in main"/>
        <stop lane="in_0" endPos="330" duration="900"/>
    </vehicle>
    <vehicle id="bus" type="bus" depart="10" departLane="0"><route edges="pre in main"/></vehicle>
    <person id="rider" depart="triggered"><ride from="pre" to="main" lines="bus"/></person>
</routes>"""
SECONDS = 100.0
OUTPUTS = ("tripinfo", "stop")


class Found(NamedTuple):
    """What SUMO did with vehicles, by their names and by their types."""

    riders: set[str]  # who was carried
    containers: set[str]
    parked: set[str]
    rerouted: set[str]
    through: set[str]  # from the side road
    counted: set[str]


class Faster:
    """A policy that asks every AV for more speed at every decision."""

    name, label = "faster", ""
    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None:
        """Nothing to forget."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        return {av: Decision(MetaAction.ACCELERATE) for av in histories}


class Looker:
    """A hook: what no output of SUMO's says."""

    def __init__(self) -> None:
        self.counted: set[str] = set()
        self.fastest: dict[str, float] = {}  # on the faster road, m/s
        self.kinds: dict[str, tuple[Any, ...]] = {}
        self.passed: set[str] = set()
        self.rerouted: set[str] = set()

    def on_start(self, episode: Any = None) -> None:
        self.on_step()

    def on_step(self, episode: Any = None, step: Any = None) -> None:
        get = libsumo.vehicle
        self.counted.update(libsumo.multientryexit.getLastStepVehicleIDs("count"))
        for name in get.getIDList():
            self.kinds[name] = (
                *(
                    get.getVehicleClass(name),
                    get.getPersonCapacity(name),
                    get.getBoardingDuration(name),
                    get.getColor(name),
                ),
                *(get.getEmissionClass(name), get.getMaxSpeed(name), get.getLength(name)),
                libsumo.vehicletype.getParameter(get.getTypeID(name), "owner"),
            )
            if get.getRoute(name)[-1] == "exit":
                self.rerouted.add(name)
            if get.getRoadID(name) == "out":
                self.passed.add(name)
                self.fastest[name] = max(self.fastest.get(name, 0.0), get.getSpeed(name))


class Driven(Host):
    """An episode, and what was seen in it."""

    def drive(self, folder: Path) -> tuple[Any, Looker, set[str]]:
        looker = Looker()
        result = self.run(140_000, hooks=[looker], outputs=OUTPUTS, folder=folder)  # type: ignore[list-item]
        return result, looker, set(self.simulator.driver_classes())


class Plain:
    """SUMO as it is."""

    def __init__(self, config: Path) -> None:
        self._start = ["sumo", "-c", str(config), "--step-length", "0.1", "--no-warnings", "--seed", "140000"]

    def drive(self, folder: Path) -> Looker:
        written = [text for name in OUTPUTS for text in (f"--{name}-output", str(folder / f"{name}.xml"))]
        libsumo.start([*self._start, *written, "--no-step-log", "--tripinfo-output.write-unfinished"])
        looker = Looker()
        while libsumo.simulation.getTime() < SECONDS:
            libsumo.simulationStep()
            looker.on_step()
        libsumo.close()
        return looker

    def close(self) -> None:
        """It has ended."""


def found(folder: Path, looker: Looker) -> Found:
    trips = ElementTree.parse(folder / "tripinfo.xml").getroot()
    stops = ElementTree.parse(folder / "stop.xml").getroot()

    def arrived(tag: str, stage: str) -> set[str]:
        return {
            who.get("id", "")
            for who in trips.iter(tag)
            for s in who.iter(stage)
            if float(s.get("arrival", "")) >= 0.0
        }

    return Found(
        riders=arrived("personinfo", "ride"),
        containers=arrived("containerinfo", "transport"),
        parked={stop.get("id", "") for stop in stops if stop.get("parkingArea") == "lot"},
        rerouted=looker.rerouted,
        through={name for name in looker.passed if name.startswith("queue")},
        counted=looker.counted,
    )


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("road")
    for name, text in (("nod", NODES), ("edg", EDGES), ("tll", SIGNAL), ("add", PLACES), ("rou", ROUTES)):
        (folder / f"r.{name}.xml").write_text(text)
    netconvert = Path(sumo.__file__).parent / "bin" / "netconvert"
    files = ["-n", "r.nod.xml", "-e", "r.edg.xml", "-i", "r.tll.xml", "-o", "r.net.xml"]
    subprocess.run([netconvert, *files, "--no-turnarounds"], cwd=folder, check=True, capture_output=True)
    (folder / "r.sumocfg").write_text(
        '<configuration><net-file value="r.net.xml"/><route-files value="r.rou.xml"/>'
        f'<additional-files value="r.add.xml"/><end value="{SECONDS:g}"/></configuration>'
    )
    return folder / "r.sumocfg"


@pytest.fixture(scope="module")
def plain(config: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Found, Looker]:
    folder = tmp_path_factory.mktemp("plain")
    with Worker(Plain, config, timeout=60.0) as worker:
        looker = worker.call("drive", folder)
    return found(folder, looker), looker


def drive(scenario: Scenario, policy: Any, folder: Path) -> tuple[Any, Looker, set[str]]:
    with Worker(Driven, vetted(scenario), policy, 0.0, timeout=120.0) as worker:
        driven: tuple[Any, Looker, set[str]] = worker.call("drive", folder)
    return driven


def test_the_road_does_what_is_asked_of_it(plain: tuple[Found, Looker]) -> None:
    seen, looker = plain
    assert seen.riders == {f"rider.{k}" for k in range(8)}
    assert seen.containers == {"box0", "box1"}
    assert seen.parked == {"guest"}
    assert seen.rerouted == {f"fleet.{k}" for k in range(6)}
    assert len(seen.through) == 8
    assert 0 < len(seen.counted) < 6, "vans and no cars"
    assert looker.fastest["limo"] == pytest.approx(33.3, abs=0.5)


@pytest.mark.parametrize(
    ("policy", "preset"), [("idm", Preset.LAWFUL), *((Faster(), preset) for preset in Preset.ALL)]
)
def test_an_av_is_the_vehicle_that_its_file_says(
    policy: Any, preset: str, config: Path, plain: tuple[Found, Looker], tmp_path: Path
) -> None:
    scenario = load(str(config), fleet=Fleet(ids=".*"), preset=preset, mission="none")
    result, looker, _ = drive(scenario, policy, tmp_path)
    wanted, in_plain = plain
    seen = found(tmp_path, looker)
    assert seen.rerouted == wanted.rerouted
    if preset != Preset.UNGUARDED:  # which drives over stops, and into others
        assert seen == wanted
    assert looker.kinds == in_plain.kinds
    assert looker.fastest["limo"] > 33.0
    if preset == Preset.LAWFUL:
        assert result.value("speeding_share") == 0.0


def test_a_human_of_table_ii_drives_the_vehicle_that_its_file_says(
    config: Path, plain: tuple[Found, Looker], tmp_path: Path
) -> None:
    scenario = load(str(config), behavior="mixed", mission="none")
    _, looker, humans = drive(scenario, "idm", tmp_path)
    wanted, in_plain = plain
    assert humans == looker.kinds.keys()
    counted = {name for name in looker.kinds if looker.kinds[name][0] == "delivery"}
    assert found(tmp_path, looker) == wanted._replace(counted=counted), "cars and vans are drawn anew"
    for name in humans - wanted.rerouted:
        assert looker.kinds[name] == in_plain.kinds[name]


def test_a_bus_that_crashes_is_taken_away_with_its_riders(config: Path, tmp_path: Path) -> None:
    demand = tmp_path / "crash.rou.xml"
    demand.write_text(CRASH)
    fleet = Fleet(ids="bus")
    scenario = load(str(config), demand=[str(demand)], fleet=fleet, preset=Preset.UNGUARDED, mission="none")
    result, _, _ = drive(scenario, Faster(), tmp_path)
    assert result.value("wrecks_removed") == 2
    assert result.value("av_trips_completed") == 0


def test_a_distribution_names_all_vehicles_drawn_from_it(config: Path, tmp_path: Path) -> None:
    scenario = load(str(config), fleet=Fleet(type="fleet"), mission="none")
    result, _, _ = drive(scenario, "idm", tmp_path)
    trips = ElementTree.parse(tmp_path / "tripinfo.xml").getroot().iter("tripinfo")
    avs = {trip.get("id", "") for trip in trips if trip.get("vType", "").startswith("cosim.av.")}
    assert avs == {f"fleet.{k}" for k in range(6)}
    assert result.value("av_trips_completed") == 6
    assert result.validity == ()
