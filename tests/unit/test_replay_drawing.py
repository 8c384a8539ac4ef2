"""Replays without SUMO: recording changes nothing, the page holds everything, the film is a film."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from cosim.episode import Episode, run_episode
from cosim.recording.recorder import Recorder
from cosim.recording.replay_data import ReplayData, replay_data
from cosim.report.replay.packing import document
from cosim.report.replay.page import page
from cosim.report.replay.signs import LAMPS, states_at, stop_lines, zebra
from cosim.report.replay.strip import Strip, command_sign, poses_at
from cosim.report.replay.video import CAPTION, HEIGHT, LOW, SMALL, WIDTH, animation, film, picture_at
from cosim.report.replay.video import _Camera as Camera
from cosim.road import Crossing, Lane, Link, RoadMap, Rule
from cosim.types import (
    Actor,
    Decision,
    Events,
    Forecast,
    History,
    HumanError,
    Intervention,
    Kind,
    MetaAction,
    ObservationConfig,
    Offence,
    PolicyContext,
)
from policy.agents.keep_lane import KeepLane
from tests.contracts.fake_worlds import platoon, scenario, wall

COLUMNS = (
    "kind",
    "mission",
    "x",
    "y",
    "heading",
    "speed",
    "accel",
    "length",
    "width",
    "lane",
    "lane_position",
)


class Explains:
    """Tries the lane to its left for ever, says why it brakes, and what it predicts."""

    name = "explains"
    label = "made up"
    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}
    last_forecast: Forecast | None = None

    def reset(self, context: PolicyContext) -> None:
        self.last_forecast = None

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        ahead = 5.0 * np.arange(1.0, 11.0)[None] + np.array([h.pose[0] for h in histories.values()])[:, None]
        level = np.ones_like(ahead)
        self.last_forecast = Forecast(
            tuple(histories), ahead, 1.6 * level, 0.0 * level, 0.3 * level * np.arange(10), 0.1 * level, 0.2
        )
        why = Decision(
            MetaAction.LANE_LEFT,
            q=np.array([0.5, 0.25, 0.0, -1.0, 0.125], np.float32),
            safety_score=np.array([1.0, 2.0, 3.0, 4.0, 5.0], np.float32),
            unsafe=np.array([True, False, False, True, False]),
            ttc=np.array([0.5, 10.0, 10.0, 1.5, np.inf], np.float32),
            blamed="human",
            vetoed=True,
        )
        return dict.fromkeys(histories, why)


def driven(
    world: Any = platoon, seconds: float = 4.0, policy: Any = None, limit: float = np.inf
) -> tuple[ReplayData, str]:
    """An episode on the fake simulator, and its trace hash."""
    policy, simulator = policy or Explains(), world()
    recorder = Recorder(policy, limit)
    episode = Episode(scenario(seconds), simulator, policy.observation)
    result = run_episode(episode, policy, 200_000, svo=0.5, hooks=[recorder])
    return replay_data(recorder, simulator, result.document()), result.trace_hash


@pytest.fixture(scope="module")
def replay() -> ReplayData:
    return driven()[0]


def unpacked(text: str) -> dict[str, Any]:
    """The document inside a page."""
    match = re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)
    assert match is not None
    found: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(match[1])))
    return found


def restored(steps: list[int], unit: float, order: int = 1) -> np.ndarray:
    """As assets/data.js does."""
    values = np.array(steps, np.int64)
    for _ in range(order):
        values = np.cumsum(values)
    return values * unit


def test_an_episode_that_is_recorded_is_the_same_episode() -> None:
    policy, world = Explains(), platoon()
    episode = Episode(scenario(), world, policy.observation)
    alone = run_episode(episode, policy, 200_000, svo=0.5)
    assert driven()[1] == alone.trace_hash


def test_every_vehicle_is_followed_through_every_frame(replay: ReplayData) -> None:
    assert replay.times == pytest.approx(0.2 * np.arange(21))
    assert sorted(t.id for t in replay.tracks) == ["a", "b", "c", "human"]
    for track in replay.tracks:
        assert (track.first, len(track.x)) == (0, 21)
        driven = np.diff(track.x)
        assert driven == pytest.approx(0.2 * (track.speed[1:] + track.speed[:-1]) / 2, abs=0.25)


def test_what_was_decided_predicted_and_refused_is_kept(replay: ReplayData) -> None:
    assert replay.decided == pytest.approx(0.4 * np.arange(10))
    assert set(replay.choices[0]) == {"a", "b", "c"}
    blocked = [choices["a"].blocked for choices in replay.choices]
    assert blocked[0] is None  # the first change begins ...
    assert blocked[1] == "a lane change is under way"
    assert blocked[-1] == "no lane on that side"  # ... and there are two lanes only
    forecast = replay.forecasts[3]
    assert forecast is not None
    assert forecast.ids == ("a", "b", "c")


def test_the_page_holds_the_positions_to_half_a_centimetre(replay: ReplayData) -> None:
    data = unpacked(page(replay))
    names = [v[0] for v in data["vehicles"]]
    for packed in data["tracks"]:
        track = next(t for t in replay.tracks if t.id == names[packed[0]])
        assert packed[1] == track.first
        assert restored(packed[2], 0.01, 2) == pytest.approx(track.x, abs=0.006)
        assert restored(packed[3], 0.01, 2) == pytest.approx(track.y, abs=0.006)
        assert restored(packed[5], 0.01) == pytest.approx(track.speed, abs=0.006)
    path = next(p for p in data["forecasts"][0] if names[p[0]] == "a")
    assert replay.forecasts[0] is not None
    assert restored(path[1], 0.1) == pytest.approx(replay.forecasts[0].x[0, 1::2], abs=0.051)
    assert restored(path[3], 0.1) == pytest.approx(0.3 * np.arange(1, 10, 2), abs=0.051)


def test_the_page_holds_values_vetoes_blame_and_refusals(replay: ReplayData) -> None:
    data = unpacked(page(replay))
    names, words = [v[0] for v in data["vehicles"]], data["words"]
    vehicle, action, _, flags, blamed, blocked, q, score, ttc, unsafe = data["choices"][-1][0]
    assert names[vehicle] == "a"
    assert MetaAction(action) == MetaAction.LANE_LEFT
    assert flags == 1  # vetoed, no fallback
    assert words[blamed] == "human"
    assert words[blocked] == "no lane on that side"
    assert q == [0.5, 0.25, 0.0, -1.0, 0.125]
    assert score == [1, 2, 3, 4, 5]
    assert ttc == [0.5, 10, 10, 1.5, None]  # JSON knows no infinity
    assert unsafe == [1, 0, 0, 1, 0]


def test_the_page_needs_no_network_and_names_no_other_file(replay: ReplayData) -> None:
    text = page(replay)
    assert "default-src 'none'" in text
    assert not re.search(r"https?://|\bsrc=|<link|@import|\bimport\(|fetch\(", text)
    assert len(text) < 100_000


def test_names_from_outside_cannot_break_the_page() -> None:
    found, _ = driven()
    evil = "</script><img onerror=alert(1)>"
    found = replace(found, facts={**found.facts, "scenario": evil})
    text = page(found)
    assert evil not in text
    assert unpacked(text)["facts"]["scenario"] == evil


def test_a_collision_is_marked_where_it_happened() -> None:
    found, _ = driven(wall, 6.0, KeepLane())
    data = unpacked(page(found))
    assert [(c["collider"], c["victim"]) for c in data["collisions"]] == [("a", "standing")]
    crash = data["collisions"][0]
    assert found.collisions[0].time * 1000 == pytest.approx(crash["t"])
    assert 100 < crash["x"] < 140


def test_a_long_recording_keeps_every_other_frame_and_stays_small() -> None:
    found, _ = driven(limit=40)  # vehicle frames, of 84
    assert sum(len(t.x) for t in found.tracks) <= 40 + 4
    assert found.interval == pytest.approx(0.8)
    assert len(found.choices) == 10  # decisions are all kept
    kept = [time for time, f in zip(found.decided, found.forecasts, strict=True) if f is not None]
    assert kept
    assert all(np.isclose(found.times, time).any() for time in kept[:-1])


def test_a_vehicle_that_was_away_has_two_tracks() -> None:
    world, recorder = platoon(), Recorder()
    (first,) = world.reset(0)
    recorder.begin([first])
    gone = replace(
        first,
        ids=first.ids[1:],
        **{name: getattr(first, name)[1:] for name in COLUMNS},
    )
    recorder.add(replace(gone, time=0.2))
    recorder.add(replace(first, time=0.4))
    found = replay_data(recorder, world, {})
    tracks = [t for t in found.tracks if t.id == first.ids[0]]
    assert [(t.first, len(t.x)) for t in tracks] == [(0, 1), (2, 1)]
    assert first.ids[0] not in {p.track.id for p in poses_at(found, 0.2)}


def test_between_two_frames_a_vehicle_is_between_two_places(replay: ReplayData) -> None:
    a, b = (next(p for p in poses_at(replay, t) if p.track.id == "human") for t in (1.0, 1.2))
    middle = next(p for p in poses_at(replay, 1.1) if p.track.id == "human")
    assert middle.x == pytest.approx((a.x + b.x) / 2)
    assert a.x < middle.x < b.x


def test_a_vehicle_is_drawn_where_it_is(replay: ReplayData) -> None:
    pose = next(p for p in poses_at(replay, 0.0) if p.track.id == "human")
    strip = Strip(pose.x, pose.y, 640, 200)
    empty = np.asarray(strip.finished()).copy()
    strip.vehicle(pose)
    changed = np.argwhere((np.asarray(strip.finished()) != empty).any(axis=2))
    rows, columns = changed[:, 0], changed[:, 1]
    assert (rows.min() + rows.max()) / 2 == pytest.approx(100, abs=1.5)
    assert (columns.min() + columns.max()) / 2 == pytest.approx(320, abs=1.5)
    assert columns.max() - columns.min() == pytest.approx(5.0 * 640 / 200, abs=3)  # 5 m at 200 m a picture


def test_only_a_change_of_lanes_has_an_arrow_and_it_points_where_the_vehicle_goes() -> None:
    east, north, west = 0.0, math.pi / 2, math.pi
    assert [command_sign(MetaAction.LANE_LEFT, heading) for heading in (east, north, west)] == ["↗", "↖", "↙"]
    assert [command_sign(MetaAction.LANE_RIGHT, heading) for heading in (east, north, west)] == [
        "↘",
        "↗",
        "↖",
    ]
    assert command_sign(MetaAction.ACCELERATE, north) == "+"
    assert command_sign(MetaAction.DECELERATE, north) == "−"
    assert command_sign(MetaAction.IDLE, north) == ""


def test_the_film_has_ten_pictures_a_second_that_move(replay: ReplayData, tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    film([replay], path, follow="human")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(pictures) == 41
    assert pictures[0].shape == (HEIGHT, WIDTH, 3)
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_two_episodes_are_filmed_one_above_the_other_and_the_shorter_one_waits(
    replay: ReplayData, tmp_path: Path
) -> None:
    half = replace(replay, times=replay.times[: len(replay.times) // 2])
    film([replay, half], tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as container:
        pictures = [f.to_ndarray(format="rgb24") for f in container.decode(container.streams.video[0])]
    assert len(pictures) == 41
    assert pictures[0].shape == (2 * HEIGHT, WIDTH, 3)
    moved = np.abs(pictures[25].astype(int) - pictures[-1]).max((1, 2)) > 50
    assert moved[:HEIGHT].any()
    assert not moved[HEIGHT:].any()


def test_the_gif_is_small_moves_and_runs_twice_as_fast(replay: ReplayData, tmp_path: Path) -> None:
    path = tmp_path / "small.gif"
    animation([replay, replay], path)
    with Image.open(path) as gif:
        assert gif.size == (SMALL, 2 * (LOW + CAPTION))
        assert gif.n_frames == 11  # of 4 s
        assert gif.info["duration"] == 200
        first = np.asarray(gif.convert("RGB")).astype(int)
        gif.seek(gif.n_frames - 1)
        last = np.asarray(gif.convert("RGB")).astype(int)
    assert np.abs(first - last).max() > 50
    assert (first[: len(first) // 2] == first[len(first) // 2 :]).all()
    assert [p.name for p in tmp_path.iterdir()] == ["small.gif"]


def test_a_film_that_fails_leaves_nothing_behind(replay: ReplayData, tmp_path: Path) -> None:
    def stop(*_: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film([replay], tmp_path / "film.mp4", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_world_can_be_drawn() -> None:
    world, recorder = platoon(), Recorder()
    (first,) = world.reset(0)
    nobody = {name: getattr(first, name)[:0] for name in COLUMNS}
    empty = replace(first, ids=(), **nobody)
    recorder.begin([empty])
    data = document(replay_data(recorder, world, {}))
    assert data["tracks"] == []
    assert math.isclose(data["begin"], 0.0)


def lane(name: str, *points: tuple[float, float]) -> Lane:
    shape = np.array(points, float)
    return Lane(name, name, 0, shape, float(np.hypot(*(shape[-1] - shape[0]))), 3.2, 13.9)


# from the west end at (100, 1.6): to the north, straight on, to the south
CROSSROADS = (
    lane("west", (0, 1.6), (100, 1.6)),
    lane("north", (108, 10), (108, 100)),
    lane("east", (116, 1.6), (200, 1.6)),
    lane("south", (104, -10), (104, -100)),
)
RIGHT, STRAIGHT, LEFT = (Link(0, -1, target, 2 - k, Rule.YIELD) for k, target in enumerate((3, 2, 1)))


def at_signals(replay: ReplayData) -> ReplayData:
    """The platoon's episode on a road with three signals and a crossing; the first frame is red."""
    states = np.array([list(b"rrr")] + [list(b"GrG")] * (len(replay.times) - 1), np.uint8)
    crossing = Crossing("c", np.array([(104.0, -4.0), (104.0, 4.0)]), 4.0, (0,), 1)
    road = RoadMap(CROSSROADS, links=(RIGHT, STRAIGHT, LEFT), crossings=(crossing,))
    offences = (Offence(1.0, "a", "ran a red light"), Offence(2.0, "nobody", "ran a red light"))
    corrections = (Intervention(1.2, "a", "red light"), Intervention(1.4, "nobody", "red light"))
    return replace(replay, road=road, signals=states, offences=offences, interventions=corrections)


def test_lamps_stand_at_the_stop_line_from_the_left_turn_to_the_right_one() -> None:
    road = RoadMap(CROSSROADS, links=(RIGHT, STRAIGHT, LEFT))
    (line,) = stop_lines(road)
    assert (line.lane, line.signals) == (0, (0, 1, 2))


@pytest.mark.parametrize(
    ("rules", "drawn"),
    [
        ((Rule.YIELD, Rule.YIELD), Rule.YIELD),
        ((Rule.YIELD, Rule.PRIORITY), None),  # one way need not give way: no line across the lane
        ((Rule.STOP, Rule.YIELD), Rule.STOP),
        ((Rule.ALL_WAY_STOP, Rule.ALL_WAY_STOP), Rule.ALL_WAY_STOP),
        ((Rule.EQUAL, Rule.ZIPPER), None),
    ],
)
def test_a_line_is_drawn_where_the_lane_has_a_sign(rules: tuple[Rule, ...], drawn: Rule | None) -> None:
    links = tuple(Link(0, -1, k + 1, -1, rule) for k, rule in enumerate(rules))
    assert [line.rule for line in stop_lines(RoadMap(CROSSROADS, links=links))] == [drawn] * (
        drawn is not None
    )


def test_the_page_stores_the_changes_of_signals_not_their_frames(replay: ReplayData) -> None:
    data = document(at_signals(replay))
    assert data["signals"] == [["rG", [0, 1]], ["r", [0]], ["rG", [0, 1]]]
    assert data["stop_lines"] == [[0, int(Rule.YIELD), [0, 1, 2]]]
    assert [(width, signal) for width, _, signal in data["crossings"]] == [(400, 1)]


def test_a_page_without_signals_has_none(replay: ReplayData) -> None:
    data = document(replay)
    assert (data["signals"], data["stop_lines"], data["crossings"]) == ([], [], [])


def test_a_lamp_shows_the_state_of_its_time(replay: ReplayData) -> None:
    found = at_signals(replay)
    assert states_at(found, 0.1) == "rrr"
    assert states_at(found, 0.2) == "GrG"
    assert states_at(replay, 0.0) == ""
    for time, state in ((0.0, "r"), (1.0, "G")):
        strip = Strip(100.0, 1.6, 1280, 260)
        strip.road(found)
        strip.signs(found, stop_lines(found.road), time)
        left_turn = np.asarray(strip.finished())[130 - 6, 640 + 4]  # 1.1 m left of the middle, past the line
        assert left_turn == pytest.approx(np.array(LAMPS[state]), abs=3)


def test_a_zebra_crossing_is_stripes_across_the_way_on_foot() -> None:
    stripes = zebra(Crossing("c", np.array([(0.0, 0.0), (0.0, 8.0)]), 4.0, ()))
    assert len(stripes) == 8
    for stripe in stripes:
        assert np.ptp(stripe[:, 0]) == pytest.approx(4.0)
        assert np.ptp(stripe[:, 1]) == pytest.approx(0.5)


def test_what_avs_did_against_the_law_are_events(replay: ReplayData) -> None:
    data = document(at_signals(replay))
    names, words = [v[0] for v in data["vehicles"]], data["words"]
    assert [(t, names[v], words[w]) for t, v, w in data["violations"]] == [
        (1000, "a", "ran a red light"),
    ]


def test_corrections_are_events_with_their_reason(replay: ReplayData) -> None:
    data = document(at_signals(replay))
    names, words = [v[0] for v in data["vehicles"]], data["words"]
    assert [(t, names[v], words[w]) for t, v, w in data["interventions"]] == [(1200, "a", "red light")]


def test_the_film_marks_a_correction_while_it_is_new(replay: ReplayData) -> None:
    found = at_signals(replay)
    silent = replace(found, interventions=())
    camera = Camera(found, "a")
    marked = [np.asarray(picture_at(found, t, camera)) for t in (1.0, 1.4, 3.9)]
    plain = [np.asarray(picture_at(silent, t, camera)) for t in (1.0, 1.4, 3.9)]
    road = slice(0, HEIGHT - 140)
    assert [bool((a[road] != b[road]).any()) for a, b in zip(marked, plain, strict=True)] == [
        False,
        True,
        False,
    ]


def with_errors(replay: ReplayData) -> ReplayData:
    """From the warm-up one error goes on to 0.5 s; then "a" sees nobody from 1 s to 2 s."""
    before = HumanError(-1.0, "a", "hard_braking", 0.5, "brakes for no reason")
    errors = (before, HumanError(1.0, "a", "inattention", 2.0, "sees nobody for 1.0 s", "human"))
    return replace(replay, errors=(*errors, HumanError(1.0, "nobody", "inattention", 2.0, "sees nobody")))


def test_the_page_says_who_erred_when_and_how(replay: ReplayData) -> None:
    data = document(with_errors(replay))
    names, words = [v[0] for v in data["vehicles"]], data["words"]
    said = [(t, until, names[v], *(words[w] for w in more)) for t, until, v, *more in data["errors"]]
    assert said == [
        (-1000, 500, "a", "hard_braking", "brakes for no reason", ""),
        (1000, 2000, "a", "inattention", "sees nobody for 1.0 s", "human"),
    ]


def test_the_film_marks_who_errs_for_as_long_as_it_errs(replay: ReplayData) -> None:
    found = with_errors(replay)
    camera = Camera(found, "a")
    road = slice(0, HEIGHT - 140)
    marked = []
    for time in (0.2, 0.8, 1.4, 2.4):
        pictures = [np.asarray(picture_at(r, time, camera))[road] for r in (found, replay)]
        marked.append(bool((pictures[0] != pictures[1]).any()))
    assert marked == [True, False, True, False]


def test_an_error_of_the_warm_up_that_goes_on_is_kept() -> None:
    first = platoon().reset(0)[-1]
    errors = tuple(HumanError(first.time - 2.0, who, "inattention", first.time + s, "sees nobody")
                   for who, s in (("a", 1.0), ("human", -1.0)))  # fmt: skip
    recorder = Recorder()
    recorder.begin([replace(first, time=first.time - 2.0, events=Events(errors=errors)), first])
    recorder.add(replace(first, time=first.time + 0.2, events=Events(errors=errors[1:])))
    assert [error.who for error in recorder.errors] == ["a", "human"]


def test_long_reasons_stay_within_the_picture(replay: ReplayData) -> None:
    long = replace(at_signals(replay), interventions=(Intervention(1.2, "a", "because of this " * 40),))
    picture = np.asarray(picture_at(long, 1.4, Camera(long, "a")))
    assert (picture[HEIGHT - 130 :, WIDTH - 13 :] == 255).all()


def test_actors_are_told_apart_by_their_shape(replay: ReplayData) -> None:
    (track,) = [t for t in replay.tracks if t.id == "human"]
    drawn = set()
    for actor in Actor:
        strip = Strip(track.x[0], track.y[0], 640, 200)
        strip.vehicle(poses_at(replace(replay, tracks=(replace(track, actor=actor),)), 0.0)[0])
        drawn.add(np.asarray(strip.finished()).tobytes())
    assert len(drawn) == len(Actor)


def test_a_person_has_neither_driver_nor_brake_lights() -> None:
    world, recorder = platoon(), Recorder()
    (first,) = world.reset(0)
    kind = np.where(first.row["human"] == np.arange(first.n), Kind.PERSON, first.kind).astype(np.int8)
    recorder.begin([replace(first, kind=kind, actor=np.zeros(0, np.int8))])
    found = replay_data(recorder, world, {})
    (person,) = [t for t in found.tracks if t.id == "human"]
    assert (person.kind, person.actor, person.driver) == (Kind.PERSON, Actor.PERSON, "")
    data = document(found)
    assert data["vehicles"][[v[0] for v in data["vehicles"]].index("human")][1:4] == [int(Kind.PERSON), 0, ""]
    assert {int(a) for a in data["shapes"]} == {Actor.CAR, Actor.PERSON}
    pose = next(p for p in poses_at(found, 0.0) if p.track is person)
    pictures = []
    for accel in (0.0, -2.0):
        strip = Strip(pose.x, pose.y, 640, 200)
        strip.vehicle(pose._replace(accel=accel))
        pictures.append(np.asarray(strip.finished()))
    assert (pictures[0] == pictures[1]).all()
