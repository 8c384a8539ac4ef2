"""Paths ahead: lanes, dead ends, rings, bridges."""

import numpy as np
import pytest

import cosim.road
from cosim.road import ConflictZone, Lane, RoadMap
from cosim.simulation.fake import straight_road


def merge_road() -> RoadMap:
    """Two edges: `in` with lanes 0 (ends) and 1, then `out` with one lane that follows lane 1."""
    shape = lambda x0, x1, y: np.array([[x0, y], [x1, y]])  # noqa: E731
    return RoadMap(
        (
            Lane("in_0", "in", 0, shape(0.0, 120.0, 0.0), 120.0, 3.2, 25.0, (), left=1, start="a", end="b"),
            Lane(
                "in_1", "in", 1, shape(0.0, 120.0, 3.2), 120.0, 3.2, 25.0, (2,), right=0, start="a", end="b"
            ),
            Lane("out_0", "out", 0, shape(120.0, 400.0, 3.2), 280.0, 3.2, 25.0, (), start="b", end="c"),
        ),
        zones=(ConflictZone("join", frozenset({2})),),
    )


def test_a_lane_that_ends_beside_one_that_goes_on_is_a_dead_end() -> None:
    road = merge_road()
    assert road.path(0).dead_end
    assert road.path(0).length == pytest.approx(120.0)
    assert not road.path(1).dead_end


def test_a_route_makes_a_lane_that_does_not_follow_it_a_dead_end() -> None:
    road = merge_road()
    assert road.path(0, ("in", "out")).dead_end
    keep = road.path(1, ("in", "out"))
    assert keep.leaves
    assert not keep.dead_end
    assert keep.length == pytest.approx(400.0)


def test_routes_that_lead_the_same_way_share_a_path_and_not_all_are_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cosim.road, "MAX_CACHED_PATHS", 5)
    road = merge_road()
    paths = {id(road.path(0, ("in", "out", f"far{k}"))) for k in range(20)}
    assert len(paths) == 1
    assert len(road._paths) <= 5
    assert road.path(1, ("in", "out")) is not road.path(1, ("in", "out", "far")), "it does not arrive there"


def test_route_knowledge_measures_from_the_vehicle() -> None:
    route = merge_road().ahead(1, lane_position=22.5, length=5.0, route=("in", "out"))
    assert route.arc == pytest.approx(20.0)
    assert route.conflict_distance == pytest.approx(120.0 - 22.5)  # front bumper to the zone
    assert route.paths[0] is None
    assert route.to_end(2) == pytest.approx(100.0)
    assert route.to_end(1) == np.inf


def test_a_pose_on_a_bend_turns_with_it_and_goes_straight_beyond_the_end() -> None:
    bend = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    path = RoadMap((Lane("a_0", "a", 0, bend, 20.0, 3.2, 25.0),)).path(0)
    x, y, heading = path.pose(np.array([5.0, 15.0, 25.0, -2.0]))
    assert x == pytest.approx([5.0, 10.0, 10.0, -2.0])
    assert y == pytest.approx([0.0, 5.0, 15.0, 0.0])
    assert heading == pytest.approx([0.0, np.pi / 2, np.pi / 2, 0.0])


def test_a_ring_is_followed_once_round_at_most() -> None:
    ring = tuple(
        Lane(f"r{k}_0", f"r{k}", 0, np.array(s), 20.0, 3.2, 10.0, ((k + 1) % 4,))
        for k, s in enumerate(
            (
                [[0.0, 0.0], [20.0, 0.0]],
                [[20.0, 0.0], [20.0, 20.0]],
                [[20.0, 20.0], [0.0, 20.0]],
                [[0.0, 20.0], [0.0, 0.0]],
            )
        )
    )
    assert RoadMap(ring).path(0).lanes == (0, 1, 2, 3)


def test_roads_at_different_heights_do_not_touch() -> None:
    level = np.array([[-500.0, 0.0], [500.0, 0.0]])
    below = Lane("low_0", "low", 0, level, 1000.0, 3.2, 25.0, start="w", end="e")
    above = Lane("high_0", "high", 0, level[:, ::-1].copy(), 1000.0, 3.2, 25.0, start="s", end="n")
    ramp = Lane(
        "ramp_0", "ramp", 0, np.array([[500.0, 0.0], [600.0, 50.0]]), 110.0, 3.2, 25.0, start="e", end="x"
    )
    road = RoadMap((below, above, ramp))
    assert not road.connected(0, 1)
    assert road.connected(0, 2)
    assert road.connected(0, -1)
    assert list(road.contact.touch(0, np.array([0, 1, 2, -1]))) == [True, False, True, True]


def test_a_person_below_a_bridge_touches_nobody_on_it() -> None:
    level = np.array([[-500.0, 0.0], [500.0, 0.0]])

    def lane(edge: str, start: str, end: str) -> Lane:
        return Lane(f"{edge}_0", edge, 0, level, 1000.0, 3.2, 25.0, start=start, end=end)

    # a footpath along the road below, stairs from there to the bridge, and a path in the woods
    below, above = lane("low", "w", "e"), lane("high", "s", "n")
    paths = lane("path", "w", "e"), lane("stairs", "e", "n"), lane("woods", "x", "y")
    road = RoadMap((below, above), closed=paths)
    path, stairs, woods, sidewalk = (-2 - road.contact.edges[e] for e in ("path", "stairs", "woods", "low"))
    assert not road.connected(1, path)
    assert not road.connected(1, sidewalk)
    assert not road.connected(0, 1), "nobody drives up the stairs"
    assert road.connected(0, path)
    assert road.connected(0, sidewalk)
    assert road.connected(0, stairs)
    assert road.connected(1, stairs)
    assert not road.connected(0, woods)
    assert road.connected(woods, -1)


def test_other_drivers_are_taken_to_go_straight_on() -> None:
    east = np.array([[0.0, 0.0], [50.0, 0.0]])
    lanes = (
        Lane("a_0", "a", 0, east, 50.0, 3.2, 10.0, (1, 2)),
        Lane("left_0", "left", 0, np.array([[50.0, 0.0], [50.0, 50.0]]), 50.0, 3.2, 10.0),
        Lane("on_0", "on", 0, east + np.array([50.0, 0.0]), 50.0, 3.2, 10.0),
    )
    assert RoadMap(lanes).path(0).lanes == (0, 2)


def test_the_fake_road_is_three_lanes_side_by_side() -> None:
    road = straight_road(3, 1000.0, 25.0)
    assert [lane.left for lane in road.lanes] == [1, 2, -1]
    assert [lane.right for lane in road.lanes] == [-1, 0, 1]
