"""Devices, walkers, lanes without a limit and replaced files of a user's configuration: as in plain SUMO."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.scenario import load
from tests.roads import two_lanes

SPEED = "@@"
NET = two_lanes(1000, SPEED)
CARS = """<routes>@@<vType id="car" maxSpeed="30" speedDev="0"/>
<flow id="f" type="car" from="ab" to="bc" begin="0" end="30" period="5" departLane="best" departSpeed="max"/>
@@</routes>"""
ACCELERATES = """
from cosim.types import Decision, MetaAction, ObservationConfig

class Fast:
    name, label, av_parameters, observation = "fast", "", {}, ObservationConfig(maps=False)

    def reset(self, context):
        pass

    def decide(self, histories):
        return {name: Decision(MetaAction.ACCELERATE) for name in histories}
"""
Write = Callable[..., str]


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """A user's configuration with these options, demand before and behind the cars, and speed limit (m/s); it
    is run in a folder of its own."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def write(options: str = "", before: str = "", behind: str = "", limit: float = 25.0) -> str:
        (tmp_path / "n.net.xml").write_text(NET.replace(SPEED, f"{limit:g}"))
        first, middle, last = CARS.split(SPEED)
        (tmp_path / "r.rou.xml").write_text(first + before + middle + behind + last)
        file = tmp_path / "user.sumocfg"
        file.write_text(
            '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/><end value="90"/>'
            f"{options}</configuration>"
        )
        return str(file)

    return write


@pytest.fixture
def drive(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def run(*arguments: str) -> dict[str, Any]:
        assert main(["run", *arguments, "--mission", "none", "--json"]) == 0
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        return document

    return run


Drive = Callable[..., dict[str, Any]]
NO_AVS, AVS = ("--penetration", "0"), ("--penetration", "0.5")


@pytest.mark.parametrize("fleet", [NO_AVS, AVS])
def test_devices_of_the_configuration_are_in_tripinfo(
    config: Write, drive: Drive, tmp_path: Path, fleet: tuple[str, str]
) -> None:
    file = config('<device.emissions.probability value="1"/><device.battery.explicit value="f.1"/>')
    drive(file, *fleet, "--output", "tripinfo", "--out", str(tmp_path / "run"))
    trips = ElementTree.parse(tmp_path / "run" / "outputs" / "tripinfo.xml").getroot()
    assert len(trips) == 6
    assert all(float(e.get("CO2_abs", "0")) > 0.0 for e in trips.iter("emissions"))
    assert len([*trips.iter("emissions")]) == 6
    assert [trip.get("id") for trip in trips if trip.find("battery") is not None] == ["f.1"]


def test_a_device_that_fills_files_of_its_own_writes_none(config: Write, drive: Drive) -> None:
    watched = '<vType id="w"><param key="has.ssm.device" value="true"/></vType>'
    watched += '<vehicle id="w" type="w" depart="0"><route edges="ab bc"/></vehicle>'
    drive(config('<device.ssm.probability value="1"/>', before=watched), "--duration", "20")
    assert [*Path.cwd().iterdir()] == []


WAY = '<route id="way" edges="bc ab"/>'
PLANS = {
    "a walk against the traffic": f'{WAY}<person id="p" depart="1"><walk route="way"/></person>',
    "a flow": f'{WAY}<personFlow id="p" begin="1" period="5" number="4"><walk route="way"/></personFlow>',
    "a ride": '<person id="p" depart="1"><ride from="ab" to="bc" lines="f.1"/></person>',
    "a container": '<container id="p" depart="1"><transport from="ab" to="bc" lines="f.1"/></container>',
    "a container on its own": '<container id="p" depart="1"><tranship from="bc" to="ab"/></container>',
}


@pytest.mark.parametrize("plan", PLANS)
def test_persons_and_containers_take_ways_that_no_vehicle_can(config: Write, drive: Drive, plan: str) -> None:
    found = drive(config(behind=PLANS[plan]), *AVS, "--duration", "40")
    assert found["not_comparable_because"] == []


@pytest.mark.parametrize("preset", ["unguarded", "guarded", "lawful"])
def test_on_a_lane_without_a_limit_a_vehicles_own_top_speed_holds(
    config: Write, drive: Drive, tmp_path: Path, preset: str
) -> None:
    (tmp_path / "fast.py").write_text(ACCELERATES)
    run, policy = tmp_path / "run", f"{tmp_path / 'fast.py'}:Fast"
    flags = ["--policy", policy, "--preset", preset, "--penetration", "1", "--output", "fcd"]
    found = drive(config(limit=1000.0), *flags, "--out", str(run))
    rows = ElementTree.parse(run / "outputs" / "fcd.xml").getroot().iter("vehicle")
    speeds = np.array([float(row.get("speed", "nan")) for row in rows])
    assert 29.5 < speeds.max() <= 30.0 + 1e-6
    assert (found["speeding_share"], found["collisions"]) == (0.0, 0)
    assert found["av_trips_completed"] > 3


def test_another_demand_drives_where_the_files_own_is_missing(
    config: Write, drive: Drive, tmp_path: Path
) -> None:
    file = config()
    (tmp_path / "r.rou.xml").rename(tmp_path / "mine.rou.xml")
    with pytest.raises(BadInput, match="no such file"):
        load(file)
    mine = str(tmp_path / "mine.rou.xml")
    assert drive(file, "--demand", mine, "--duration", "20")["vehicles_inserted"] > 3
    assert load(file, options=["--route-files", mine]).demand == (Path(mine),)


def test_a_lane_change_that_takes_no_time_is_executed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "left.py").write_text(
        "from cosim.types import MetaAction\ndef left(seen): return MetaAction.LANE_LEFT\n"
    )
    arguments = ["run", "highway", "--policy", f"{tmp_path}/left.py:left", "--preset", "guarded", "--json"]
    assert main([*arguments, "--duration", "10", "--", "--lanechange.duration", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["lane_changes_commanded"] > 0
