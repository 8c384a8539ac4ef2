"""Open roads in SUMO: what is committed is what the parameters say; every policy meets the same demand."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from cosim.episode import Episode, Hook, Step, run_episode
from cosim.host import Host
from cosim.scenario import Scenario, load
from cosim.scenario.vet import vetted
from cosim.types import EpisodeResult
from cosim.workers.worker import Worker
from sumo_scenarios import draw, folder, open_roads, road_folders
from sumo_scenarios.roads import NAMED


def drive(scenario: Scenario, policy: str = "idm") -> EpisodeResult:
    """One short episode of a validation seed."""
    with Worker(Host, vetted(scenario), policy, 0.0) as worker:
        result: EpisodeResult = worker.call("run", 100_000)
        return result


def files(place: Path) -> dict[str, str]:
    """Path below `place` -> text."""
    found = sorted(file for file in place.rglob("*") if file.is_file())
    return {str(file.relative_to(place)): file.read_text(encoding="utf-8") for file in found}


def test_the_six_roads_ship() -> None:
    assert set(open_roads()) == {f"open/{name}" for name in NAMED}


@pytest.mark.parametrize("name", NAMED)
def test_the_folder_is_what_its_parameters_write(name: str, tmp_path: Path) -> None:
    demands = road_folders.named(name, road_folders.capacities()[name])
    road_folders.write(NAMED[name], tmp_path / name, f"open/{name}", demands, road_folders.DEFAULT)
    assert files(tmp_path / name) == files(folder(f"open/{name}"))


@pytest.mark.parametrize("name", NAMED)
def test_traffic_flows_and_whatever_drives_the_avs_the_same_vehicles_are_due(name: str) -> None:
    scenario = load(f"open/{name}", demand=["over"], duration=90.0)
    one, other = drive(scenario), drive(scenario, "idm-courteous")
    assert one.value("vehicles_due") == other.value("vehicles_due")
    assert (one.value("vehicles_due") or 0) > 15
    assert (one.value("mean_speed_mps") or 0.0) > 5.0
    assert one.value("collisions") == one.value("vehicles_never_inserted") == 0
    assert one.validity == ()


@pytest.mark.parametrize("seed", [0, 3, 100_004])
def test_a_drawn_road_is_driven(seed: int, tmp_path: Path) -> None:
    scenario = load(str(draw.write(seed, tmp_path)), duration=40.0)
    assert scenario.name == f"drawn/{seed}"
    assert drive(scenario).validity == ()


@pytest.mark.parametrize("svo", [0.0, math.pi / 4.0])
def test_a_vehicle_whose_lane_ends_signals_and_the_yield_rule_eases_off_unless_egoistic(svo: float) -> None:
    host = Host(load("open/on_ramp", demand=["over"], duration=100.0), "yield-rule", svo)
    eased, signals = Counter[bool](), Counter[int]()

    class Watch(Hook):
        def on_step(self, episode: Episode, step: Step) -> None:
            eased.update(decision.accel is not None for decision in step.decisions.values())
            signals.update(step.after.indicator[np.isin(step.after.lane, ends)].tolist())

    try:
        ends = [host.episode.simulator.road.index["joining_0"]]
        run_episode(host.episode, host.policy, 100_000, svo=svo, hooks=[Watch()])
    finally:
        host.close()
    assert signals[1] > 0.9 * signals.total() > 0.0
    assert eased.total() > 0
    assert (eased[True] > 0) == (svo > 0.0)
