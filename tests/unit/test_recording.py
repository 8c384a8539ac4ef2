"""Recordings: what was driven comes back exactly, and nothing half-written counts."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.episode import Episode
from cosim.errors import BadInput
from cosim.recording.file import Recording, read, write
from cosim.recording.folder import Folder
from cosim.recording.recorder import Recorder
from cosim.recording.roads import read_road, text
from cosim.recording.views import histories, tracks, windows
from cosim.road import ConflictZone, Crossing, Lane, Link, RoadMap, RouteAhead, Rule
from cosim.road.rules import RulesAhead
from cosim.scenario import Mission, load
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import (
    COMPACT,
    Actor,
    Collision,
    Decision,
    Entry,
    Events,
    History,
    HumanError,
    Intervention,
    MetaAction,
    Snapshot,
)


def drive(simulator: FakeSimulator, recorder: Recorder) -> list[dict[str, History]]:
    """A short episode with commanded AVs; what they saw at every decision."""
    scenario = replace(load("merge"), warmup=0.0, duration=3.2, mission=Mission(kind="none"))
    episode = Episode(scenario, simulator, COMPACT)
    seen = [episode.start(7, [recorder])]
    actions = [MetaAction.LANE_LEFT, MetaAction.ACCELERATE, MetaAction.DECELERATE]
    while not episode.over:
        decisions = {name: Decision(actions[len(seen) % 3]) for name in seen[-1] if name != "quiet"}
        # maps are views that are written over after N more frames
        seen[-1] = {k: h._replace(velocity_map=h.velocity_map.copy()) for k, h in seen[-1].items()}
        seen.append(episode.advance(decisions))
    return seen


def world() -> FakeSimulator:
    """Two AVs and two humans; one human leaves the road of 400 m before the episode ends."""
    return FakeSimulator(
        [
            FakeVehicle("av", 150.0, 0, 20.0, is_av=True),
            FakeVehicle("quiet", 100.0, 1, 15.0, is_av=True),
            FakeVehicle("human", 200.0, 0, 25.0, mission=True),
            FakeVehicle("leaver", 380.0, 1, 20.0),
        ],
        length=400.0,
    )


NOT_RECORDED = ("time_loss", "co2", "waiting")

Driven = tuple[Path, Recorder, list[dict[str, History]], RoadMap]


@pytest.fixture
def driven(tmp_path: Path) -> Driven:
    simulator, recorder = world(), Recorder()
    seen = drive(simulator, recorder)
    file = tmp_path / "a-7.parquet"
    write(file, recorder, {"scenario": "fake", "behavior": "mixed"})
    return file, recorder, seen, simulator.road


def assert_same(a: Snapshot, b: Snapshot) -> None:
    for field in fields(Snapshot):
        if field.name in NOT_RECORDED:
            continue
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y, err_msg=field.name)
            assert x.dtype == y.dtype, field.name
        else:
            assert x == y, field.name


def test_every_snapshot_comes_back_exactly(driven: Driven) -> None:
    file, tape, _, _ = driven
    recording = read(file)
    assert recording.case["scenario"] == "fake"
    assert recording.first == tape.first
    found = recording.snapshots()
    assert len(found) == len(tape.frames) == 17
    for a, b in zip(found, tape.frames, strict=True):
        assert_same(a, b)
    assert "leaver" in found[0].ids
    assert "leaver" not in found[-1].ids


def test_histories_built_from_a_recording_are_the_ones_the_policy_saw(driven: Driven) -> None:
    file, _, seen, road = driven
    rebuilt = list(histories(read(file), road, COMPACT))
    assert [frame for frame, _ in rebuilt] == list(range(0, 17, 2))
    for (_, found), wanted in zip(histories(read(file), road, COMPACT), seen, strict=True):
        assert found.keys() == wanted.keys()
        for name, history in found.items():
            # the law's parts beside the others
            for part, value in zip(
                (*history, *history.rules), (*wanted[name], *wanted[name].rules), strict=True
            ):
                if isinstance(value, np.ndarray):
                    np.testing.assert_array_equal(part, value)
                elif not isinstance(value, RouteAhead | RulesAhead):
                    assert part == value
            assert history.route.paths[1] is not None
            assert history.route.arc == wanted[name].route.arc
    assert any(h.lane_changing for found in seen for h in found.values()), "commands were recorded too"


def test_events_come_back(tmp_path: Path) -> None:
    tape = Recorder()
    drive(world(), tape)
    hit = Collision(1.0, "av", "human", True, False, "overlap", "box", "road_0", 1.0, 2.0, True, True)
    entry, corrected = Entry(0.7, "av", 3, "y", 9.0, 8.0), Intervention(0.5, "av", "red light")
    erring = HumanError(0.6, "human", "inattention", 2.6, "sees nobody for 2.0 s", "av")
    happened = Events((hit,), ("late",), ("early",), ("lost",), ("stopped",), (entry,), (corrected,))
    happened = replace(happened, errors=(erring,))
    tape.frames[3] = replace(tape.frames[3], events=happened)
    write(tmp_path / "x.parquet", tape, {})
    found = read(tmp_path / "x.parquet").snapshots()
    assert found[3].events == happened
    assert found[2].events == tape.frames[2].events


def test_actors_and_signals_come_back(driven: Driven, tmp_path: Path) -> None:
    _, tape, _, _ = driven
    tape.frames = [
        replace(f, actor=np.full(f.n, Actor.TRUCK, np.int8), signals=np.frombuffer(b"rG", np.uint8) + k % 2)
        for k, f in enumerate(tape.frames)
    ]
    write(tmp_path / "x.parquet", tape, {})
    for a, b in zip(read(tmp_path / "x.parquet").snapshots(), tape.frames, strict=True):
        assert_same(a, b)


def test_what_lacks_a_column_or_the_signals_is_no_recording(driven: Driven, tmp_path: Path) -> None:
    table = pq.read_table(driven[0])
    about = json.loads(table.schema.metadata[b"cosim"])
    pq.write_table(table.drop_columns("actor"), tmp_path / "actor.parquet")
    del about["signals"]
    pq.write_table(table.replace_schema_metadata({"cosim": json.dumps(about)}), tmp_path / "signals.parquet")
    for what in ("actor", "signals"):
        with pytest.raises(BadInput, match=rf"not a recording: .*{what}"):
            read(tmp_path / f"{what}.parquet")


def test_a_road_comes_back_exactly(tmp_path: Path) -> None:
    shape = np.array([[0.1, 0.2], [1 / 3, 7.7]])
    road = RoadMap(
        (
            Lane("e_0", "e", 0, shape, 10.1, 3.2, 13.89, (1,), 1, -1, True, "a", "b"),
            Lane("f_0", "f", 0, shape, 1.0, 3.2, 5.0),
        ),
        (ConflictZone("z", frozenset({1})),),
        (np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.5]]),),
        (Link(1, -1, 0, 0, Rule.STOP, (0,)),),
        (("light", 0),),
        (Crossing(":j_c0", shape, 4.0, (0, 1), 0),),
        (Lane("path_0", "path", 0, shape, 5.0, 2.0, 2.0, start="a", end="b"),),
    )
    file = tmp_path / "road.json"
    file.write_text(text(road))
    found = read_road(file)
    assert text(found) == text(road)
    np.testing.assert_array_equal(found.lanes[0].shape, shape)
    assert found.lanes[0].successors == (1,)
    assert found.zones == road.zones
    assert (found.links, found.signals) == (road.links, road.signals)
    assert found.links[0].rule is Rule.STOP
    assert found.crossings[0].lanes == (0, 1)
    assert [lane.id for lane in found.closed] == ["path_0"]
    file.write_text("{}")
    with pytest.raises(BadInput, match="not a recorded road"):
        read_road(file)


def test_only_whole_episodes_count(driven: Driven, tmp_path: Path) -> None:
    folder = Folder(tmp_path / "out")
    folder.prepare()
    with pytest.raises(BadInput, match=r"no manifest\.json"):
        folder.manifest()
    folder.episode_file("whole-1").write_bytes(driven[0].read_bytes())
    folder.episode_file("whole-1").with_name(".half-2.parquet.part").write_bytes(b"PAR1")
    assert folder.episodes() == ["whole-1"]
    assert folder.has("whole-1")
    assert not folder.has("half-2")
    assert [r.case["scenario"] for r in folder.recordings()] == ["fake"]
    assert not list(folder.recordings(scenarios=["merge"]))


@pytest.mark.parametrize("content", [b"", b"PAR1 and nothing more", b"{}"])
def test_what_is_no_recording_is_bad_input(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "x.parquet"
    file.write_bytes(content)
    with pytest.raises(BadInput, match=r"x\.parquet"):
        read(file)


def turning(frames: int = 30) -> Recording:
    """An AV that stands, a car that turns left past +-pi, one that enters late and one that leaves early."""
    shown = []
    for k in range(frames):
        here = [
            n for n, there in (("av", True), ("early", k < 15), ("late", k >= 5), ("turn", True)) if there
        ]
        angle = 0.2 * k + 2.5
        pose = {
            "av": (0.0, 0.0, 0.0, 0.0),
            "early": (10.0 + k, 5.0, 0.0, 5.0),
            "late": (20.0, 5.0 + k, np.pi / 2, 5.0),
            "turn": (30.0 + np.cos(angle), np.sin(angle), (angle + np.pi) % (2 * np.pi) - np.pi, 1.0),
        }
        x, y, heading, speed = np.array([pose[n] for n in here]).T
        n = len(here)
        shown.append(
            Snapshot(
                0.2 * k, tuple(here), np.array([name == "av" for name in here], np.int8), np.zeros(n, bool),
                x, y, heading, speed, np.zeros(n), np.full(n, 5.0), np.full(n, 2.0),
                np.zeros(n, np.int32), np.zeros(n),
            )
        )  # fmt: skip
    file = Path("turning.parquet")
    recorder = Recorder()
    recorder.begin(shown[:10])
    for frame in shown[10:]:
        recorder.add(frame)
    write(file, recorder, {})
    return read(file)


def test_tracks_and_windows_know_who_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    recording = turning()
    found = tracks(recording)
    assert recording.ids == ("av", "early", "late", "turn")
    np.testing.assert_allclose(np.diff(found.state[3, :, 3]), 0.2, atol=1e-9, err_msg="unwrapped")
    assert np.isnan(found.state[1, 15:]).all()
    assert np.isnan(found.state[2, :5]).all()
    assert found.is_av.tolist() == [True, False, False, False]
    w = windows(recording, every=5, frames=10, horizon=10)
    assert sorted(set(w.frame.tolist())) == [9, 14, 19, 24]
    early, late, turn = (
        (w.past[:, -1, 0] == 10.0 + w.frame),
        w.past[:, -1, 0] == 20.0,
        w.past[:, -1, 0] > 28.9,
    )
    assert w.frame[early].tolist() == [9, 14], "who has left is not predicted any more"
    assert np.isnan(w.future[early][0, 5:]).all()
    assert np.isfinite(w.future[early][0, :5]).all()
    assert np.isfinite(w.past[late][0]).all(1).sum() == 5, "a short history"
    past, future = w.past[turn][1], w.future[turn][1]
    np.testing.assert_allclose(np.diff(np.concatenate([past[:, 3], future[:, 3]])), 0.2, atol=1e-9)


def test_windows_leave_out_what_no_av_perceives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    recording = turning()
    near = windows(recording, every=5, perceived=25.0)
    everyone = windows(recording, every=5, perceived=None)
    assert (near.past[:, -1, 0] < 25.0).all()
    assert len(everyone.lane) > len(near.lane)
