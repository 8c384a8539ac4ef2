"""The safety prioritizer: which actions it takes away in a situation, whom it blames, what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from policy_scenes import LANE_WIDTH, Car, histories, straight_road

from cosim.control import braking_speeds, next_target, tracked_speed, tracked_speeds
from cosim.road import RoadMap
from cosim.types import Decision, MetaAction
from policy.inputs.scene import Scene, join
from policy.prediction import motion
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import Traffic, TrafficConfig, predict_traffic
from policy.safety import LANE_END, SafetyConfig, front_to_back, prioritize

LEFT, IDLE, RIGHT, FASTER, SLOWER = MetaAction
NOTHING = np.zeros(5, np.float32)
HELD = SafetyConfig(brake_after=60.0)  # P's algorithm 2 as written: every action to the end of the horizon


def prefer(action: MetaAction) -> np.ndarray:
    q = NOTHING.copy()
    q[action] = 1.0
    return q


def predict(cars: Sequence[Car], road: RoadMap, frames: int = SafetyConfig().frames) -> tuple[Scene, Traffic]:
    scene = join(histories(road, cars))
    forecast = make_predictor("gp-indirect", 20, 0.2).predict(scene.state, scene.valid)
    return scene, predict_traffic(scene, forecast, road, TrafficConfig(), frames)


def decide(
    cars: Sequence[Car],
    road: RoadMap | None = None,
    q: np.ndarray = NOTHING,
    share: bool = True,
    config: SafetyConfig | None = None,
) -> dict[str, Decision]:
    road = road or straight_road(3)
    config = config or SafetyConfig()
    scene, traffic = predict(cars, road, config.frames)
    values = np.repeat(q[None], len(scene.agents), 0)
    return prioritize(values, scene, traffic, road, config, share)


def masked(decision: Decision) -> set[MetaAction]:
    assert decision.unsafe is not None
    return {a for a in MetaAction if decision.unsafe[a]}


def test_on_a_free_road_everything_is_safe_and_the_ego_keeps_going() -> None:
    decision = decide([Car("ego", 100.0, 1, 20.0, is_av=True)])["ego"]
    assert masked(decision) == set()
    assert decision.action == IDLE
    assert not decision.vetoed
    assert decision.blamed is None
    np.testing.assert_allclose(decision.ttc, 10.0)


def test_closing_on_a_standing_car_leaves_only_braking() -> None:
    road = straight_road(1)
    near = [Car("ego", 100.0, 0, 15.0, is_av=True), Car("stopped", 125.0, 0, 0.0)]
    far = [near[0], Car("stopped", 165.0, 0, 0.0)]
    for cars, config in ((near, None), (far, HELD)):
        decision = decide(cars, road, prefer(FASTER), config=config)["ego"]
        assert {LEFT, RIGHT, IDLE, FASTER} <= masked(decision)
        assert decision.action == SLOWER
        assert decision.vetoed
        assert decision.blamed == "stopped"


def test_who_can_still_brake_for_the_car_ahead_may_go_on() -> None:
    """60 m are two seconds too many to fall back for; they are enough to stop in from 15 m/s."""
    road = straight_road(1)
    cars = [Car("ego", 100.0, 0, 15.0, is_av=True, target=15.0), Car("stopped", 165.0, 0, 0.0)]
    decision = decide(cars, road)["ego"]
    assert {IDLE, FASTER}.isdisjoint(masked(decision))
    assert not decision.vetoed
    assert decision.ttc is not None
    assert decision.ttc[IDLE] == 10.0, "braking in time never touches it"


@pytest.mark.parametrize("speed", [5.0, 10.0, 15.0, 20.0, 25.0])
@pytest.mark.parametrize("slower_by", [0.0, 5.0, 15.0])
def test_going_on_is_refused_in_time(speed: float, slower_by: float) -> None:
    """Whatever the approach: an agent that always wants to accelerate never touches the car ahead."""
    road = straight_road(1)
    limit, other = 25.0, max(speed - slower_by, 0.0)
    front, target, v = 100.0, speed, speed
    ahead = front + 90.0
    for _ in range(30):
        cars = [Car("ego", front, 0, v, is_av=True, target=target), Car("leader", ahead, 0, other)]
        action = decide(cars, road, prefer(FASTER))["ego"].action
        target = next_target(target, v, action, limit)
        for _ in range(4):
            v = tracked_speed(v, target, 0.1)
            front, ahead = front + 0.1 * v, ahead + 0.1 * other
        assert ahead - front > 5.0, "bumpers"


def test_first_contact_is_when_the_boxes_meet() -> None:
    road = straight_road(1)
    cars = [Car("ego", 100.0, 0, 20.0, is_av=True, target=20.0), Car("slow", 150.0, 0, 10.0)]
    decision = decide(cars, road, config=HELD)["ego"]
    assert decision.ttc is not None
    gap = 50.0 - 5.0 - 0.5  # bumpers, and half of the box's added length
    assert decision.ttc[IDLE] == pytest.approx(gap / 10.0, abs=0.1)
    assert decision.ttc[FASTER] < decision.ttc[IDLE] < decision.ttc[SLOWER]


def test_the_safety_score_is_the_weighted_time_to_collision() -> None:
    road = straight_road(1)
    cars = [Car("ego", 100.0, 0, 20.0, is_av=True, target=20.0), Car("slow", 150.0, 0, 10.0)]
    decision = decide(cars, road, config=HELD)["ego"]
    assert decision.ttc is not None
    assert decision.safety_score is not None
    steps = 0.2 * np.arange(1, 21)
    weight = np.exp(-0.5 * (steps - 0.2))
    expected = (weight * np.clip(decision.ttc[IDLE] - steps, 0.0, 10.0)).sum() / weight.sum()
    assert decision.safety_score[IDLE] == pytest.approx(expected, abs=1e-3)


def test_nobody_changes_into_the_car_alongside() -> None:
    cars = [Car("ego", 100.0, 1, 20.0, is_av=True), Car("beside", 101.0, 2, 20.0)]
    decision = decide(cars, q=prefer(LEFT))["ego"]
    assert masked(decision) == {LEFT}
    assert decision.blamed == "beside"
    assert decision.action == IDLE


def test_a_lane_change_must_not_make_the_new_follower_brake_hard() -> None:
    close = [Car("ego", 100.0, 1, 15.0, is_av=True), Car("fast", 70.0, 2, 25.0)]
    far = [Car("ego", 200.0, 1, 15.0, is_av=True), Car("fast", 130.0, 2, 25.0)]
    assert masked(decide(close, q=prefer(LEFT))["ego"]) == {LEFT}
    assert decide(close, q=prefer(LEFT))["ego"].blamed == "fast"
    assert masked(decide(far)["ego"]) == set()


def test_a_faster_car_behind_in_the_same_lane_takes_nothing_away() -> None:
    cars = [Car("ego", 100.0, 0, 15.0, is_av=True), Car("hurry", 88.0, 0, 22.0)]
    decision = decide(cars, straight_road(1))["ego"]
    assert {IDLE, FASTER, SLOWER}.isdisjoint(masked(decision)), "it brakes; the ego need not flee"


def test_a_car_passing_in_the_next_lane_takes_no_straight_on_away() -> None:
    cars = [Car("ego", 100.0, 1, 15.0, is_av=True), Car("passing", 92.0, 2, 25.0), Car("slow", 108.0, 0, 5.0)]
    decision = decide(cars)["ego"]
    assert masked(decision) == {LEFT, RIGHT}


def test_tailgating_a_car_of_equal_speed_is_unsafe_though_it_never_collides() -> None:
    cars = [Car("ego", 100.0, 0, 25.0, is_av=True), Car("leader", 109.0, 0, 25.0)]
    decision = decide(cars, straight_road(1))["ego"]
    assert {IDLE, FASTER} <= masked(decision)
    assert decision.action == SLOWER
    assert decision.blamed == "leader"


def test_a_dead_end_lane_is_not_entered_and_its_end_is_an_obstacle() -> None:
    road = straight_road(3, dead_end=0, at=400.0)
    beside = decide([Car("ego", 330.0, 1, 20.0, is_av=True)], road, prefer(RIGHT))["ego"]
    assert masked(beside) == {RIGHT}
    assert beside.blamed == LANE_END
    on_it = decide([Car("ego", 330.0, 0, 20.0, is_av=True)], road)["ego"]
    assert {IDLE, FASTER} <= masked(on_it)
    assert on_it.blamed == LANE_END
    assert LEFT not in masked(on_it), "the way out stays open"


def test_nobody_leaves_the_road_or_turns_back_halfway_through_a_change() -> None:
    outside = decide([Car("ego", 100.0, 2, 20.0, is_av=True)])["ego"]
    assert masked(outside) == {LEFT}
    changing = Car("ego", 100.0, 1, 20.0, is_av=True, offset=0.6, drift=1.6, changing=1)
    decision = decide([changing], q=prefer(RIGHT))["ego"]
    assert masked(decision) == {LEFT, RIGHT}


def test_a_standing_car_does_not_slide_into_the_next_lane() -> None:
    decision = decide([Car("ego", 100.0, 1, 0.0, is_av=True, target=0.0)], q=prefer(LEFT))["ego"]
    assert {LEFT, RIGHT} <= masked(decision)


def test_a_merging_car_is_predicted_where_it_really_goes() -> None:
    road = straight_road(2, dead_end=0, at=400.0)
    waiting = [Car("ego", 300.0, 1, 20.0, is_av=True), Car("merging", 312.0, 0, 15.0)]
    assert IDLE not in masked(decide(waiting, road)["ego"]), "on its own lane it is not in the way"
    moving = [waiting[0], Car("merging", 312.0, 0, 15.0, offset=0.7, drift=1.6)]
    decision = decide(moving, road)["ego"]
    assert IDLE in masked(decision)
    assert decision.blamed == "merging"
    assert decision.action == SLOWER


def test_the_merging_car_stops_where_its_lane_ends() -> None:
    road = straight_road(2, dead_end=0, at=400.0)
    scene, traffic = predict([Car("ego", 300.0, 1, 20.0, is_av=True), Car("merging", 360.0, 0, 15.0)], road)
    k = scene.vehicles.index("merging")
    assert traffic.rollout.arc[k, -1] <= 400.0
    assert traffic.rollout.speed[k, -1] < 1.0


def test_a_drifting_car_ends_on_the_next_centre_line_and_goes_no_further() -> None:
    road = straight_road(3)
    cars = [Car("ego", 100.0, 0, 20.0, is_av=True), Car("drifting", 130.0, 1, 20.0, offset=0.6, drift=1.6)]
    scene, traffic = predict(cars, road)
    k = scene.vehicles.index("drifting")
    assert traffic.drifting[k]
    assert traffic.rollout.y[k, 5] == pytest.approx(LANE_WIDTH + 0.6 + 1.6, abs=0.3)
    assert traffic.rollout.y[k, -1] == pytest.approx(2 * LANE_WIDTH, abs=0.05)
    settled = Car("drifting", 130.0, 2, 20.0, offset=-0.6, drift=1.6)
    scene, traffic = predict([cars[0], settled], road)
    k = scene.vehicles.index("drifting")
    assert traffic.rollout.y[k, -1] == pytest.approx(2 * LANE_WIDTH, abs=0.05)


def test_when_nothing_is_safe_the_best_score_is_taken_and_said_so() -> None:
    cars = [Car("ego", 100.0, 0, 25.0, is_av=True), Car("wall", 125.0, 0, 0.0)]
    decision = decide(cars, straight_road(1), prefer(FASTER))["ego"]
    assert masked(decision) == set(MetaAction)
    assert decision.fallback
    assert decision.action == SLOWER
    assert decision.safety_score is not None
    assert decision.safety_score[SLOWER] == max(decision.safety_score)


def test_avs_decide_front_to_back() -> None:
    road = straight_road(2)
    cars = [
        Car(n, x, lane, 20.0, is_av=True) for n, x, lane in (("a", 80.0, 0), ("b", 160.0, 1), ("c", 120.0, 0))
    ]
    scene, _ = predict(cars, road)
    assert [scene.agents[b] for b in front_to_back(scene, SafetyConfig())] == ["b", "c", "a"]


def test_two_avs_do_not_take_the_same_gap() -> None:
    # from both sides into the free middle lane, side by side
    cars = [Car("l", 100.0, 2, 20.0, is_av=True), Car("r", 101.0, 0, 20.0, is_av=True)]
    road = straight_road(3)
    scene, traffic = predict(cars, road)
    q = np.stack([prefer(RIGHT), prefer(LEFT)])
    together = prioritize(q, scene, traffic, road, SafetyConfig(), share_intentions=True)
    assert together["r"].action == LEFT, "the one in front goes"
    assert together["l"].action != RIGHT
    assert together["l"].vetoed
    assert together["l"].blamed == "r"
    alone = prioritize(q, scene, traffic, road, SafetyConfig(), share_intentions=False)
    assert {alone["l"].action, alone["r"].action} == {RIGHT, LEFT}, "without V2V both go"


def test_a_follower_knows_that_its_leader_is_about_to_brake() -> None:
    road = straight_road(1)
    cars = [
        Car("rear", 100.0, 0, 20.0, is_av=True),
        Car("front", 112.0, 0, 20.0, is_av=True),
        Car("wall", 150.0, 0, 0.0),
    ]
    assert decide(cars[:2], road)["rear"].action == IDLE, "close, but the intention would be shared"
    shared = decide(cars, road)
    assert shared["front"].action == SLOWER
    assert shared["rear"].action == SLOWER
    assert shared["rear"].blamed == "front"


def test_a_leader_that_says_it_goes_on_may_still_brake_at_its_next_decision() -> None:
    """As it happened: accelerating for 0.4 s more left too little room when the leader then had to brake."""
    road = straight_road(1)
    cars = [
        Car("rear", 100.0, 0, 21.3, is_av=True, target=20.0),
        Car("front", 118.9, 0, 17.4, is_av=True, target=17.4),
    ]
    decisions = decide(cars, road, prefer(FASTER))
    assert FASTER in masked(decisions["rear"])


def test_deciding_does_not_change_the_prediction_it_was_given() -> None:
    road = straight_road(3)
    scene, traffic = predict(
        [Car("a", 100.0, 1, 20.0, is_av=True), Car("b", 130.0, 1, 20.0, is_av=True)], road
    )
    before = [array.copy() for array in traffic.rollout]
    prioritize(np.zeros((2, 5), np.float32), scene, traffic, road, SafetyConfig())
    for kept, array in zip(before, traffic.rollout, strict=True):
        np.testing.assert_array_equal(kept, array)


def test_an_av_that_gave_way_does_not_stand_for_ever() -> None:
    decision = decide([Car("ego", 100.0, 1, 0.0, is_av=True, target=0.0)])["ego"]
    assert decision.action == FASTER
    values = prefer(IDLE)
    assert decide([Car("ego", 100.0, 1, 0.0, is_av=True, target=0.0)], q=values)["ego"].action == IDLE


@pytest.mark.parametrize("field", ["safe_th", "critical_th"])
def test_a_larger_threshold_masks_more(field: str) -> None:
    road = straight_road(1)
    cars = [Car("ego", 100.0, 0, 20.0, is_av=True, target=20.0), Car("slow", 175.0, 0, 10.0)]
    strict = replace(HELD, **{field: 8.0})  # type: ignore[arg-type]
    assert IDLE not in masked(decide(cars, road, config=HELD)["ego"])
    assert IDLE in masked(decide(cars, road, config=strict)["ego"])


def test_the_mask_moves_the_ego_as_the_simulator_does() -> None:
    for target in (0.0, 15.0, 27.0):
        speed, expected = 20.0, [20.0]
        for k in range(20):
            speed = tracked_speed(speed, target, 0.1)
            if k % 2:
                expected.append(speed)
        found = tracked_speeds(20.0, np.array([target]), 10, 0.2)[0]
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_mask_brakes_as_decelerating_at_every_decision_does() -> None:
    speed, target, expected = 24.3, 25.0, [24.3]
    for k in range(30):
        if k % 4 == 0:
            target = next_target(target, speed, SLOWER, 25.0)
        speed = tracked_speed(speed, target, 0.1)
        if k % 2:
            expected.append(speed)
    found = braking_speeds(24.3, next_target(25.0, 24.3, SLOWER, 25.0), 15, 0.2, 0.4)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_target_far_above_the_speed_does_not_delay_braking() -> None:
    """Wind-up: accelerating from 12 m/s towards 27, one Decelerate brakes, so a leader's stop is survived."""
    road = straight_road(1)
    cars = [Car("ego", 100.0, 0, 12.0, is_av=True, target=27.0), Car("wall", 125.0, 0, 0.0)]
    decision = decide(cars, road)["ego"]
    assert SLOWER not in masked(decision)
    assert decision.action == SLOWER


def test_a_rollout_follows_a_bend_and_a_car_trails_its_front() -> None:
    angle = np.linspace(0.0, np.pi / 2, 40)
    radius = 50.0
    bend = np.stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle))], 1)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(bend, axis=0).T))])
    paths = motion.Paths(bend, arc, np.array([0, 40]))
    one = np.ones(1)
    out = motion.Rollout(
        *motion.roll(
            *paths,
            5.0 * one,
            0.0 * one,
            0.0 * one,
            0.0 * one,
            0.0 * one,
            5.0 * one,
            np.full((1, 21), 10.0),
            np.inf * one,
            8.0,
            0.2,
        )
    )
    from_centre = np.hypot(out.x[0], out.y[0] - radius)
    np.testing.assert_allclose(from_centre[3:], radius, atol=0.3)
    assert out.arc[0, -1] == pytest.approx(45.0, abs=0.01)
    ahead = np.hypot(np.diff(out.x[0]), np.diff(out.y[0]))
    np.testing.assert_allclose(ahead[3:], 2.0, atol=0.05)


@pytest.mark.parametrize(("speed", "askew"), [(15.0, 6.1), (5.0, 15.8), (1.0, 29.1)])
def test_a_lane_change_turns_the_car_as_it_does_in_sumo(speed: float, askew: float) -> None:
    """Angles in degrees measured in SUMO 1.28 at the end of a 2 s change."""
    line = motion.Paths(np.array([[0.0, 0.0], [500.0, 0.0]]), np.array([0.0, 500.0]), np.array([0, 2]))
    one = np.ones(1)
    out = motion.Rollout(
        *motion.roll(
            *line,
            5.0 * one,
            -3.2 * one,
            0.0 * one,
            0.0 * one,
            1.6 * one,
            5.0 * one,
            np.full((1, 11), speed),
            np.inf * one,
            8.0,
            0.2,
        )
    )
    assert np.degrees(out.heading[0]).max() == pytest.approx(askew, rel=0.12)
