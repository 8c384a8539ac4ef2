"""Our time to collision, DRAC and post-encroachment time against SUMO's SSM device, on the same drives."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from cosim.geometry import (
    Boxes,
    deceleration_to_avoid_crash,
    post_encroachment_time,
    time_to_collision,
)
from cosim.host import Host
from cosim.metrics import MetricContext
from cosim.metrics.context import CRITICAL
from cosim.metrics.time_to_collision import TimeToCollision
from cosim.recording.recorder import Recorder
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.vet import vetted
from cosim.types import Timing
from cosim.workers.worker import Worker

# Lanes as wide as the vehicles: SUMO's conflict area of a crossing is as wide as the lanes, ours as wide as
# the vehicles, so that only here the two must agree to the last digit.
WIDTH = 2.0  # m
LENGTH = 5.0  # m
STEP = 0.1  # s

NODES = """<nodes>
    <node id="w" x="-300" y="0"/> <node id="e" x="300" y="0"/>
    <node id="s" x="0" y="-300"/> <node id="n" x="0" y="300"/> <node id="c" x="0" y="0" type="priority"/>
</nodes>"""
EDGES = f"""<edges>
    <edge id="wc" from="w" to="c" numLanes="1" speed="30" width="{WIDTH}" priority="2"/>
    <edge id="ce" from="c" to="e" numLanes="1" speed="30" width="{WIDTH}" priority="2"/>
    <edge id="sc" from="s" to="c" numLanes="1" speed="30" width="{WIDTH}" priority="1"/>
    <edge id="cn" from="c" to="n" numLanes="1" speed="30" width="{WIDTH}" priority="1"/>
</edges>"""
CONNECTIONS = """<connections>
    <connection from="wc" to="ce"/> <connection from="sc" to="cn"/>
</connections>"""
MERGING = """<connections>
    <connection from="wc" to="ce"/> <connection from="sc" to="ce"/>
</connections>"""
ROUTES = """<routes>
    <vType id="car" length="{length}" width="{width}" carFollowModel="IDM" minGap="2" tau="1"/>
    <route id="east" edges="wc ce"/> <route id="north" edges="sc cn"/>
    <vehicle id="ego" type="car" route="east" depart="0" departPos="{ego_at}" departSpeed="{ego_speed}"/>
    <vehicle id="foe" type="car" route="{foe_route}" depart="0" departPos="{foe_at}"
             departSpeed="{foe_speed}"/>
</routes>"""

# Runs in a process of its own: one simulation per process (sumo.md). Speeds given are held exactly;
# a vehicle without one is driven by IDM.
DRIVER = """
import json, sys
import libsumo
net, routes, log, out, speeds, step = *sys.argv[1:5], json.loads(sys.argv[5]), sys.argv[6]
libsumo.start(["sumo", "-n", net, "-r", routes, "--step-length", step, "--no-step-log", "--precision", "6",
    "--collision.action", "warn", "--collision.mingap-factor", "0", "--device.ssm.explicit", "ego",
    "--device.ssm.measures", "TTC DRAC PET", "--device.ssm.thresholds", "100 0.0 10",
    "--device.ssm.trajectories", "true", "--device.ssm.range", "200", "--device.ssm.extratime", "10",
    "--device.ssm.file", log])
frames = []
for _ in range(250):
    libsumo.simulationStep()
    for name in libsumo.vehicle.getIDList():
        if name in speeds:
            libsumo.vehicle.setSpeedMode(name, 32)
            libsumo.vehicle.setSpeed(name, speeds[name])
        x, y = libsumo.vehicle.getPosition(name)
        frames.append([libsumo.simulation.getTime(), name, x, y, libsumo.vehicle.getAngle(name),
                       libsumo.vehicle.getSpeed(name)])
libsumo.close()
json.dump(frames, open(out, "w"))
"""


class Drive(NamedTuple):
    """Both vehicles' trajectories and what the SSM device said of them."""

    ego: Boxes  # [T]
    foe: Boxes  # [T]
    ttc: np.ndarray[Any, Any]  # [T] s, SUMO's, NaN for NA
    drac: np.ndarray[Any, Any]  # [T] m/s2, SUMO's, NaN for NA
    pet: float  # s, SUMO's, NaN for NA


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two roads that cross at a right angle."""
    return built(tmp_path_factory.mktemp("crossing"), NODES, CONNECTIONS)


def built(folder: Path, nodes: str, connections: str) -> Path:
    """netconvert's net of these nodes and connections."""
    for name, text in (("nod", nodes), ("edg", EDGES), ("con", connections)):
        (folder / f"plain.{name}.xml").write_text(text)
    spec = importlib.util.find_spec("sumo")  # the eclipse-sumo package
    assert spec is not None
    assert spec.submodule_search_locations is not None
    netconvert = Path(spec.submodule_search_locations[0]) / "bin" / "netconvert"
    subprocess.run(
        [netconvert, "-n", "plain.nod.xml", "-e", "plain.edg.xml", "-x", "plain.con.xml", "-o", "net.xml"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return folder / "net.xml"


def drive(net: Path, folder: Path, speeds: dict[str, float], **departures: object) -> Drive:
    """Let both drive for 25 s; `speeds` m/s are held, `departures` fill ROUTES."""
    routes, log, out = folder / "routes.rou.xml", folder / "ssm.xml", folder / "frames.json"
    routes.write_text(ROUTES.format(length=LENGTH, width=WIDTH, **departures))
    subprocess.run(
        [sys.executable, "-c", DRIVER, net, routes, log, out, json.dumps(speeds), str(STEP)],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    frames: dict[str, dict[int, tuple[float, ...]]] = {"ego": {}, "foe": {}}
    for time, name, x, y, angle, speed in json.loads(out.read_text()):
        heading = float(np.radians(90.0 - angle))  # SUMO: degrees clockwise from north, front bumper
        centre = (x - 0.5 * LENGTH * np.cos(heading), y - 0.5 * LENGTH * np.sin(heading))
        frames[name][round(time / STEP)] = (*centre, heading, speed)
    steps = sorted(set(frames["ego"]) & set(frames["foe"]))
    tables = {name: np.array([frames[name][k] for k in steps]) for name in frames}  # [T,4]
    boxes = {
        name: Boxes(table[:, 0], table[:, 1], table[:, 2], LENGTH, WIDTH, table[:, 3])
        for name, table in tables.items()
    }
    ttc, drac, pet = np.full((2, len(steps)), np.nan)[0], np.full(len(steps), np.nan), float("nan")
    for conflict in ElementTree.parse(log).getroot().findall("conflict"):
        # the device stamps what holds after a step with the step's beginning
        at = [round(t / STEP) + 1 for t in spans(conflict, "timeSpan")]
        for series, tag in ((ttc, "TTCSpan"), (drac, "DRACSpan")):
            for k, value in zip(at, spans(conflict, tag), strict=True):
                if k in steps:
                    series[steps.index(k)] = value
        found = conflict.find("PET")
        if found is not None and found.get("value") != "NA":
            pet = float(found.attrib["value"])
    return Drive(boxes["ego"], boxes["foe"], ttc, drac, pet)


def every_other(b: Boxes) -> Boxes:
    x, y, heading, speed = (np.asarray(v)[::2] for v in (b.x, b.y, b.heading, b.speed))
    return Boxes(x, y, heading, b.length, b.width, speed)


def spans(conflict: ElementTree.Element, tag: str) -> list[float]:
    element = conflict.find(tag)
    assert element is not None
    return [float("nan") if v == "NA" else float(v) for v in element.attrib["values"].split()]


def compare(seen: Drive, least: int) -> None:
    """TTC to 1 ms, DRAC to 0.1 % or 5 mm/s2 up to 5 m/s2, on at least `least` frames before contact."""
    ours = time_to_collision(seen.ego, seen.foe)
    # the last half second is left out: SUMO's crossing DRAC then forgets that who stops does not reverse
    before = np.isfinite(seen.ttc) & (seen.ttc > 0.5)
    assert before.sum() >= least
    assert ours[before] == pytest.approx(seen.ttc[before], abs=1e-3)
    braking = deceleration_to_avoid_crash(seen.ego, seen.foe)
    gentle = before & (seen.drac < 5.0)
    assert gentle.sum() >= least
    assert braking[gentle] == pytest.approx(seen.drac[gentle], rel=1e-3, abs=5e-3)


def test_closing_in_at_constant_speeds_agrees_with_the_ssm_device(net: Path, tmp_path: Path) -> None:
    seen = drive(
        net, tmp_path, {"ego": 18.0, "foe": 10.0},
        ego_at=20, ego_speed=18, foe_route="east", foe_at=140, foe_speed=10,
    )  # fmt: skip
    compare(seen, least=100)


def test_an_idm_driver_braking_behind_a_slow_leader_agrees_with_the_ssm_device(
    net: Path, tmp_path: Path
) -> None:
    seen = drive(
        net, tmp_path, {"foe": 8.0}, ego_at=20, ego_speed=25, foe_route="east", foe_at=120, foe_speed=8
    )
    compare(seen, least=50)
    assert np.ptp(seen.ego.speed) > 10.0  # it did brake


@pytest.mark.parametrize(
    ("foe_at", "foe_speed"), [(94, 15.0), (138, 12.0)], ids=["equal speeds", "the slower one is hit"]
)
def test_a_crossing_conflict_agrees_with_the_ssm_device(
    net: Path, tmp_path: Path, foe_at: int, foe_speed: float
) -> None:
    seen = drive(
        net, tmp_path, {"ego": 15.0, "foe": foe_speed},
        ego_at=100, ego_speed=15, foe_route="north", foe_at=foe_at, foe_speed=foe_speed,
    )  # fmt: skip
    compare(seen, least=100)


def test_merging_at_45_degrees_is_closer_by_our_definition_until_both_are_on_one_lane(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SUMO counts to where the lanes have become one, cosim to where the straight ways meet."""
    monkeypatch.setitem(globals(), "ROUTES", ROUTES.replace('"sc cn"', '"sc ce"'))
    nodes = NODES.replace('id="s" x="0" y="-300"', 'id="s" x="-200" y="-200"')
    seen = drive(
        built(tmp_path, nodes, MERGING), tmp_path, {"ego": 15.0, "foe": 12.0},
        ego_at=100, ego_speed=15, foe_route="north", foe_at=123, foe_speed=12,
    )  # fmt: skip
    both = np.isfinite(seen.ttc) & (seen.ttc > 0.5)
    ours, theirs = time_to_collision(seen.ego, seen.foe)[both], seen.ttc[both]
    apart = np.abs(np.remainder(seen.ego.heading - seen.foe.heading + np.pi, 2 * np.pi) - np.pi)[both] > 0.7
    assert apart.sum() > 50
    assert (ours[apart] < theirs[apart] - 0.2).all()
    assert (ours[apart] > theirs[apart] - 0.5).all()


@pytest.mark.parametrize("foe_at", [65, 130], ids=["the other passes second", "the other passes first"])
def test_the_post_encroachment_time_of_a_crossing_agrees_with_the_ssm_device(
    net: Path, tmp_path: Path, foe_at: int
) -> None:
    seen = drive(
        net, tmp_path, {"ego": 15.0, "foe": 15.0},
        ego_at=100, ego_speed=15, foe_route="north", foe_at=foe_at, foe_speed=15,
    )  # fmt: skip
    assert 1.0 < seen.pet < 3.0
    assert post_encroachment_time(seen.ego, seen.foe, STEP) == pytest.approx(seen.pet, abs=1e-3)
    assert post_encroachment_time(every_other(seen.ego), every_other(seen.foe), 2 * STEP) == pytest.approx(
        seen.pet, abs=1e-3
    )  # at the metrics' frame rate too
    assert not np.isfinite(time_to_collision(seen.ego, seen.foe)).any()
    assert np.isnan(seen.ttc).all()


# ---- whole worlds ----

BETWEEN_FRAMES = 0.1  # s: SUMO looks at every step of 0.1 s, cosim at every second one
MERGES = 15.0  # degrees between two courses
ASKEW = np.radians(1.0)


class Pairs(NamedTuple):
    """Who came near whom in one episode."""

    ours: dict[tuple[str, str], str]  # how they met: "edge" on one edge, "angle" at an angle, "row" in a row
    theirs: dict[tuple[str, str], float]  # s, the smallest time to collision
    askew: set[tuple[str, str]]  # of theirs, who was then not in one direction


class Driven:
    """Drives in a worker with an SSM device on every vehicle; near-misses by time to collision."""

    def __init__(self, world: str, errors: str | None) -> None:
        case = EpisodeOptions(
            world,
            demand=("dense",),
            seed=0,
            warmup=0.0,
            duration=80.0,
            on_collision="continue",
            errors=errors,
        )
        self._host = Host(vetted(case.scenario(())), "idm", 0.0)

    def pairs(self, seed: int, folder: Path) -> Pairs:
        recorder = Recorder()
        self._host.run(seed, hooks=[recorder], outputs=("ssm",), folder=folder)
        road, frames = self._host.simulator.road, recorder.frames[recorder.first :]
        metric = TimeToCollision()
        metric.reset(frames[0], MetricContext(road, Timing(), "none", frozenset(), 80.0))
        for frame in frames[1:]:
            metric.add(frame)
        at = {round(frame.time, 3): frame for frame in frames}
        ours = {}
        for met in metric.near_misses.counted:
            s = at[round(met.last, 3)]
            i, j = (s.row[name] for name in met.pair)
            edges = {road.lanes[s.lane[row]].edge for row in (i, j)}
            turned = abs(np.degrees(np.remainder(s.heading[i] - s.heading[j] + np.pi, 2 * np.pi) - np.pi))
            ours[met.pair] = (
                "row" if s.lane[i] == s.lane[j] else
                "edge" if len(edges) == 1 else
                "angle" if turned > MERGES else "row"
            )  # fmt: skip
        theirs: dict[tuple[str, str], float] = {}
        askew = set()
        for conflict in ElementTree.parse(folder / "ssm.xml").getroot().findall("conflict"):
            found = conflict.find("minTTC")
            if found is not None and found.get("value") != "NA":
                a, b = sorted((conflict.attrib["ego"], conflict.attrib["foe"]))
                theirs[a, b] = min(theirs.get((a, b), np.inf), float(found.attrib["value"]))
                s = min(frames, key=lambda frame: abs(frame.time - float(found.attrib["time"]) - STEP))
                if not {a, b} <= s.row.keys() or abs(s.heading[s.row[a]] - s.heading[s.row[b]]) > ASKEW:
                    askew.add((a, b))
        return Pairs(ours, theirs, askew)


@pytest.mark.parametrize(
    ("world", "errors"),
    [("merge", "stress"), ("highway", "stress"), ("roundabout", None), ("intersection", None)],
)
def test_near_misses_of_whole_worlds_agree_with_the_ssm_device(
    world: str, errors: str | None, tmp_path: Path
) -> None:
    """What SUMO's device calls near by time to collision, cosim counts, but for who is changing lanes and
    steers clear of the other: the device knows nothing of that. What only cosim counts are changes of lanes
    too, and vehicles that merge or cross at an angle, whom the device takes to where the lanes are one."""
    agreed = 0
    with Worker(Driven, world, errors) as worker:
        for seed in range(200_000, 200_004):
            folder = tmp_path / str(seed)
            folder.mkdir()
            ours, theirs, askew = worker.call("pairs", seed, folder)
            near = {pair for pair, ttc in theirs.items() if ttc < CRITICAL - BETWEEN_FRAMES}
            assert near - ours.keys() <= askew
            only_ours = [pair for pair in ours if theirs.get(pair, np.inf) >= CRITICAL]
            assert {ours[pair] for pair in only_ours} <= {"edge", "angle"}
            agreed += len(near & ours.keys())
    assert agreed > 0
