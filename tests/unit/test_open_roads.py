"""Open roads: what is drawn is no test road, demands are fixed shares, and capacity is found by hand."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

import sumo_scenarios
from benchmarks import capacity, drives, published_capacity
from cosim.errors import BadInput
from cosim.scenario import load
from cosim.types import OnCollision
from sumo_scenarios import road_folders
from sumo_scenarios.draw import draw
from sumo_scenarios.roads import ALIKE, NAMED, LaneDrop, OnRamp, alike

DRAWN = [draw(seed) for seed in (*range(200), *range(100_000, 100_200))]


def test_no_drawn_road_is_alike_to_a_test_road_and_all_kinds_are_drawn() -> None:
    assert not [drawn for drawn in DRAWN if any(alike(drawn.road, named) for named in NAMED.values())]
    assert {drawn.road.kind for drawn in DRAWN} == set(NAMED)


def test_roads_are_alike_up_to_a_ratio_of_lengths_and_whatever_their_speed() -> None:
    named = NAMED["on_ramp"]
    assert isinstance(named, OnRamp)
    longer = named.acceleration_m * ALIKE
    assert alike(named, replace(named, acceleration_m=longer - 1.0, speed=20.0, ramp_share=0.4))
    assert not alike(named, replace(named, acceleration_m=longer))
    assert not alike(named, replace(named, lanes=3))
    assert alike(NAMED["lane_drop"], LaneDrop(before_m=900.0, from_the_right=False, speed=20.0))
    assert not alike(NAMED["lane_drop"], LaneDrop(lanes=4, after=3))
    assert not alike(NAMED["lane_drop"], named)


@pytest.mark.parametrize("seed", [-1, 200_000, 300_000])
def test_test_seeds_draw_no_road(seed: int) -> None:
    with pytest.raises(BadInput, match=r"0 to 199999"):
        draw(seed)


def test_a_seed_is_one_road_and_every_share_of_vehicles_has_a_way() -> None:
    assert draw(7) == draw(7) != draw(8)
    for road in (*NAMED.values(), *(drawn.road for drawn in DRAWN)):
        edges = {edge.get("id") for edge in ElementTree.fromstring(road.sources()["edg"]).iter("edge")}
        flows = road.flows()
        assert sum(flow.share for flow in flows) == pytest.approx(1.0)
        assert all(flow.share >= 0.0 and {flow.origin, flow.destination} <= edges for flow in flows)
        assert {*road.section.approaches, *road.section.exits} <= edges


@pytest.mark.parametrize("name", NAMED)
def test_demands_are_shares_of_the_measured_capacity(name: str) -> None:
    scenario = load(f"open/{name}")
    assert set(scenario.demands or ()) == {"below", "near", "over"}
    assert (scenario.behavior, scenario.on_collision, scenario.mission.kind) == (
        *("moderate", OnCollision.CONTINUE, "none"),
    )
    assert (scenario.warmup, scenario.duration, scenario.fleet.penetration) == (0.0, 1500.0, 0.2)
    for level, share in road_folders.LEVELS.items():
        flows = ElementTree.parse((scenario.demands or {})[level]).getroot().findall("flow")
        rates = [float(flow.get("period", "").removeprefix("exp(").removesuffix(")")) for flow in flows]
        assert 3600.0 * sum(rates) == pytest.approx(share * road_folders.capacities()[name], rel=1e-4)
        assert {(flow.get("begin"), flow.get("end")) for flow in flows} == {("0", "900")}


def test_a_copy_of_an_open_road_needs_a_name_of_its_own(tmp_path: Path) -> None:
    copy = tmp_path / "mine"
    shutil.copytree(sumo_scenarios.folder("open/lane_drop"), copy)
    with pytest.raises(BadInput, match="name yours otherwise"):
        load(str(copy))
    definition = copy / "scenario.yaml"
    definition.write_text(definition.read_text().replace("name: open/lane_drop", "name: mine/lane_drop"))
    assert load(str(copy)).behavior == "moderate"


def test_a_breakdown_lasts_and_capacity_is_the_largest_flow_before_it() -> None:
    """Speed falls for two minutes at first, then for good; flow before that is 10, 20, ... vehicles/h."""
    speeds = [30.0, 28.0, 10.0, 10.0, 28.0, 27.0, 26.0, 25.0, 10.0, 9.0, 11.0, 9.0, 8.0]
    assert capacity.slow("lane_drop") == 15.0
    assert capacity.breakdown(speeds, 15.0) == 8
    assert capacity.breakdown(speeds[:10], 15.0) is None
    rows = [
        capacity.Minute("lane_drop", "rising", 1, k, 0.0, 10.0 * k, 0.0, speed, 0)
        for k, speed in enumerate(speeds)
    ]
    assert capacity.before(rows) == pytest.approx(10.0 * (3 + 4 + 5 + 6 + 7) / 5)
    assert capacity.after(rows) == pytest.approx(10.0 * (10 + 11 + 12) / 3)
    assert capacity.before(rows[:8]) == pytest.approx(50.0), "without a breakdown, to the end"
    assert capacity.after(rows[:8]) is None


def test_rows_are_kept_as_they_are(tmp_path: Path) -> None:
    rows = [capacity.Minute("minor", "over", 100_000, 3, 1200.0, 960.0, 12.25, 4.5, 2)]
    capacity.write(tmp_path / "rows.csv", rows)
    assert drives.read(capacity.Minute, tmp_path / "rows.csv") == rows


def test_published_formulas_give_their_tabulated_values() -> None:
    """HCM: 2,400 at 70 mi/h, 2,250 at 55; a right turn onto 400 vehicles/h has room for 654."""
    assert published_capacity.motorway_lane(70 * 0.44704) == pytest.approx(2400.0)
    assert published_capacity.motorway_lane(55 * 0.44704) == pytest.approx(2250.0)
    assert published_capacity.gap_acceptance(400.0, 6.2, 3.3) == pytest.approx(654.3, abs=0.1)
    assert published_capacity.gap_acceptance(0.0, 6.2, 3.3) == pytest.approx(3600.0 / 3.3)
    assert all(published_capacity.capacity(road) > 1000.0 for road in NAMED.values())
