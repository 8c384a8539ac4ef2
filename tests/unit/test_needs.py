"""Who needs something of an AV follows from the road and from what the AV knows; the yield rule serves it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from policy_scenes import LANE_WIDTH, Car, histories, straight_road

from cosim.road import Lane, Link, RoadMap, Rule
from cosim.types import COMPACT, History, MetaAction, PolicyContext, Timing
from policy.agents.yield_rule import HABITS, YieldRule
from policy.inputs.needs import FORGET, Need, Needs

BEHIND, BRAKING, EASE = HABITS.behind, HABITS.braking, HABITS.ease
CRAWL, PATIENCE, UPSTREAM = HABITS.crawl, HABITS.patience, HABITS.upstream
HOLD, REST = HABITS.hold, HABITS.rest
ENDS = straight_road(dead_end=0)  # the right lane ends at x = 400
AV = Car("av", 300.0, 1, 20.0, is_av=True)


def context(road: RoadMap) -> PolicyContext:
    return PolicyContext(road, Timing(), COMPACT, math.pi / 4.0, np.random.default_rng(0))


def signalling(scene: dict[str, History], **indicators: int) -> dict[str, History]:
    """The same with the turn indicators of these vehicles on."""
    return {
        av: h._replace(indicator=np.array([indicators.get(name, 0) for name in h.ids], np.int8))
        for av, h in scene.items()
    }


def needs(road: RoadMap, *cars: Car, **indicators: int) -> list[Need]:
    return Needs(context(road)).find(signalling(histories(road, cars), **indicators)).get("av", [])


OTHER = Car("other", 320.0, 0, 15.0)  # on the lane to the right of the AV


def test_a_vehicle_that_signals_onto_the_avs_lane_needs_it() -> None:
    (need,) = needs(straight_road(), AV, OTHER, other=1)
    assert need == Need("other", False, pytest.approx(15.0), 0, 15.0, np.inf, 0.0)
    (need,) = needs(ENDS, AV, OTHER, other=1)
    assert need.remaining == pytest.approx(77.5)  # its front is at 322.5, its lane ends at 400


def test_nobody_else_does() -> None:
    assert needs(ENDS, AV, OTHER) == []
    assert needs(ENDS, AV, OTHER, other=-1) == []
    assert needs(straight_road(), Car("av", 300.0, 2, 20.0, is_av=True), OTHER, other=1) == []
    assert needs(straight_road(), AV, Car("other", 320.0, 1, 15.0), other=1) == []


def test_vehicles_between_both_are_counted() -> None:
    ahead = Car("between", 310.0, 1, 20.0)
    beyond = Car("beyond", 330.0, 1, 20.0)
    (need,) = needs(ENDS, AV, OTHER, ahead, beyond, other=1)
    assert need.between == 1


def crossing_road(rule: Rule) -> RoadMap:
    """A street to the east whose line is at x = 400, and a lane from the south that ends there."""

    def lane(name: str, a: tuple[float, float], b: tuple[float, float], *successors: int) -> Lane:
        length = float(np.hypot(b[0] - a[0], b[1] - a[1]))
        return Lane(name, name[0], 0, np.array([a, b]), length, LANE_WIDTH, 25.0, successors)

    lanes = (
        lane("a_0", (0.0, 0.0), (400.0, 0.0), 1),
        lane("b_0", (400.0, 0.0), (900.0, 0.0)),
        lane("c_0", (400.0, -200.0), (400.0, -4.0), 1),
    )
    street = Link(0, -1, 1, -1, Rule.PRIORITY)
    return RoadMap(lanes, links=(street, Link(2, -1, 1, -1, rule, foes=(0,) if rule == Rule.YIELD else ())))


def at_line(road: RoadMap, time: float, *ahead: Car) -> dict[str, History]:
    """The AV, a car that stands 2 m before its line, and vehicles ahead of the AV."""
    scene = histories(road, [Car("av", 200.0, 0, 15.0, is_av=True), Car("waits", 191.5, 0, 0.0), *ahead])
    lane = scene["av"].lane.copy()
    lane[1] = 2
    return {"av": scene["av"]._replace(lane=lane, time=time)}


def test_a_vehicle_that_gives_way_to_the_av_needs_it_the_more_the_longer_it_has_waited() -> None:
    road = crossing_road(Rule.YIELD)
    of = Needs(context(road))
    assert of.find(at_line(road, 0.0))["av"][0].waited == 0.0
    (need,) = of.find(at_line(road, 3.0))["av"]
    assert need == Need(
        "waits", True, pytest.approx(197.5), 0, 0.0, pytest.approx(2.0), pytest.approx(3.0), link=0
    )


def test_who_hears_another_av_knows_for_how_long_a_vehicle_has_waited() -> None:
    road = crossing_road(Rule.YIELD)
    of = Needs(replace(context(road), share_perception=False))
    for time in (0.0, 6.0):
        of.find(at_line(road, time))

    def waited(hears: frozenset[str] | None) -> float:
        came = at_line(road, 6.5)["av"]
        came = came._replace(ids=("came", *came.ids[1:]), hears=hears)
        return Needs.find(copy.deepcopy(of), {"came": came})["came"][0].waited

    assert waited(None) == waited(frozenset()) == 0.0
    assert waited(frozenset({"av"})) == pytest.approx(6.0 - FORGET * 0.5)


def test_a_vehicle_with_priority_needs_nobody() -> None:
    road = crossing_road(Rule.PRIORITY)
    assert Needs(context(road)).find(at_line(road, 0.0)) == {}


# ---- the rule ----


FAR = Car("other", 380.0, 0, 15.0)  # the AV, 75 m behind its rear, can still slow down gently


def test_the_rule_slows_down_gently_behind_it_until_it_has_had_its_time() -> None:
    rule = YieldRule()
    rule.reset(context(ENDS))
    scene = signalling(histories(ENDS, [AV, FAR]), other=1)
    pace = math.hypot(15.0 - EASE, math.sqrt(2.0 * BRAKING * (75.0 - BEHIND)))
    assert rule.decide(scene)["av"].accel == pytest.approx(min(pace - 20.0, EASE))
    near = signalling(histories(ENDS, [AV, OTHER]), other=1)["av"]
    pace = math.hypot(15.0 - EASE, math.sqrt(2.0 * BRAKING * (15.0 - BEHIND)))
    assert rule.decide({"av": near._replace(time=1.0)})["av"].accel == pytest.approx(pace - 20.0)
    later = {"av": near._replace(time=HOLD + 0.1)}
    assert rule.decide(later)["av"].action == MetaAction.ACCELERATE
    assert rule.decide(later)["av"].accel is None


def test_an_av_too_near_and_too_fast_leaves_it_to_the_next() -> None:
    rule = YieldRule()
    rule.reset(context(ENDS))
    assert rule.decide(signalling(histories(ENDS, [AV, OTHER]), other=1))["av"].accel is None


def test_an_egoist_yields_to_nobody() -> None:
    rule = YieldRule()
    rule.reset(replace(context(ENDS), svo=0.0))
    assert rule.decide(signalling(histories(ENDS, [AV, OTHER]), other=1))["av"].accel is None


def test_the_rule_accelerates_beside_nobody_in_need() -> None:
    rule = YieldRule()
    rule.reset(context(ENDS))
    assert rule.decide(histories(ENDS, [AV]))["av"].accel is None


def test_the_rule_crawls_far_before_the_line_for_one_that_has_waited_long_until_it_is_gone() -> None:
    road = crossing_road(Rule.YIELD)
    rule = YieldRule()
    rule.reset(context(road))
    crawls, drives = pytest.approx(CRAWL - 15.0), None

    def wish(waited: float, arc: float) -> float | None:
        of = at_line(road, waited)["av"]
        return rule.decide({"av": of._replace(route=of.route._replace(arc=arc))})["av"].accel

    assert wish(0.0, 200.0) == drives
    assert wish(PATIENCE, 400.0 - UPSTREAM) == drives  # too near to let it go
    assert wish(PATIENCE, 200.0) == crawls
    assert wish(PATIENCE + HOLD, 400.0 - 0.5 * UPSTREAM) == crawls  # it has begun
    alone = histories(road, [Car("av", 300.0, 0, 15.0, is_av=True)])["av"]
    assert rule.decide({"av": alone._replace(time=PATIENCE + HOLD + 1.0)})["av"].accel == drives


def test_the_rule_gives_up_after_its_way_to_the_line_has_been_clear_in_vain() -> None:
    road = crossing_road(Rule.YIELD)
    rule = YieldRule()
    rule.reset(context(road))
    ahead = Car("ahead", 300.0, 0, 5.0)
    crawls = [
        rule.decide(at_line(road, time, *others))["av"].accel is not None
        for time, *others in (
            *((0.0, ahead), (PATIENCE, ahead), (PATIENCE + HOLD + 1.0, ahead)),
            *((PATIENCE + HOLD + 2.0,), (PATIENCE + 2.0 * HOLD + 1.0,), (PATIENCE + 2.0 * HOLD + 2.0,)),
            *((PATIENCE + 2.0 * HOLD + 3.0,), (PATIENCE + 2.0 * HOLD + 3.0 + REST,)),
        )
    ]
    assert crawls == [False, True, True, True, True, False, False, True]


def test_one_av_of_a_lane_lets_a_waiting_vehicle_go() -> None:
    road = crossing_road(Rule.YIELD)
    rule = YieldRule()
    rule.reset(context(road))
    rule.decide(at_line(road, 0.0))
    first = at_line(road, PATIENCE)["av"]
    behind = first._replace(ids=("behind", *first.ids[1:]), route=first.route._replace(arc=150.0))
    decisions = rule.decide({"behind": behind, "av": first})
    assert decisions["av"].accel is not None
    assert decisions["behind"].accel is None
    alone = {"behind": behind._replace(hears=frozenset()), "av": first}
    assert rule.decide(alone)["behind"].accel is not None, "it does not know of the other's intention"
