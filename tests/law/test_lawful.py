"""Preset `lawful`: the car keeps the law whoever commands it, and says where it drove otherwise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import libsumo
import numpy as np
import pytest
from conftest import Start, vehicle

from cosim.control import COMFORT_ACCEL, MAX_JERK, lawful_speed, wished_accel
from cosim.host import Host
from cosim.road.rules import RulesAhead
from cosim.scenario import load
from cosim.scenario.human_errors import levels
from cosim.scenario.sensing import read
from cosim.scenario.vet import vetted
from cosim.simulation.lawful import follower, inside, way
from cosim.simulation.lawful.car import Car
from cosim.simulation.lawful.waves import Waves
from cosim.simulation.sumo import SumoSimulator
from cosim.types import (
    Command,
    Decision,
    EpisodeResult,
    History,
    MetaAction,
    ObservationConfig,
    PolicyContext,
    Preset,
)
from cosim.workers.worker import Worker

SEED = 100_000
STEP = 0.1  # s


class Always:
    """Asks every AV for the same, whatever comes."""

    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}
    label = ""

    def __init__(self, action: MetaAction) -> None:
        self.name, self.action = action.name.lower(), action

    def reset(self, context: PolicyContext) -> None:
        pass

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        return {av: Decision(self.action) for av in histories}


def drive(
    what: Path | str,
    policy: object,
    preset: str = Preset.LAWFUL,
    share: float = 1.0,
    seed: int = SEED,
    duration: float = 60.0,
) -> EpisodeResult:
    scenario = load(str(what), preset=preset, penetration=share, duration=duration)
    with Worker(Host, scenario, policy, math.pi / 4) as worker:
        result: EpisodeResult = worker.call("run", seed)
    return result


@pytest.mark.parametrize("seed", [100_001, 100_004])
def test_who_can_stop_comfortably_stops_for_yellow(law_worlds: dict[str, Path], seed: int) -> None:
    """SUMO's driver alone drives on at about 79 s: it adds its headway to its braking distance."""
    result = drive(law_worlds["arterial"], Always(MetaAction.ACCELERATE), seed=seed, duration=82.0)
    assert result.value("red_light_violations") == 0


@pytest.mark.parametrize("world", ["grid_signals", "all_way_stop", "crossing_unsignalled", "lane_drop"])
def test_whoever_always_accelerates_breaks_no_law_in_lawful(law_worlds: dict[str, Path], world: str) -> None:
    result = drive(law_worlds[world], Always(MetaAction.ACCELERATE))

    broken = ("red_light_violations", "stop_sign_violations", "av_involved_collisions", "avs_stuck")
    assert [result.value(name) for name in broken] == [0, 0, 0, 0]
    assert (result.value("worst_speeding_mps") or 0.0) < 1.0
    assert (result.value("interventions") or 0) > 0
    assert sum(result.interventions_by_reason.values()) == result.value("interventions")


def test_the_same_agent_unguarded_runs_red_lights(law_worlds: dict[str, Path]) -> None:
    result = drive(law_worlds["grid_signals"], Always(MetaAction.ACCELERATE), Preset.UNGUARDED)

    assert (result.value("red_light_violations") or 0) > 0
    assert result.value("interventions") == 0


def test_nobody_stands_for_ever_though_the_agent_only_brakes(law_worlds: dict[str, Path]) -> None:
    result = drive(law_worlds["lane_drop"], Always(MetaAction.DECELERATE))

    assert result.value("avs_stuck") == 0
    assert (result.value("dt_av_m") or 0.0) > 50.0


def test_keep_lane_always_drives_unguarded() -> None:
    assert drive("merge", "keep-lane").preset == Preset.UNGUARDED


class Unheeding(Host):
    """A host whose AVs drive without regard to who follows."""

    def run(self, *args: object, **options: object) -> EpisodeResult:
        follower.INATTENTION = (0.0, 0.5)
        return super().run(*args, **options)  # type: ignore[arg-type]


def hit_from_behind(host: type[Host], seeds: Sequence[int]) -> list[bool]:
    """Whether an AV was hit by a human, in each of these episodes of drivers who err."""
    scenario = load("intersection", demand=["contested"], preset=Preset.LAWFUL)
    scenario = vetted(replace(scenario, errors=levels()["stress"]))
    with Worker(host, scenario, Always(MetaAction.ACCELERATE), math.pi / 4) as worker:
        found: list[EpisodeResult] = [worker.call("run", seed) for seed in seeds]
    return [any(c.victim_is_av and not c.collider_is_av for c in result.collisions) for result in found]


def test_the_car_makes_room_for_who_closes_in_and_does_not_brake() -> None:
    seeds = (100_103, 100_117, 100_123)
    assert all(hit_from_behind(Unheeding, seeds))
    assert not any(hit_from_behind(Host, seeds))


@pytest.mark.parametrize("sensing", ["ideal", "v2v"])
def test_it_slows_down_before_a_human_who_brakes(start: Start, sensing: str) -> None:
    """No evasion, though estimates of the human's braking are late and noisy."""
    pair = [vehicle("av", "av", 160.0, speed=11.0), vehicle("human", "hv", 140.0, speed=11.0)]
    worker = start(pair, preset=Preset.LAWFUL, sensing=read(sensing))
    frames = [f for _ in range(15) for f in worker.call("advance", [Command("av", 2.0, 0, 0.4)])[1]]
    speeds = [float(f.speed[f.row["av"]]) for f in frames]
    assert speeds[-1] == pytest.approx(2.0, abs=0.2)
    assert all(after < before + 0.1 for before, after in pairwise(speeds))


class Unseeing(SumoSimulator):
    """One human keeps his speed whoever is ahead; `told`: whether AVs hear of it from one behind."""

    def look_away(self, name: str, told: bool) -> None:
        follower.WARNING_RANGE = follower.WARNING_RANGE if told else (0.0, 0.0)
        libsumo.vehicle.setSpeedMode(name, 0)
        libsumo.vehicle.setSpeed(name, 13.0)


@pytest.mark.parametrize("told", [True, False])
def test_avs_ahead_make_room_for_a_queue_that_somebody_drives_into(start: Start, told: bool) -> None:
    queue = [vehicle("first", "av", 160.0, speed=4.0), vehicle("last", "av", 151.0, speed=4.0)]
    human = vehicle("human", "hv", 105.0, speed=13.0)
    worker = start([*queue, human], simulator=Unseeing, preset=Preset.LAWFUL)
    worker.call("look_away", "human", told)
    hit = False
    for _ in range(14):
        lets_in = [Command("first", 4.0, 0, 0.4), Command("last", 30.0, 0, 0.4)]
        frames = worker.call("advance", lets_in)[1]
        hit = hit or any(c.victim_is_av for frame in frames for c in frame.events.collisions)
    assert hit is not told


def test_from_a_stop_sign_it_enters_no_gap_that_a_human_has_to_brake_for(law_worlds: dict[str, Path]) -> None:
    accelerate = Always(MetaAction.ACCELERATE)
    result = drive(law_worlds["stop_signs"], accelerate, share=0.2, seed=100_013, duration=90.0)

    assert result.value("right_of_way_violations") == 0


@pytest.mark.parametrize("seed", [102_007, 102_010])
def test_who_comes_from_behind_makes_it_take_no_smaller_gap(law_worlds: dict[str, Path], seed: int) -> None:
    """A human closes in on an AV that waits on the minor road while somebody comes on the major one."""
    result = drive(
        law_worlds["priority"], Always(MetaAction.ACCELERATE), share=0.2, seed=seed, duration=100.0
    )

    assert result.value("right_of_way_violations") == 0


@pytest.mark.parametrize(("world", "seed"), [("stop_signs", 150_006), ("priority", 150_034)])
def test_who_has_waited_long_takes_no_gap_that_a_human_has_to_brake_for(
    law_worlds: dict[str, Path], world: str, seed: int
) -> None:
    """SUMO's drivers become impatient while they stand."""
    result = drive(law_worlds[world], "random", share=0.2, seed=seed, duration=120.0)

    assert result.value("right_of_way_violations") == 0


@pytest.mark.parametrize("seed", [150_035, 150_043])
def test_who_has_waited_long_goes_before_those_who_stand_opposite(
    law_worlds: dict[str, Path], seed: int
) -> None:
    """SUMO's driver waits for them for more than a minute, while they wait for others."""
    result = drive(law_worlds["stop_signs"], "vfn-p", share=0.2, seed=seed, duration=120.0)

    assert (result.value("avs_stuck"), result.value("right_of_way_violations")) == (0, 0)


def test_who_has_waited_long_takes_its_gap_though_the_agent_brakes(law_worlds: dict[str, Path]) -> None:
    result = drive(law_worlds["stop_signs"], "random", share=0.2, seed=150_008, duration=120.0)

    assert result.value("avs_stuck") == 0


def test_a_bus_changes_no_lanes_before_it_has_turned_off_a_junction(law_worlds: dict[str, Path]) -> None:
    """SUMO would turn it at once, its rear into the bus beside it."""
    result = drive(law_worlds["mixed_types"], "random", seed=101_010, duration=110.0)

    assert result.value("av_involved_collisions") == 0


@pytest.mark.parametrize("seed", [200_004, 200_015])
def test_nobody_starts_inside_a_junction_into_one_that_stands_in_its_way(
    law_worlds: dict[str, Path], seed: int
) -> None:
    """SUMO's driver starts, and hits one there: at once, or after ten seconds."""
    result = drive(law_worlds["crossing_signals"], "random", seed=seed, duration=100.0)

    assert result.value("av_involved_collisions") == 0


@pytest.mark.parametrize(
    ("world", "seed"),
    [
        ("crossing_signals", 150_015),
        ("crossing_signals", 150_039),
        ("crossing_signals", 160_026),
        ("mixed_types", 150_013),
        ("mixed_types", 150_019),
    ],
)
def test_nobody_drives_into_one_who_stands_inside_a_junction_with_his_tail_at_least(
    law_worlds: dict[str, Path], world: str, seed: int
) -> None:
    """Who stands there; who begins to walk, or walks while one drives; a truck's tail; a change of lanes
    begun before the line."""
    result = drive(law_worlds[world], "random", seed=seed, duration=120.0)

    assert result.value("av_involved_collisions") == 0


@pytest.mark.parametrize(("world", "seed"), [("priority", 162_005), ("crossing_signals", 162_006)])
def test_nobody_drives_into_one_who_slowly_comes_to_where_he_waits_inside_a_junction(
    law_worlds: dict[str, Path], world: str, seed: int
) -> None:
    """SUMO's drivers pass each other there, and the net has no room for both."""
    result = drive(law_worlds[world], "vfn-p", seed=seed, duration=120.0)

    assert result.value("av_involved_collisions") == 0


def test_who_stands_close_beside_another_stays_where_its_turn_would_touch_him() -> None:
    """Of two trucks side by side one turns; that it wants more room than there is beside it is no reason to
    start."""
    beside = np.array([[0.0], [2.51], [0.0], [12.0], [2.5]])
    straight = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [12.0] * 3, [2.5] * 3])
    turn = straight + np.array([[0.0] * 3, [0.0, 0.2, 0.6], [0.0, 0.1, 0.2], [0.0] * 3, [0.0] * 3])

    def starts(way: np.ndarray) -> bool:
        return not any(inside._will_touch(mine, beside) for mine in (way, way + inside.STANDING_MARGIN))

    assert starts(straight)
    assert not starts(turn)


def test_who_waits_inside_a_junction_goes_before_those_who_stand_for_somebody_else(
    law_worlds: dict[str, Path],
) -> None:
    """One that has stopped just behind its line is in the way of who has the right of way, and waits for one
    inside, who waits for him."""
    result = drive(law_worlds["priority"], "random", seed=200_018, duration=120.0)

    assert result.value("av_trips_completed") > 10, "so many had got away before"


def test_it_goes_before_no_av_that_would_brake_hard_for_it(law_worlds: dict[str, Path]) -> None:
    """SUMO's driver enters 40 m before one that drives 14 m/s, who then brakes with more than 3 m/s2."""
    result = drive(law_worlds["priority"], "vfn-p", seed=163_012, duration=60.0)

    assert result.value("right_of_way_violations") == 0


def test_who_stands_inside_a_junction_stays_for_who_may_come_but_not_for_ever_as_for_who_is_there() -> None:
    class Full:
        there = False

        def way_from_standstill(self, name: str, lane: str, present: bool, waved: object) -> inside.WayOut:
            return inside.WayOut(0.0) if self.there or not present else inside.CLEAR

        def way_ahead(self, name: str, lane: str, waved: object) -> inside.WayOut:
            return inside.WayOut(3.0) if self.there else inside.CLEAR

    full = Full()
    rule = way.Way(full, Waves(), STEP)  # type: ignore[arg-type]

    def stays(lane: str, speed: float, steps: int = 1) -> int:
        car = Car(0.0, name="av", lane=lane, speed=speed, in_junction=lane.startswith(":"))
        return sum(rule.limit(car).accel < 0.0 for _ in range(steps))

    assert stays(":j_0_0", 0.5) == 0, "it rolls"
    assert stays(":j_0_0", 0.0, 200) == pytest.approx(way.PATIENCE / STEP, abs=1)
    assert stays("", 5.0) == 0, "it is out"
    assert stays(":k_0_0", 0.0) == 1, "another junction"
    full.there = True
    assert stays(":k_0_0", 0.0, 200) == 200, "somebody stands there"
    assert [stays(":k_0_0", speed) for speed in (2.0, 4.0)] == [0, 1], "it stops before him"
    rule._way_ahead = lambda *_: (inside.WayOut(3.0), 2.0)  # type: ignore[method-assign]
    assert stays("w_0", 2.9, 400) == 400, "before its line it waits as long as he stands there"


def test_it_comes_to_a_stop_comfortably_and_does_not_creep_there(start: Start) -> None:
    standing = vehicle("standing", "hv", 150.0, speed=0.0, more='speedFactor="0.001"')
    worker = start([standing, vehicle("av", "av", 60.0, speed=10.0)], preset=Preset.LAWFUL)
    speeds = []
    for _ in range(50):
        frames = worker.call("advance", [Command("av", 30.0, 0, 0.4)])[1]
        speeds += [frame.speed[frame.row["av"]] for frame in frames]

    frame = 2.0 * STEP  # s
    slow = [v for v in speeds if v < 2.0]
    assert slow[-1] < 0.1
    assert np.diff(slow).min() > -2.0 * frame
    assert sum(v > 0.1 for v in slow) * frame < 3.0  # s


def test_it_drives_as_fast_as_the_agent_asks_and_no_faster(start: Start) -> None:
    """SUMO's driver, left alone for single steps, would accelerate up to the speed limit."""
    worker = start([vehicle("av", "av", 20.0, speed=8.0)], preset=Preset.LAWFUL)
    speeds = []
    for _ in range(25):
        frames = worker.call("advance", [Command("av", 12.0, 0, 0.4)])[1]
        speeds += [frame.speed[frame.row["av"]] for frame in frames]

    assert max(speeds) < 12.1
    assert speeds[-1] > 11.8
    assert np.abs(np.diff(speeds, 2)).max() < 1.1 * MAX_JERK * (2.0 * STEP) ** 2


def test_it_follows_a_small_acceleration(start: Start) -> None:
    worker = start([vehicle("av", "av", 20.0, speed=8.0)], preset=Preset.LAWFUL)
    frames = [worker.call("advance", [Command("av", 30.0, 0, 0.4, accel=0.3)])[1][-1] for _ in range(15)]
    speeds = [frame.speed[frame.row["av"]] for frame in frames]
    assert np.diff(speeds[1:]) == pytest.approx(0.3 * 0.4, abs=0.03)


def beside_a_lane_end(start: Start, *standing: float) -> float:
    """m that the AV is from the end of the lane that it must leave, after 20 s; inf if it has left the lane.
    `standing`: m to that end of humans who stand beside."""
    length, road = 114.5, '<route edges="main_acc main_out"/>'
    humans = [
        f'<vehicle id="h{k}" type="hv" depart="0" departLane="1" departPos="{length - away}">{road}'
        f'<stop lane="main_acc_1" endPos="{length - away}" duration="1000"/></vehicle>'
        for k, away in enumerate(standing)
    ]
    departure = 'depart="0" departLane="0" departPos="40" departSpeed="10"'
    av = f'<vehicle id="av" type="av" {departure}>{road}</vehicle>'
    worker = start([*humans, av], preset=Preset.LAWFUL)
    for _ in range(50):
        frame = worker.call("advance", [Command("av", 25.0, 0, 0.4)])[1][-1]
    row = frame.row["av"]
    return length - float(frame.lane_position[row]) if frame.y[row] < -7.0 else math.inf  # the lane at -8 m


def test_before_the_end_of_its_lane_it_leaves_room_for_who_stands_further_ahead(
    start: Start,
) -> None:
    queue = 0.5, 7.5, *range(20, 105, 7)
    assert 11.0 < beside_a_lane_end(start, *queue) < 14.0


def test_it_uses_that_room_to_get_in_front_of_who_stands_beside_it(start: Start) -> None:
    assert beside_a_lane_end(start, 13.0) == math.inf


def test_what_the_agent_wishes_is_comfortable_and_its_jerk_bounded() -> None:
    speed, accel, course = 25.0, 0.0, [0.0]
    for _ in range(120):
        asked, accel = wished_accel(speed, 0.0, accel, STEP)
        speed = max(speed + accel * STEP, 0.0)
        course.append(accel)
        assert -COMFORT_ACCEL <= asked <= COMFORT_ACCEL
    assert np.abs(np.diff(course)).max() <= MAX_JERK * STEP + 1e-9
    assert np.abs(course).max() <= COMFORT_ACCEL
    assert speed < 0.5


def test_the_lawful_speed_falls_towards_a_red_light_and_a_lower_limit() -> None:
    def at(distance: float) -> float:
        return lawful_speed(RulesAhead(signal="r", signal_distance=distance, limits=np.array([[0.0, 14.0]])))

    assert at(200.0) == 14.0
    assert at(60.0) > at(30.0) > at(10.0) > at(2.0) > 0.0
    turning = RulesAhead(limits=np.array([[0.0, 14.0], [20.0, 5.0]]))
    assert 5.0 < lawful_speed(turning) < 14.0
