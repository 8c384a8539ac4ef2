"""Preset `lawful`: from where one has to give way, an AV takes no gap that a human has to brake for."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import pytest
import sumo
from conftest import Start, vehicle

from cosim.host import Host
from cosim.scenario import Fleet, load
from cosim.types import Command, Decision, EpisodeResult, History, MetaAction, Preset
from cosim.workers.worker import Worker
from tests.law.drawn import build_net
from tests.law.test_lawful import Always

NODES = """<node id="w" x="-300" y="0"/><node id="m" x="-32" y="0"/>
<node id="j" x="0" y="0" type="priority"/><node id="e" x="300" y="0"/>
<node id="s" x="0" y="-150"/><node id="n" x="0" y="150"/>"""
EDGE = '<edge id="{}" from="{}" to="{}" priority="{}" numLanes="1" speed="13.89"/>'
MINOR = ("sj", "s", "j", 1), ("jn", "j", "n", 1)
ROADS = {  # the major road; its edges from the west to the east
    "whole": (("wj", "w", "j", 3), ("je", "j", "e", 3)),
    "in two pieces": (("wm", "w", "m", 3), ("mj", "m", "j", 3), ("je", "j", "e", 3)),
}
CAR = '<vType id="car" carFollowModel="IDM" sigma="0" speedDev="0" accel="2" decel="4.5" tau="1.2"/>'
TRAFFIC = f"""<routes>{CAR}
<route id="minor" edges="sj jn"/><route id="major" edges="{{major}}"/>
<vehicle id="hv" type="car" route="major" depart="{{human}}" departPos="60" departSpeed="13.8"/>
<vehicle id="av" type="car" route="minor" depart="10" departPos="60" departSpeed="8"/></routes>"""
TURN = f"""<routes>{CAR}
<route id="left" edges="B1A1 A1A0"/><route id="on" edges="left1A1 A1B1"/>
<vehicle id="av" type="car" route="left" depart="0" departPos="144.5" departSpeed="0"/>
<flow id="hv" type="car" route="on" begin="{{human}}" number="9" period="3" departPos="20" departSpeed="13"/>
</routes>"""
STREAM = f"""<routes>{CAR}
<route id="minor" edges="sj jn"/><route id="major" edges="wj je"/>
<flow id="hv" type="car" route="major" begin="0" number="10" period="3.5" departPos="60" departSpeed="13"/>
<vehicle id="av" type="car" route="minor" depart="10" departPos="60" departSpeed="8"/>
<vehicle id="{{lets}}" type="car" route="major" depart="35" departPos="60" departSpeed="13"/>
<flow id="h3" type="car" route="major" begin="38.5" number="15" period="3.5" departPos="60" departSpeed="13"/>
</routes>"""
CONFIG = """<configuration><net-file value="{net}"/><route-files value="{routes}"/>{more}<begin value="0"/>
<end value="{end}"/><step-length value="0.1"/></configuration>"""
MERGE = """<routes><vType id="ego" carFollowModel="IDM" sigma="0" speedDev="0" impatience="{impatience}"/>
<vType id="foe" carFollowModel="IDM" sigma="0" speedDev="0" decel="2.8"/>
<vehicle id="ego" type="ego" depart="0" departPos="100"><route edges="sj je"/></vehicle>
<vehicle id="foe" type="foe" depart="4" departPos="5" departSpeed="13"><route edges="wj je"/></vehicle>
</routes>"""
HUMAN = 4.0  # s, when the human departs: it is at the junction some seconds after the AV


class LetsGo(Always):
    """It commands for two seconds and hands the car back."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        began = getattr(self, "began", None)
        if histories and began is None:
            self.began = next(iter(histories.values())).time
        found = super().decide(histories)
        return {n: d for n, d in found.items() if histories[n].time < self.began + 2.0}


class Nears:
    """Drives a world, and says how far vehicles are from their next line, before them and afterwards."""

    def __init__(self, configuration: Path) -> None:
        import libsumo

        quiet = ["--no-step-log", "true", "--no-warnings", "true"]
        libsumo.start(["sumo", "-c", str(configuration), "--seed", "7", *quiet])
        self._configuration = configuration

    def measure(self, steps: int) -> dict[str, list[tuple[float, float]]]:
        """[m that `Gaps` says, m that it was] of those who were inside a junction then, and of all others."""
        import libsumo

        from cosim.simulation.convert import read_road
        from cosim.simulation.eyes import Eyes
        from cosim.simulation.lawful.gaps import Gaps
        from cosim.simulation.lawful.inside import Inside

        get, road = libsumo.vehicle, read_road((), self._configuration)
        eyes = Eyes(road)
        gaps = Gaps(road, Inside(road, eyes), eyes)
        said: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
        found: dict[str, list[tuple[float, float]]] = {"inside": [], "before": []}
        for step in range(steps):
            libsumo.simulationStep()
            for name in get.getIDList():
                lane, odometer = get.getLaneID(name), get.getDistance(name)
                line = odometer - get.getLanePosition(name)
                for where, metres, at in said.pop((name, lane), []):
                    found[where].append((metres, line - at))
                links = get.getNextLinks(name)
                if step % 5 or not links or not links[0][4]:
                    continue
                via = links[0][4]
                number = next(k for k, link in enumerate(road.links) if link.via == road.index[via])
                metres = gaps._to_line(name, number, get)
                assert metres is not None
                where = "inside" if lane.startswith(":") else "before"
                said.setdefault((name, via), []).append((where, metres, odometer))
        return found


def crossing_net(folder: Path, road: str) -> str:
    """The name of the net of a minor road that crosses a major one."""
    return build_net(folder, NODES, [EDGE.format(*edge) for edge in (*ROADS[road], *MINOR)])


def crossing(folder: Path, road: str, human: float) -> Path:
    """The .sumocfg of that net with one AV and one human."""
    net = crossing_net(folder, road)
    major = " ".join(edge[0] for edge in ROADS[road])
    (folder / "x.rou.xml").write_text(TRAFFIC.format(major=major, human=human))
    config = folder / "x.sumocfg"
    config.write_text(CONFIG.format(net=net, routes="x.rou.xml", more="", end=45))
    return config


def stream(folder: Path, lets: str) -> Path:
    """The .sumocfg of that net with an AV on the minor road, whose line somebody passes every 3.5 s on the
    major one for 90 s; one of them is called `lets`."""
    net = crossing_net(folder, "whole")
    (folder / "x.rou.xml").write_text(STREAM.format(lets=lets))
    config = folder / "x.sumocfg"
    config.write_text(CONFIG.format(net=net, routes="x.rou.xml", more="", end=75))
    return config


def turn_after_red(folder: Path, human: float) -> Path:
    """The .sumocfg of a signalised junction whose red lasts for 70 s; the human comes from opposite."""
    net = load("practice/lights").net
    program = next(t for t in ElementTree.parse(net).getroot().iter("tlLogic") if t.get("id") == "A1")
    program.set("programID", "long")
    program[0].set("duration", "70")
    (folder / "long.add.xml").write_bytes(b"<additional>" + ElementTree.tostring(program) + b"</additional>")
    (folder / "t.rou.xml").write_text(TURN.format(human=human))
    config = folder / "t.sumocfg"
    config.write_text(
        CONFIG.format(net=net, routes="t.rou.xml", more='<additional-files value="long.add.xml"/>', end=100)
    )
    return config


def drive(config: Path, policy: Always) -> EpisodeResult:
    fleet = Fleet(ids="av2?")
    with Worker(Host, load(str(config), preset=Preset.LAWFUL, fleet=fleet), policy, math.pi / 4) as worker:
        result: EpisodeResult = worker.call("run", 0)
    return result


@pytest.mark.parametrize(
    ("road", "policy"), [("whole", Always), ("in two pieces", Always), ("whole", LetsGo)]
)
def test_it_waits_for_who_comes_also_from_beyond_a_short_edge_and_when_handed_back(
    tmp_path: Path, road: str, policy: type[Always]
) -> None:
    result = drive(crossing(tmp_path, road, HUMAN), policy(MetaAction.ACCELERATE))

    assert result.value("right_of_way_violations") == 0
    assert result.value("hard_brakings") == 0
    assert result.value("av_trips_completed") == 1


def test_a_little_impatience_makes_sumos_driver_wait_for_who_is_far_away(tmp_path: Path) -> None:
    """docs/reference/sumo.md: for who brakes comfortably and comes to the same lane, more than 200 m off."""
    net = crossing_net(tmp_path, "whole")
    took = {}
    for impatience in (0.0, 0.1, 0.5):
        (tmp_path / "m.rou.xml").write_text(MERGE.format(impatience=impatience))
        words = ["-n", net, "-r", "m.rou.xml", "--step-length", "0.1", "--tripinfo-output", "trips.xml"]
        sumo_ = Path(sumo.SUMO_HOME) / "bin" / "sumo"
        subprocess.run([sumo_, *words], cwd=tmp_path, check=True, capture_output=True)
        trips = ElementTree.parse(tmp_path / "trips.xml").getroot()
        took[impatience] = next(float(t.get("waitingTime", 0)) for t in trips if t.get("id") == "ego")

    assert took[0.0] < 1.0
    assert took[0.5] < 1.0
    assert took[0.1] > 10.0


@pytest.mark.parametrize("human", [67.6, 68.4])
def test_who_stood_at_a_red_light_takes_no_smaller_gap(tmp_path: Path, human: float) -> None:
    """A left turn on green that must give way, after more than a minute of red."""
    result = drive(turn_after_red(tmp_path, human), Always(MetaAction.ACCELERATE))

    assert (result.value("right_of_way_violations"), result.value("hard_brakings")) == (0, 0)


@pytest.mark.parametrize(("lets", "crosses"), [("av2", True), ("hv2", False)])
def test_an_av_lets_one_in_that_has_waited_long_and_nobody_brakes_hard(
    tmp_path: Path, lets: str, crosses: bool
) -> None:
    """Where no AV is among those who have the right of way nobody lets it in."""
    result = drive(stream(tmp_path, lets), Always(MetaAction.ACCELERATE))

    assert ((result.value("av_trips_completed") or 0) > 0) is crosses
    assert (result.value("right_of_way_violations"), result.value("hard_brakings")) == (0, 0)


def test_a_parked_av_takes_commands_that_do_nothing(start: Start) -> None:
    stop = '<stop lane="main_in_0" endPos="160" duration="8" parking="true"/>'
    parked = vehicle("av", "av", 100.0, speed=10.0).replace("/>", f">{stop}</vehicle>")
    worker = start([parked], preset=Preset.LAWFUL)
    reasons = set()
    for _ in range(60):
        receipts, _ = worker.call("advance", [Command("av", 20.0, 1, 0.4)])
        reasons |= {receipt.blocked for receipt in receipts}
    assert "not on a lane" in reasons


def test_who_comes_is_as_far_from_its_line_as_it_then_drives_also_from_inside_the_junction_before(
    law_worlds: dict[str, Path],
) -> None:
    with Worker(Nears, law_worlds["priority"]) as worker:
        found = worker.call("measure", 600)

    for where, least in (("inside", 5), ("before", 200)):
        assert len(found[where]) > least
        assert max(abs(said - was) for said, was in found[where]) < 1.0
