"""Every world: its net is what its sources say, plain SUMO runs it, every demand flows and varies by seed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
from xml.etree import ElementTree

import pytest

from cosim.scenario import Scenario, load
from cosim.scenario.vet import vet
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Kind, Snapshot
from cosim.workers.worker import Worker
from sumo_scenarios import folder, names, practice, shipped
from sumo_scenarios.build import net_text

WORLDS = names()
ALL = [(world, demand) for world in shipped() for demand in load(world).demands or ()]
DEMANDS = [(world, demand) for world, demand in ALL if world in (*WORLDS, *practice())]


def first_frames(scenario: Scenario, seeds: tuple[int, ...]) -> list[Snapshot]:
    """The last frame of the warm-up for each seed."""
    with Worker(SumoSimulator, scenario) as worker:
        return [worker.call("reset", seed)[-1] for seed in seeds]


@pytest.mark.parametrize("world", shipped())
def test_the_net_is_the_one_its_plain_sources_build(world: str) -> None:
    assert net_text(folder(world)) == (folder(world) / "net.net.xml").read_text()


@pytest.mark.parametrize("world", WORLDS)
def test_plain_sumo_runs_the_world(world: str) -> None:
    sumo = shutil.which("sumo", path=sysconfig.get_path("scripts")) or "sumo"
    done = subprocess.run(
        [sumo, "-c", str(folder(world) / f"{world}.sumocfg"), "--end", "60", "--no-step-log"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "collision" not in done.stderr.lower()
    assert "Error" not in done.stderr


@pytest.mark.parametrize("world", WORLDS)
def test_goal_and_conflict_zones_are_edges_of_the_net(world: str) -> None:
    scenario = load(world)
    edges = {e.get("id", "") for e in ElementTree.parse(scenario.net).getroot().iter("edge")}
    assert set(scenario.mission.goal) <= edges
    for zone in scenario.zones:
        assert all(any(e == z or e.startswith(f"{z}_") for e in edges) for z in zone.edges)


@pytest.mark.parametrize(("world", "demand"), ALL)
def test_a_demand_states_its_flows_and_is_sound(world: str, demand: str) -> None:
    scenario = load(world, demand=[demand])
    text = scenario.demand[0].read_text()
    comments = " ".join(re.findall(r"<!--(.*?)-->", text, re.DOTALL))
    assert re.search(r"veh(icles)?(/h| per hour)", comments, re.IGNORECASE), "how much traffic, in words"
    assert vet(scenario).warnings == ()


@pytest.mark.parametrize(("world", "demand"), DEMANDS)
def test_each_seed_is_another_episode_and_nobody_has_crashed_when_the_clock_starts(
    world: str, demand: str
) -> None:
    one, other, again = first_frames(load(world, demand=[demand]), (100_001, 100_002, 100_001))
    assert one.ids == again.ids
    assert (one.x == again.x).all(), "the same seed is the same episode"
    assert one.ids != other.ids or (one.x != other.x).any()
    if demand != "free":
        assert (one.kind == int(Kind.AV)).any(), "there are AVs"
    assert one.mission.sum() == (0 if load(world).mission.kind == "none" else 1)
    assert not one.events.collisions


def test_a_mission_vehicle_s_character_does_not_depend_on_what_was_driven_before() -> None:
    """Paired seeds are paired: the same vehicles at the same speeds, whatever the process drove before."""
    scenario = load("merge", demand=["contested"])
    plain = first_frames(scenario, (100_003,))[0]
    with Worker(SumoSimulator, scenario) as worker:
        worker.call("reset", 100_005)
        worker.call("advance", ())
        mixed = worker.call("reset", 100_003)[-1]
    assert plain.ids == mixed.ids
    assert (plain.speed == mixed.speed).all()
