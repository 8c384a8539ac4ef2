"""Persons, bicycles and trucks as actors, and signals, on a street with a signalled crossing."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sumo

from cosim.episode import Episode
from cosim.geometry import gap_ahead
from cosim.scenario import Fleet, Scenario, load
from cosim.simulation.backend import sumo as sumo_calls
from cosim.simulation.sumo import SumoSimulator
from cosim.types import COMPACT, Actor, EpisodeResult, Kind, Preset, Snapshot
from cosim.workers.worker import Worker

NODES = """<nodes>
    <node id="a" x="0" y="0"/><node id="b" x="150" y="0" type="traffic_light"/>
    <node id="c" x="300" y="0"/><node id="d" x="150" y="-100"/>
</nodes>"""
EDGES = """<edges>
    <edge id="ab" from="a" to="b" numLanes="1" speed="13.89" sidewalkWidth="2" bikeLaneWidth="1.5"/>
    <edge id="ba" from="b" to="a" numLanes="1" speed="13.89" sidewalkWidth="2"/>
    <edge id="bc" from="b" to="c" numLanes="1" speed="13.89" sidewalkWidth="2" bikeLaneWidth="1.5"/>
    <edge id="cb" from="c" to="b" numLanes="1" speed="13.89" sidewalkWidth="2"/>
    <edge id="bd" from="b" to="d" numLanes="1" speed="13.89"/>
</edges>"""
CROSSING = '<connections><crossing node="b" edges="ab ba"/></connections>'
TYPES = """
    <vType id="ped" vClass="pedestrian" width="0.6"/>
    <vType id="bike" vClass="bicycle"/>
    <vType id="lorry" vClass="truck"/>
    <vType id="av" length="5" width="2" speedDev="0" maxSpeed="10"/>
"""
MIXED = """
    <vehicle id="bus" depart="0" departPos="40">
        <route edges="ab bc"/><stop lane="ab_2" endPos="60" duration="2"/>
    </vehicle>
    <vehicle id="one" type="bike" depart="0" departPos="20"><route edges="ab bc"/></vehicle>
    <vehicle id="lorry" type="lorry" depart="0" departPos="20"><route edges="cb ba"/></vehicle>
    <person id="rider" depart="0" departPos="60"><ride from="ab" to="bc" lines="bus"/></person>
    <person id="waiter" depart="0" departPos="50"><stop edge="ab" endPos="50" duration="300"/></person>
    <person id="one" depart="0" departPos="130" type="ped"><walk from="ab" to="ba" arrivalPos="30"/></person>
    <person id="back" depart="0" departPos="90"><walk from="bd" to="bc" arrivalPos="40"/></person>
"""
COMING = """
    <personFlow id="f" begin="1" period="4" number="5000" departPos="100" type="ped">
        <walk from="ab" to="ab" arrivalPos="112"/>
    </personFlow>
"""
# on the roadway of bd, which has no sidewalk, 30 m ahead of the AV
IN_THE_WAY = """
    <vehicle id="av" type="av" depart="0" departPos="5" departSpeed="10"><route edges="bd"/></vehicle>
    <person id="slow" depart="0" departPos="40" type="ped"><walk from="bd" to="bd" arrivalPos="95"/></person>
"""


class Street:
    """A simulator of the street, driven in a worker."""

    def __init__(self, scenario: Scenario) -> None:
        self._simulator = SumoSimulator(scenario)
        self._scenario = scenario

    def frames(self, seconds: float) -> list[Snapshot]:
        found = list(self._simulator.reset(0))
        for _ in range(round(seconds / 0.4)):
            found += self._simulator.advance([])[1]
        return found

    def persons(self, seconds: float) -> tuple[list[Snapshot], list[set[str]], int]:
        """The frames at the end of each decision, who SUMO says is there then, and how often it was asked."""
        get, asked = sumo_calls.person, 0

        def listed() -> tuple[str, ...]:
            nonlocal asked
            asked += 1
            found: tuple[str, ...] = get.getIDList()
            return found

        sumo_calls.person = SimpleNamespace(**{**vars(get), "getIDList": listed})
        try:
            self._simulator.reset(0)
            told = [
                (self._simulator.advance([])[1][-1], {f"person:{i}" for i in get.getIDList()})
                for _ in range(round(seconds / 0.4))
            ]
        finally:
            sumo_calls.person = get
        return [frame for frame, _ in told], [there for _, there in told], asked

    def episode(self) -> EpisodeResult:
        episode = Episode(self._scenario, self._simulator, COMPACT)
        episode.start(0)
        while not episode.over:
            episode.advance({})
        return episode.result("idm", "", 0.0)

    def gap_of_av(self, snapshot: Snapshot) -> float:
        row = np.array([snapshot.row["av"]])
        return float(gap_ahead(snapshot, self._simulator.road.straight_on, row)[0][0])

    def signals(self) -> tuple[tuple[tuple[str, int], ...], int]:
        road = self._simulator.road
        return road.signals, road.crossings[0].signal

    def edges(self) -> dict[str, int]:
        return self._simulator.road.contact.edges

    def close(self) -> None:
        self._simulator.close()


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    for name, text in {"n": NODES, "e": EDGES, "x": CROSSING}.items():
        (folder / f"{name}.xml").write_text(text)
    netconvert = Path(sumo.__file__).parent / "bin" / "netconvert"
    options = [f"-{name}={folder / name}.xml" for name in "nex"]
    made = [f"--output-file={folder / 'net.net.xml'}", "--walkingareas", "--no-turnarounds"]
    subprocess.run([netconvert, *options, *made], check=True, capture_output=True)
    return folder / "net.net.xml"


@pytest.fixture
def street(net: Path, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Worker]:
    demand = tmp_path / "d.rou.xml"
    demand.write_text(f"<routes>{TYPES}{request.param}</routes>")
    config = tmp_path / "street.sumocfg"
    config.write_text(
        f'<configuration><net-file value="{net}"/><route-files value="d.rou.xml"/><end value="60"/>'
        '<step-length value="0.1"/></configuration>'
    )
    scenario = load(str(config), fleet=Fleet(type="av"), duration=12.0, warmup=0.2, preset=Preset.UNGUARDED)
    worker = Worker(Street, scenario, timeout=60.0)
    yield worker
    worker.close()


@pytest.mark.parametrize("street", [MIXED], indirect=True)
def test_walking_persons_are_rows_and_those_in_vehicles_or_waiting_are_not(street: Worker) -> None:
    frames: list[Snapshot] = street.call("frames", 20.0)
    names = {name for frame in frames for name in frame.ids}
    assert names == {"bus", "lorry", "one", "person:back", "person:one"}
    first = frames[3]
    assert first.ids == tuple(sorted(first.ids))
    who = {name: (first.kind[row], first.actor[row]) for name, row in first.row.items()}
    assert who == {
        "bus": (Kind.HV, Actor.CAR),
        "lorry": (Kind.HV, Actor.TRUCK),
        "one": (Kind.HV, Actor.BICYCLE),
        "person:back": (Kind.PERSON, Actor.PERSON),
        "person:one": (Kind.PERSON, Actor.PERSON),
    }
    assert first.vehicles.ids == ("bus", "lorry", "one")
    assert first.vehicles.signals is first.signals


@pytest.mark.parametrize("street", [COMING], indirect=True)
def test_sumo_is_asked_for_the_persons_of_a_flow_only_when_one_comes_or_goes(street: Worker) -> None:
    frames, there, asked = street.call("persons", 60.0)
    assert [set(frame.ids) for frame in frames] == there
    assert len(set.union(*there)) == 15
    assert len(there[-1]) < 5, "they arrive"
    assert 15 < asked < 40, "of 300 frames"


@pytest.mark.parametrize("street", [MIXED], indirect=True)
def test_persons_walk_where_sumo_says(street: Worker) -> None:
    frames: list[Snapshot] = street.call("frames", 20.0)
    a, b = (f for f in frames if round(f.time, 1) in (2.2, 4.2))
    for name, towards in (("person:one", 0.0), ("person:back", np.pi / 2)):
        i, j = a.row[name], b.row[name]
        moved = b.x[j] - a.x[i], b.y[j] - a.y[i]
        assert np.hypot(*moved) == pytest.approx(2.0 * a.speed[i], rel=0.3)
        assert np.arctan2(moved[1], moved[0]) == pytest.approx(a.heading[i], abs=0.05)
        assert a.heading[i] == pytest.approx(towards, abs=0.05)
        assert a.lane[i] < 0
    row = a.row["person:one"]
    assert (a.length[row], a.width[row]) == (0.215, 0.6)
    edges = street.call("edges")
    assert a.place[row] == -2 - edges["ab"], "on the sidewalk of the AVs' road"
    assert a.place[a.row["one"]] == -2 - edges["ab"], "on its cycle lane"
    assert a.place[a.row["bus"]] == a.lane[a.row["bus"]]
    waiting = frames[-1]
    assert waiting.speed[waiting.row["person:one"]] == 0.0, "who waits at a red crossing is on the road"


@pytest.mark.parametrize("street", [MIXED], indirect=True)
def test_signals_stand_in_the_order_of_the_road_map(street: Worker) -> None:
    frames: list[Snapshot] = street.call("frames", 90.0)
    signals, crossing = street.call("signals")
    assert {len(f.signals) for f in frames} == {len(signals)}
    states = {chr(f.signals[crossing]) for f in frames}
    assert states == {"r", "G"}, "a crossing knows no yellow"
    walks = next(f for f in frames if f.signals[crossing] == ord("G"))
    assert "r" in bytes(walks.signals).decode(), "while persons walk, somebody waits"


@pytest.mark.parametrize("street", [IN_THE_WAY], indirect=True)
def test_a_person_is_nobodys_leader_but_counts_in_conflicts(street: Worker) -> None:
    frames: list[Snapshot] = street.call("frames", 0.4)
    assert street.call("gap_of_av", frames[-1]) == np.inf
    result: EpisodeResult = street.call("episode")
    assert result.value("min_ttc_s") is not None
    assert result.value("dt_hv_m") is None
    assert result.value("min_headway_s") is None
    assert result.value("vehicles_inserted") == 1
