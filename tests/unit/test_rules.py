"""The law on one's own way: in histories, in views, as an environment's observation, in maps."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.envs import spaces
from cosim.errors import BadInput
from cosim.geometry.raster import (
    CROSSING,
    GIVE_WAY,
    RED_LINE,
    ROAD_LINE,
    ROAD_SURFACE,
    STOP_SIGN,
    YELLOW_LINE,
    rasterize_road,
)
from cosim.observation.observer import Observer
from cosim.observation.view import Packer, Unpacker, View, views
from cosim.road import Crossing, Lane, Link, RoadMap, Rule
from cosim.road.rules import NO_RULES
from cosim.types import History, Kind, MetaAction, ObservationConfig, Snapshot

MAPLESS = ObservationConfig(maps=False)
LAW_DRAWN = ObservationConfig(road_version=2)
ROUTE = ("a", "b", "c")
FRONT = 62.5  # m, of the AV on its first lane; its centre is at 60


def lane(name: str, edge: str, x0: float, x1: float, limit: float, successors: tuple[int, ...] = ()) -> Lane:
    """A lane eastwards, 3.2 m wide, its centre line at y = 0."""
    shape = np.array([[x0, 0.0], [x1, 0.0]])
    internal = edge.startswith(":")
    return Lane(name, edge, 0, shape, x1 - x0, 3.2, limit, successors, internal=internal)


def street(first: Rule = Rule.PRIORITY, second: Rule = Rule.PRIORITY, signals: bool = True) -> RoadMap:
    """Three edges with junctions at x = 100 and 200, a crossing at 104 to 108; signal 0 and 1."""
    lanes = (
        lane("a_0", "a", 0.0, 100.0, 13.9, (1,)),
        lane(":j_0", ":j", 100.0, 120.0, 8.0, (2,)),
        lane("b_0", "b", 120.0, 200.0, 13.9, (3,)),
        lane(":k_0", ":k", 200.0, 220.0, 13.9, (4,)),
        lane("c_0", "c", 220.0, 1000.0, 20.0),
    )
    zebra = Crossing(":j_c0", np.array([[106.0, -4.0], [106.0, 4.0]]), 4.0, (1,), 2 if signals else -1)
    links = (
        Link(0, 1, 2, 0 if signals else -1, first, (1,)),
        Link(2, 3, 4, 1 if signals else -1, second),
    )
    lights = (("j", 0), ("k", 0), ("j", 1)) if signals else ()
    return RoadMap(lanes, links=links, signals=lights, crossings=(zebra,))


def snapshot(
    states: str = "",
    people: tuple[tuple[float, float, float, float], ...] = (),
    switches: tuple[float, ...] = (),
    front: float = FRONT,
    on: int = 0,
) -> Snapshot:
    """An AV with its front bumper at x = `front`, and persons (x, y, heading, speed)."""
    rows = np.array([(front - 2.5, 0.0, 0.0, 10.0), *people])
    n = len(rows)
    return Snapshot(
        time=0.0,
        ids=("av", *(f"person:{k}" for k in range(n - 1))),
        kind=np.array([Kind.AV] + [Kind.PERSON] * (n - 1), np.int8),
        mission=np.zeros(n, np.bool_),
        x=rows[:, 0],
        y=rows[:, 1],
        heading=rows[:, 2],
        speed=rows[:, 3],
        accel=np.zeros(n),
        length=np.array([5.0] + [0.3] * (n - 1)),
        width=np.array([2.0] + [0.5] * (n - 1)),
        lane=np.array([on] + [-1] * (n - 1), np.int32),
        lane_position=np.array([front - (0.0, 100.0, 120.0)[on]] + [0.0] * (n - 1)),
        signals=np.frombuffer(states.encode(), np.uint8),
        switches=np.array(switches),
    )


def look(road: RoadMap, seen: Snapshot, config: ObservationConfig = MAPLESS) -> History:
    """What the AV knows."""
    observer = Observer(road, config)
    observer.add(seen)
    first = ROUTE.index(road.lanes[int(seen.lane[0])].edge) if seen.lane[0] != 1 else 0
    return observer.histories(lambda _: ROUTE[first:], lambda _: (None, 0))["av"]


def view(road: RoadMap, seen: Snapshot) -> View:
    return views({"av": look(road, seen)})["av"]


@pytest.mark.parametrize("state", list("rRyYgGosu"))
def test_the_next_signal_has_its_state_and_the_distance_to_its_stop_line(state: str) -> None:
    rules = look(street(), snapshot(state + "rr")).rules
    assert (rules.signal, rules.signal_index) == (state, 0)
    assert rules.signal_distance == pytest.approx(100.0 - FRONT)
    assert rules.switch_in == -1.0, "nobody asked"


def test_behind_the_stop_line_the_next_signal_counts() -> None:
    rules = look(street(), snapshot("ryr", front=103.0, on=1)).rules
    assert (rules.signal, rules.signal_distance) == ("y", pytest.approx(97.0))


def test_the_time_of_the_next_phase_is_told_only_to_those_who_are_to_know_it() -> None:
    seen = snapshot("ryr", switches=(7.5, 3.0, 7.5))
    assert look(street(), seen).rules.switch_in == -1.0
    told = ObservationConfig(maps=False, signal_timing=True)
    assert look(street(), seen, told).rules.switch_in == 7.5
    assert look(street(), snapshot("ryr"), told).rules.switch_in == -1.0, "a world that does not say it"


@pytest.mark.parametrize("rule", [Rule.STOP, Rule.ALL_WAY_STOP])
def test_a_stop_sign_asks_to_stop_and_to_give_way(rule: Rule) -> None:
    rules = look(street(first=rule, signals=False), snapshot()).rules
    assert rules.stop_distance == rules.yield_distance == pytest.approx(37.5)
    assert rules.all_way_stop == (rule == Rule.ALL_WAY_STOP)
    assert rules.signal == ""


@pytest.mark.parametrize("rule", [Rule.YIELD, Rule.EQUAL, Rule.ZIPPER])
def test_the_next_line_at_which_one_gives_way_names_its_link(rule: Rule) -> None:
    rules = look(street(second=rule, signals=False), snapshot()).rules
    assert (rules.yield_distance, rules.yield_link) == (pytest.approx(137.5), 1)
    assert rules.stop_distance == np.inf


def test_a_signal_that_is_on_counts_in_place_of_the_sign() -> None:
    road = street(first=Rule.STOP)
    green = look(road, snapshot("GGr")).rules
    assert green.stop_distance == green.yield_distance == np.inf
    permissive = look(road, snapshot("gGr")).rules
    assert (permissive.stop_distance, permissive.yield_distance) == (np.inf, pytest.approx(37.5))
    arrow = look(road, snapshot("sGr")).rules
    assert arrow.stop_distance == arrow.yield_distance == pytest.approx(37.5)


def test_a_limit_that_a_sign_has_changed_is_the_limit() -> None:
    seen = replace(snapshot("GGr"), limits={0: 20.0, 2: 20.0})
    history = look(street(), seen)
    wanted = [[0.0, 20.0], [37.5, 8.0], [57.5, 20.0], [137.5, 13.9], [157.5, 20.0]]
    assert history.rules.limits == pytest.approx(np.array(wanted))
    assert history.route.speed_limit == 20.0
    assert look(street(), snapshot("GGr")).route.speed_limit == 13.9


def test_limits_are_known_with_the_places_where_they_begin_junctions_included() -> None:
    rules = look(street(), snapshot("GGr")).rules
    wanted = [[0.0, 13.9], [37.5, 8.0], [57.5, 13.9], [157.5, 20.0]]
    assert rules.limits == pytest.approx(np.array(wanted))


@pytest.mark.parametrize(
    ("person", "own_signal", "counts"),
    [
        ((106.0, 0.0, np.pi / 2, 1.0), "r", True),  # on it, also at red
        ((106.5, -5.0, np.pi / 2, 0.0), "G", True),  # stands at it
        ((106.5, -5.0, np.pi / 2, 1.2), "G", True),  # walks towards it
        ((106.5, -5.0, -np.pi / 2, 1.2), "G", False),  # has left it
        ((106.5, -5.0, 0.0, 1.2), "G", False),  # walks past it
        ((106.5, 5.0, -np.pi / 2, 1.2), "G", True),  # towards it from the other side
        ((106.5, -5.0, np.pi / 2, 0.0), "r", False),  # waits for its signal
        ((106.0, -9.0, np.pi / 2, 1.2), "G", False),  # still too far
    ],
)
def test_persons_on_a_crossing_or_about_to_enter_it_are_known(
    person: tuple[float, float, float, float], own_signal: str, counts: bool
) -> None:
    rules = look(street(), snapshot("GG" + own_signal, (person,))).rules
    assert rules.crossing_distance == pytest.approx(104.0 - FRONT, abs=0.3)
    assert rules.person_distance == (rules.crossing_distance if counts else np.inf)


def test_a_crossing_is_ahead_until_the_front_bumper_has_left_it() -> None:
    on_it = look(street(), snapshot("GGr", front=106.0, on=1)).rules
    assert on_it.crossing_distance == 0.0
    assert look(street(), snapshot("GGr", front=109.0, on=1)).rules.crossing_distance == np.inf


def test_persons_out_of_sight_are_not_known() -> None:
    seen = snapshot("GGG", ((106.0, 0.0, 0.0, 1.0),))
    near = ObservationConfig(maps=False, perception_range=20.0)
    assert look(street(), seen).rules.person_distance < np.inf
    assert look(street(), seen, near).rules.person_distance == np.inf


def test_a_snapshot_without_its_persons_has_the_same_signals() -> None:
    seen = snapshot("rGr", ((106.0, 0.0, 0.0, 1.0),), (7.5, 3.0, 7.5))
    assert seen.vehicles.ids == ("av",)
    assert np.array_equal(seen.vehicles.signals, seen.signals)
    assert np.array_equal(seen.vehicles.switches, seen.switches)


def test_a_lane_that_leads_elsewhere_says_nothing_of_lines_beyond_its_end() -> None:
    observer = Observer(street(), MAPLESS)
    observer.add(snapshot("rrr"))
    rules = observer.histories(lambda _: ("a", "elsewhere"), lambda _: (None, 0))["av"].rules
    assert rules.signal == ""
    assert rules.limits == pytest.approx(np.array([[0.0, 13.9]]))


def test_without_knowledge_of_lines_nothing_is_ahead() -> None:
    bare = look(RoadMap(street().lanes), snapshot())
    assert repr(bare.rules[:-1]) == repr(NO_RULES[:-1])


# ---- views and environments ----


def test_a_view_holds_the_same_law_as_the_history_it_is_made_from() -> None:
    road, packer, unpacker = street(second=Rule.STOP, signals=False), Packer(), Unpacker()
    history = look(road, snapshot(people=((106.0, 0.0, 0.0, 1.0),)))
    other = history._replace(rules=look(street(), snapshot("yGr")).rules)
    seen = unpacker.unpack(packer.pack({"one": history, "two": other}, None))
    for name, wanted in (("one", history.rules), ("two", other.rules)):
        got = seen[name].rules
        assert np.array_equal(got.limits, wanted.limits)
        assert repr(got[:-1]) == repr(wanted[:-1]), "types too"
    assert unpacker.unpack(packer.pack({}, 2)) == {}


def test_environments_give_the_law_as_bounded_numbers() -> None:
    seen = view(street(second=Rule.STOP), snapshot("yGr"))
    law = dict(zip(spaces.LAW_FEATURES, spaces.law(seen).tolist(), strict=True))
    assert (law["signal_red"], law["signal_yellow"], law["signal_green"]) == (0.0, 1.0, 0.0)
    assert law["signal_distance"] == pytest.approx(37.5 / 400.0)
    assert (law["stop_distance"], law["switch_in"]) == (1.0, -1.0)
    assert (law["limit_distance_1"], law["limit_1"]) == pytest.approx((37.5 / 400.0, 8.0 / 25.0))
    for flatten in (None, *spaces.FLATTEN):
        made = spaces.observation(seen, MAPLESS, flatten)
        assert spaces.observation_space(MAPLESS, flatten).contains(made)
    short, long = (spaces.observation(seen, MAPLESS, flatten) for flatten in spaces.FLATTEN)
    assert len(long) == len(short) + len(spaces.LAW_FEATURES)
    unknown = seen._replace(rules=NO_RULES)
    assert spaces.observation_space(MAPLESS, None).contains(spaces.observation(unknown, MAPLESS, None))


def test_the_example_of_a_policy_that_keeps_the_law_stops_at_red() -> None:
    page = (Path(__file__).parents[2] / "docs" / "guides" / "extending.md").read_text(encoding="utf-8")
    code = next(c for c in re.findall(r"```python\n(.*?)```", page, re.S) if "signal_distance" in c)
    space: dict[str, object] = {}
    exec(code, space)
    policy = space["stops_at_red"]
    assert callable(policy)
    assert policy(view(street(), snapshot("rGr", front=88.0))) == MetaAction.DECELERATE
    assert policy(view(street(), snapshot("GGr", front=40.0))) == MetaAction.ACCELERATE
    assert policy(view(street(), snapshot("rGr", front=20.0))) != MetaAction.DECELERATE, "it is far away"
    assert policy(view(street(), snapshot("GGr", front=95.0))) == MetaAction.DECELERATE, (
        "8 m/s on the junction"
    )


# ---- maps ----


def channel(history: History) -> np.ndarray:
    """The newest road channel [H,W]."""
    return np.asarray(history.velocity_map[-1, LAW_DRAWN.channels.index("road")])


def ahead(picture: np.ndarray, start: float, end: float, left: float = 0.5) -> set[int]:
    """The pixels from `start` to `end` m ahead of the AV's centre, `left` m beside it."""
    u = np.arange(int(start / 2) + 64, int(end / 2) + 64)
    return set(picture[int(16 - left), u].tolist())


@pytest.mark.parametrize(
    ("state", "pixel"),
    [("r", RED_LINE), ("u", RED_LINE), ("y", YELLOW_LINE), ("g", GIVE_WAY), ("s", STOP_SIGN)],
)
def test_version_2_draws_a_stop_line_by_its_signal(state: str, pixel: int) -> None:
    """The AV's centre is at x = 60: the line is drawn 37.5 to 40 m ahead, the crossing 44 to 48 m."""
    picture = channel(look(street(), snapshot(state + "Gr"), LAW_DRAWN))
    assert ahead(picture, 36.0, 42.0) == {ROAD_SURFACE, pixel}
    assert ahead(picture, 30.0, 36.0) == {ROAD_SURFACE}
    assert CROSSING in ahead(picture, 44.0, 50.0)
    assert ahead(picture, 50.0, 120.0) == {ROAD_SURFACE}, "the second signal is green"


def test_a_green_signal_leaves_the_road_as_it_is() -> None:
    """One raster all along: red is drawn, and taken away again."""
    observer = Observer(street(), LAW_DRAWN)
    pictures = []
    for states in ("rGr", "GGr", "GrG"):
        observer.add(snapshot(states))
        pictures.append(channel(observer.histories(lambda _: ROUTE, lambda _: (None, 0))["av"]).copy())
    assert RED_LINE in ahead(pictures[0], 36.0, 42.0)
    assert ahead(pictures[1], 36.0, 42.0) == {ROAD_SURFACE}
    assert np.count_nonzero(pictures[2] == RED_LINE) == 0, "the second line lies outside the picture"


@pytest.mark.parametrize(
    ("rule", "pixel"), [(Rule.YIELD, GIVE_WAY), (Rule.EQUAL, GIVE_WAY), (Rule.STOP, STOP_SIGN)]
)
def test_version_2_draws_the_lines_of_signs(rule: Rule, pixel: int) -> None:
    picture = channel(look(street(first=rule, signals=False), snapshot(), LAW_DRAWN))
    assert ahead(picture, 36.0, 42.0) == {ROAD_SURFACE, pixel}
    free = channel(look(street(signals=False), snapshot(), LAW_DRAWN))
    assert ahead(free, 36.0, 42.0) == {ROAD_SURFACE}


def test_a_line_is_drawn_only_where_every_way_has_to_obey_it() -> None:
    """From the first lane one way has the right of way, another one (a left turn) gives way."""
    road = street(signals=False)
    turning = RoadMap(road.lanes, links=(*road.links, Link(0, -1, 4, -1, Rule.YIELD)))
    assert ahead(channel(look(turning, snapshot(), LAW_DRAWN)), 36.0, 42.0) == {ROAD_SURFACE}


def test_version_1_draws_no_law() -> None:
    picture = channel(look(street(), snapshot("rrr"), ObservationConfig()))
    assert set(np.unique(picture).tolist()) <= {0, ROAD_SURFACE, ROAD_LINE}
    bare = rasterize_road(RoadMap(street().lanes)).cells
    assert np.array_equal(rasterize_road(street()).cells, bare)
    with pytest.raises(BadInput, match="road_version"):
        ObservationConfig(road_version=3)
