"""What is a collision, and who is to blame for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from policy_scenes import straight_road

from cosim.geometry import Boxes
from cosim.road import Link, RoadMap, Rule
from cosim.road.lane import Lane
from cosim.road.too_close import heed_each_other, too_close
from cosim.simulation import collisions
from cosim.simulation.collisions import CUT_IN_WINDOW, CollisionDetector, mover
from cosim.simulation.commands import Commander, Controlled
from cosim.simulation.convert import Body
from cosim.types import INSERTION, NO_EVENTS, Kind, Overlap, Snapshot

ROAD = straight_road(3)
NAMES = ("av", "commanded", "hv")
BODIES = {name: Body(Kind.HV if name == "hv" else Kind.AV, False, 5.0, 2.0) for name in NAMES}
FRAME = 0.2  # s
Pose = tuple[float, float, float, float]  # centre x m, y m, heading degrees, speed m/s


def seen(time: float, lanes: Sequence[int]) -> Snapshot:
    n = np.zeros(3)
    kind = np.array([BODIES[name].kind for name in NAMES], np.int8)
    return Snapshot(
        time, NAMES, kind, n > 0, n, n, n, n, n, n + 5.0, n + 2.0, np.array(lanes, np.int32), n, NO_EVENTS
    )


def test_a_lane_change_is_noted_of_an_av_that_sumo_drives_and_of_nobody_else() -> None:
    detector, commander = CollisionDetector(), Commander("unguarded", 0.1)
    commander.controlled["commanded"] = Controlled(20.0)
    for time, lanes in ((0.2, (0, 0, 0)), (0.4, (1, 1, 1)), (0.6, (1, 1, 1)), (0.8, (-1, 1, 1))):
        detector.lane_changes(seen(time, lanes), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}
    detector.lane_changes(seen(1.0, (2, 1, 1)), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}, "it was nowhere: that is no lane change"
    detector = CollisionDetector()  # a new episode
    detector.lane_changes(seen(1.2, (0, 1, 1)), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}


# ---- who moved into whom ----


def drawn(*poses: Pose, length: float = 5.0, width: float = 2.0) -> Boxes:
    """Two cars where they are."""
    x, y, heading, speed = (np.array(column) for column in zip(*poses, strict=True))
    size = np.ones(len(poses))
    return Boxes(x, y, np.radians(heading), length * size, width * size, speed)


def earlier(boxes: Boxes, seconds: float = FRAME) -> Boxes:
    """Where they were."""
    back = seconds * np.asarray(boxes.speed)
    return boxes._replace(x=boxes.x - back * np.cos(boxes.heading), y=boxes.y - back * np.sin(boxes.heading))


# Two cars at contact: the first one moved into the second.
CONTACTS: dict[str, tuple[Pose, Pose]] = {
    "rear-end": ((0.0, 0.0, 0.0, 20.0), (4.5, 0.0, 0.0, 10.0)),
    "rear-end, the one ahead brakes to a crawl": ((0.0, 0.0, 0.0, 12.0), (4.9, 0.3, 0.0, 0.3)),
    "crossing, nose into the side": ((0.0, 0.0, 0.0, 10.0), (3.3, 1.0, 90.0, 12.0)),
    "crossing, into the side of one that crawls": ((0.0, 0.0, 0.0, 10.0), (3.3, 1.0, 90.0, 1.0)),
    "crossing, into one that stands": ((3.3, 1.0, 90.0, 8.0), (3.0, 3.0, 0.0, 0.0)),
    "side swipe, from the lane beside": ((0.0, 1.95, -10.0, 20.0), (1.0, 0.0, 0.0, 20.0)),
    "head-on, the faster one": ((0.0, 0.0, 0.0, 15.0), (4.5, 0.2, 180.0, 5.0)),
    "head-on, into one that stands": ((0.0, 0.0, 0.0, 5.0), (4.8, 0.2, 180.0, 0.0)),
    "passing the nose of one that stands at a line": ((0.0, 0.0, 0.0, 14.0), (1.0, -3.2, 90.0, 0.0)),
}


@pytest.mark.parametrize("contact", CONTACTS, ids=str)
def test_who_moved_into_the_other_is_the_collider(contact: str) -> None:
    for order in (1, -1):
        now = drawn(*CONTACTS[contact][::order])
        assert mover(earlier(now), now) == (0 if order == 1 else 1)


def test_two_that_stand_have_not_moved_into_one_another() -> None:
    now = drawn((0.0, 0.0, 0.0, 0.0), (4.0, 0.0, 0.0, 0.0))
    assert mover(now, now) is None


def test_a_tail_that_swings_into_a_car_is_what_moved() -> None:
    before, now = (
        drawn((0.0, 0.0, 0.0, 5.0), (0.0, 2.05, 0.0, 5.0)),
        drawn((1.0, 0.0, -6.0, 5.0), (1.0, 2.05, 0.0, 5.0)),
    )
    assert mover(before, now) == 0


def scene(time: float, cars: dict[str, Pose], lanes: dict[str, int] | None = None) -> Snapshot:
    """Cars of 5 x 2 m; those whose name begins with av are AVs. `lanes`: else off every lane."""
    names = tuple(sorted(cars))
    x, y, heading, speed = (np.array(column) for column in zip(*(cars[n] for n in names), strict=True))
    n = np.ones(len(names))
    return Snapshot(
        time,
        names,
        np.array([Kind.AV if name.startswith("av") else Kind.HV for name in names], np.int8),
        n < 0,
        x,
        y,
        np.radians(heading),
        speed,
        0.0 * n,
        5.0 * n,
        2.0 * n,
        np.array([(lanes or {}).get(name, -1) for name in names], np.int32),
        x + 2.5,
        NO_EVENTS,
    )


def bodies(*names: str) -> dict[str, Body]:
    return {name: Body(Kind.AV if name.startswith("av") else Kind.HV, False, 5.0, 2.0) for name in names}


def test_a_standing_av_whose_nose_is_in_a_passing_lane_is_not_to_blame() -> None:
    """A car at a line, its nose 0.7 m into the lane that the other drives along."""
    stands: Pose = (0.0, -2.8, 90.0, 0.0)
    detector, known = CollisionDetector(), bodies("av0", "hv4")
    detector.from_boxes(scene(1.0, {"av0": stands, "hv4": (-5.0, 0.0, 0.0, 14.0)}), ROAD, known, {})
    (hit,) = detector.from_boxes(scene(1.2, {"av0": stands, "hv4": (-2.2, 0.0, 0.0, 14.0)}), ROAD, known, {})
    assert (hit.collider, hit.victim, hit.av_caused) == ("hv4", "av0", False)
    again = detector.from_boxes(scene(1.4, {"av0": stands, "hv4": (0.6, 0.0, 0.0, 14.0)}), ROAD, known, {})
    assert again == [], "a pair counts once"


def test_an_av_that_passes_too_close_to_a_standing_car_is_to_blame() -> None:
    stands: Pose = (0.0, -2.8, 90.0, 0.0)
    detector, known = CollisionDetector(), bodies("av4", "hv0")
    detector.from_boxes(scene(1.0, {"hv0": stands, "av4": (-5.0, 0.0, 0.0, 14.0)}), ROAD, known, {})
    (hit,) = detector.from_boxes(scene(1.2, {"hv0": stands, "av4": (-2.2, 0.0, 0.0, 14.0)}), ROAD, known, {})
    assert (hit.collider, hit.victim, hit.av_caused) == ("av4", "hv0", True)


@pytest.mark.parametrize(
    ("since", "caused"), [(CUT_IN_WINDOW, True), (CUT_IN_WINDOW + 0.1, False)], ids=["cut in", "long ago"]
)
def test_hit_from_behind_an_av_is_to_blame_while_the_window_lasts(since: float, caused: bool) -> None:
    detector, known, changes = CollisionDetector(), bodies("av", "hv"), {"av": 10.0, "hv": 10.0}
    now = 10.0 + since
    cars: dict[str, Pose] = {"av": (5.5, 0.0, 0.0, 10.0), "hv": (0.0, 0.0, 0.0, 20.0)}
    detector.from_boxes(scene(now - FRAME, cars), ROAD, known, changes)
    cars = {"av": (7.5, 0.0, 0.0, 10.0), "hv": (4.0, 0.0, 0.0, 20.0)}
    (hit,) = detector.from_boxes(scene(now, cars), ROAD, known, changes)
    assert (hit.collider, hit.victim, hit.av_caused) == ("hv", "av", caused)


@pytest.mark.parametrize(("new", "age"), [("hv", 0.2), ("av", 1.0)])
def test_a_car_that_sumo_puts_onto_another_is_nobody_s_fault(new: str, age: float) -> None:
    detector, known = CollisionDetector(), bodies("av", "hv")
    detector.inserted([new], 5.0)
    cars: dict[str, Pose] = {"av": (3.0, 0.0, 0.0, 10.0), "hv": (0.0, 0.0, 0.0, 20.0)}
    (hit,) = detector.from_boxes(scene(5.0 + age, cars), ROAD, known, {})
    assert hit.kind == INSERTION
    assert hit.insertion
    assert (hit.av_caused, hit.involves_av, hit.crash) == (False, False, False)


def test_a_second_and_more_after_its_insertion_a_car_is_like_any_other() -> None:
    detector, known = CollisionDetector(), bodies("av", "hv")
    detector.inserted(["av"], 5.0)
    detector.inserted(["x"], 6.2)  # forgets who was inserted long ago
    cars: dict[str, Pose] = {"av": (0.0, 0.0, 0.0, 20.0), "hv": (3.0, 0.0, 0.0, 10.0)}
    (hit,) = detector.from_boxes(scene(6.2, cars), ROAD, known, {})
    assert (hit.collider, hit.kind, hit.av_caused, hit.crash) == ("av", "overlap", True, True)


# ---- lanes too close together ----


def lane(name: str, points: Sequence[tuple[float, float]], successors: tuple[int, ...] = ()) -> Lane:
    shape = np.array(points, np.float64)
    length = float(np.hypot(*np.diff(shape, axis=0).T).sum())
    inside, edge = name.startswith(":"), name.rpartition("_")[0]
    return Lane(name, edge, int(name[-1]), shape, length, 3.2, 20.0, successors, internal=inside, start="J")


def two_lanes(apart: float, end: float) -> RoadMap:
    """Two lanes towards east, `apart` m from one another at x = 0 and `end` m at x = 100, then on as lanes of
    their own."""
    y = apart, end
    return RoadMap(
        (
            lane("a_0", [(0.0, 0.0), (100.0, 0.0)], (2,)),
            lane("a_1", [(0.0, y[0]), (100.0, y[1])], (3,)),
            lane("b_0", [(100.0, 0.0), (200.0, 0.0)]),
            lane("b_1", [(100.0, y[1]), (200.0, y[1])]),
        )
    )


SIDE: dict[str, Pose] = {"av": (50.0, 0.0, 0.0, 10.0), "hv": (51.0, 1.9, 0.0, 10.0)}


def test_two_on_their_own_centre_lines_that_lie_too_close_have_not_collided() -> None:
    lanes, known = {"av": 0, "hv": 1}, bodies("av", "hv")
    detector = CollisionDetector()
    for time in (1.0, 1.2):
        assert detector.from_boxes(scene(time, SIDE, lanes), two_lanes(1.9, 1.9), known, {}) == []
    assert detector.overlaps() == (Overlap(1.0, ("av", "hv"), collisions.LANES),), "once, and why"
    assert detector.overlaps() == ()
    converging = two_lanes(3.2, 0.7)
    hv: Pose = (51.0, 3.2 - 0.025 * 51.0, np.degrees(np.arctan(-0.025)), 10.0)
    here = scene(1.0, {"av": SIDE["av"], "hv": hv}, lanes)
    assert CollisionDetector().from_boxes(here, converging, known, {}) == []


def test_one_that_has_left_its_centre_line_has_collided() -> None:
    lanes, known = {"av": 0, "hv": 1}, bodies("av", "hv")
    (hit,) = CollisionDetector().from_boxes(scene(1.0, SIDE, lanes), two_lanes(3.2, 3.2), known, {})
    assert {hit.collider, hit.victim} == {"av", "hv"}


def test_one_behind_the_other_on_a_lane_drawn_shorter_than_it_is_has_not_collided() -> None:
    whole = lane("a_0", [(0.0, 0.0), (80.0, 0.0)])
    queue: dict[str, Pose] = {"av": (37.5, 0.0, 0.0, 0.0), "hv": (42.3, 0.0, 0.0, 0.0)}
    known, on = bodies("av", "hv"), {"av": 0, "hv": 0}
    here = replace(scene(1.0, queue, on), lane_position=np.array([50.0, 56.0]))  # 40 m and 44.8 m as drawn
    assert CollisionDetector().from_boxes(here, RoadMap((replace(whole, length=100.0),)), known, {}) == []
    touching = replace(here, lane_position=np.array([40.0, 44.8]))
    assert len(CollisionDetector().from_boxes(touching, RoadMap((whole,)), known, {})) == 1


def test_one_behind_the_other_on_the_lane_before_one_that_is_drawn_shorter_has_not_collided() -> None:
    """As at a junction of an imported net whose lane of 5.4 m is drawn 3.5 m long."""
    road = RoadMap(
        (
            lane("a_0", [(0.0, 0.0), (50.0, 0.0)], (1,)),
            replace(lane(":J_0", [(50.0, 0.0), (53.5, 0.0)]), length=5.4),
        )
    )
    queue: dict[str, Pose] = {"av": (45.5, 0.0, 0.0, 0.0), "hv": (50.4, 0.0, 0.0, 0.0)}
    known, on = bodies("av", "hv"), {"av": 0, "hv": 1}
    here = replace(scene(1.0, queue, on), lane_position=np.array([48.0, 5.4 / 3.5 * 2.9]))
    assert CollisionDetector().from_boxes(here, road, known, {}) == []
    whole = replace(road, lanes=(road.lanes[0], replace(road.lanes[1], length=3.5)))
    touching = replace(here, lane_position=np.array([48.0, 2.9]))
    assert len(CollisionDetector().from_boxes(touching, whole, known, {})) == 1


def test_two_on_lanes_that_join_or_cross_or_follow_one_another_have_collided() -> None:
    known = bodies("av", "hv")
    apart = two_lanes(1.9, 1.9)
    joined = replace(
        apart, lanes=(apart.lanes[0], replace(apart.lanes[1], successors=(2,)), *apart.lanes[2:])
    )
    assert len(CollisionDetector().from_boxes(scene(1.0, SIDE, {"av": 0, "hv": 1}), joined, known, {})) == 1
    crossing = RoadMap((lane("a_0", [(0.0, 0.0), (100.0, 0.0)]), lane("c_0", [(50.0, -50.0), (50.0, 50.0)])))
    cars: dict[str, Pose] = {"av": (47.0, 0.0, 0.0, 10.0), "hv": (50.0, 0.0, 90.0, 10.0)}
    here = replace(scene(1.0, cars, {"av": 0, "hv": 1}), lane_position=np.array([49.5, 52.5]))
    assert len(CollisionDetector().from_boxes(here, crossing, known, {})) == 1
    behind: dict[str, Pose] = {"av": (98.0, 0.0, 0.0, 10.0), "hv": (102.0, 0.0, 0.0, 5.0)}
    here = replace(scene(1.0, behind, {"av": 0, "hv": 2}), lane_position=np.array([100.0, 4.5]))
    assert len(CollisionDetector().from_boxes(here, apart, known, {})) == 1


def test_whose_tail_is_on_a_crossing_lane_has_collided() -> None:
    """The AV's front has left the junction, its tail has not."""
    road = RoadMap(
        (
            lane(":J_0", [(0.0, 0.0), (20.0, 0.0)], (1,)),
            lane("out_0", [(20.0, 0.0), (100.0, 0.0)]),
            lane(":J_1", [(18.0, -20.0), (18.0, 20.0)]),
        )
    )
    cars: dict[str, Pose] = {"av": (19.5, 0.0, 0.0, 5.0), "hv": (18.0, -2.5, 90.0, 10.0)}
    here = replace(scene(1.0, cars, {"av": 1, "hv": 2}), lane_position=np.array([2.0, 20.0]))
    (hit,) = CollisionDetector().from_boxes(here, road, bodies("av", "hv"), {})
    assert hit.collider == "hv"


def test_past_one_that_waits_inside_a_junction_where_the_net_lets_it_nobody_collides() -> None:
    road = RoadMap(
        (
            lane(":J_0", [(0.0, 0.0), (10.0, 0.0)], (1,)),
            lane(":J_1", [(10.0, 0.0), (30.0, 0.0)]),
            lane(":J_2", [(9.5, -20.0), (9.5, 20.0)]),
        )
    )
    known = bodies("av", "hv")
    for speed, hits in ((0.0, 0), (2.0, 1)):
        cars: dict[str, Pose] = {"av": (7.5, 0.0, 0.0, speed), "hv": (9.5, -2.5, 90.0, 8.0)}
        here = replace(scene(1.0, cars, {"av": 0, "hv": 2}), lane_position=np.array([10.0, 20.0]))
        assert len(CollisionDetector().from_boxes(here, road, known, {})) == hits


@pytest.mark.parametrize(("edge", "hits"), [(":J_w0", 0), (":J_c0", 1)])
def test_a_person_is_hit_on_a_crossing_and_not_on_a_walking_area(edge: str, hits: int) -> None:
    road = RoadMap(
        (lane("a_0", [(0.0, 0.0), (100.0, 0.0)]),), closed=(lane(f"{edge}_0", [(50, 1), (50, 9)]),)
    )
    cars: dict[str, Pose] = {"av": (50.0, 0.0, 0.0, 10.0), "person:p": (50.0, 1.5, 0.0, 0.0)}
    here = scene(1.0, cars, {"av": 0})
    here = replace(
        here,
        kind=np.array([Kind.AV, Kind.PERSON], np.int8),
        place=np.array([0, -2 - road.contact.edges[edge]], np.int32),
    )
    assert len(CollisionDetector().from_boxes(here, road, bodies("av"), {})) == hits


class Touching:
    """SUMO's calls as they answer while a vehicle and a person touch on a crossing."""

    TraCIException = LookupError

    def __init__(self, vehicle: Pose, person: Pose) -> None:
        self.vehicle, self.person = OnePose(vehicle, 5.0, 2.0), OnePose(person, 0.2, 0.5)
        said = SimpleNamespace(
            type="crossing", collider="av", victim="p", colliderSpeed=vehicle[3], lane=":J_c0_0"
        )
        self.simulation = SimpleNamespace(
            getCollidingVehiclesNumber=lambda: 1, getCollisions=lambda: (said,), getTime=lambda: 1.0
        )


class OnePose:
    """Getters of one vehicle or person: SUMO's front bumper and degrees clockwise from north."""

    def __init__(self, pose: Pose, length: float, width: float) -> None:
        x, y, heading, speed = pose
        ahead = 0.5 * length
        front = x + ahead * np.cos(np.radians(heading)), y + ahead * np.sin(np.radians(heading))
        said = {"Position": front, "Angle": 90.0 - heading, "Speed": speed, "Length": length, "Width": width}
        for name, value in said.items():
            setattr(self, f"get{name}", lambda _, value=value: value)


@pytest.mark.parametrize(
    ("person", "collider"),
    [((-2.4, 1.05, -90.0, 1.2), "person:p"), ((2.5, 0.0, 90.0, 1.2), "av")],
    ids=["walks into the tail of one that drives by", "is walked over"],
)
def test_of_a_person_and_a_moving_car_the_one_that_moved_into_the_other_is_the_collider(
    monkeypatch: pytest.MonkeyPatch, person: Pose, collider: str
) -> None:
    car: Pose = (0.0, 0.0, 0.0, 3.0)
    monkeypatch.setattr(collisions, "sumo", Touching(car, person))
    detector = CollisionDetector()
    then = earlier(drawn(car, person))
    before = {
        name: (then.x[k], then.y[k], *(car, person)[k][2:]) for k, name in enumerate(("av", "person:p"))
    }
    seen = replace(scene(0.8, before), length=np.array([5.0, 0.2]), width=np.array([2.0, 0.5]))
    detector.from_boxes(seen, ROAD, bodies("av", "person:p"), {})
    (hit,) = detector.from_sumo(bodies("av"), {}, 1.0)
    assert hit.collider == collider
    assert hit.av_caused == (collider == "av")


def test_lanes_too_close_together_are_found_and_lanes_that_meet_are_not() -> None:
    ((distance, a, b),) = too_close(two_lanes(3.2, 1.9))[:1]
    assert (a, b) == (0, 1)
    assert distance == pytest.approx(1.9)
    assert too_close(two_lanes(3.2, 3.2)) == []
    fork = RoadMap(
        (
            lane("a_0", [(0.0, 0.0), (20.0, 0.0)], (1, 2)),
            lane(":J_0", [(20.0, 0.0), (40.0, 0.0)]),
            lane(":J_1", [(20.0, 0.0), (40.0, 4.0)]),
        )
    )
    assert heed_each_other(fork, 1, 2)
    alone = tuple(replace(k, successors=()) for k in two_lanes(1.9, 1.9).lanes[:2])
    links = (Link(0, 0, 0, -1, Rule.PRIORITY), Link(1, 1, 1, -1, Rule.YIELD, (0,)))
    beside = RoadMap(alone, links=links)
    assert not heed_each_other(beside, 0, 1), "a junction's links say nothing of lanes outside"
    inside = RoadMap(tuple(replace(k, internal=True) for k in alone), links=links)
    assert heed_each_other(inside, 0, 1), "one has the right of way over the other"
    assert too_close(fork) == []
