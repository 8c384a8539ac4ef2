"""Which AV made room for the merging vehicle, and how, on made-up drives with known answers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.recording.replay_data import ReplayData, Track
from cosim.road import Lane, RoadMap
from cosim.types import Floats, Kind
from research import figure8
from research.drive import Settings
from research.guide import NONE, OTHER, OVERTAKES, SLOWS, YIELDS, GuideRunner, guided
from tests.research.claims import arms, rows

INTERVAL = 0.2  # s
LANES = (1.6, 4.8, 8.0)  # m, the middles of the acceleration lane and of the two main lanes
FRAMES, MERGE = 100, 60  # of a made-up drive, and the one in which the merging vehicle is on the main road


def track(
    name: str, x: Floats, y: Floats, speed: Floats, kind: Kind = Kind.AV, mission: bool = False
) -> Track:
    """A drive eastwards; the lane is the one whose middle is nearest."""
    lane = np.abs(y[:, None] - np.array(LANES)).argmin(1)
    still = np.zeros(len(x))
    return Track(name, kind, mission, "", 5.0, 2.0, 0, x, y, still, speed, still, lane)


def drive(*others: Track) -> ReplayData:
    """The merging vehicle (20 m/s) is in the first main lane from frame MERGE on; `others` are beside it."""
    lanes = tuple(
        Lane(f"acc_{k}", "acc", k, np.array([[0.0, y], [2000.0, y]]), 2000.0, 3.2, 30.0)
        for k, y in enumerate(LANES)
    )
    times = INTERVAL * np.arange(FRAMES)
    merging = track("mission", 20.0 * times, lateral((MERGE, LANES[1]), start=LANES[0]),
                    np.full(FRAMES, 20.0), Kind.HV, mission=True)  # fmt: skip
    facts: dict[str, Any] = {}
    tracks = (merging, *others)
    return ReplayData(facts, RoadMap(lanes), 0.0, INTERVAL, times, tracks, times, (), (), ())


def lateral(*changes: tuple[int, float], start: float = LANES[1]) -> Floats:
    """[FRAMES] m: in the middle of a lane until a change, then of another."""
    y = np.full(FRAMES, start)
    for frame, to in changes:
        y[frame:] = to
    return y


def follower(speed: Floats, y: Floats, gap: float = 10.0, name: str = "av") -> Track:
    """An AV that is `gap` m behind the merging vehicle when that merges."""
    x = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL * (speed[1:] + speed[:-1]))])
    return track(name, x - x[MERGE] + 20.0 * INTERVAL * MERGE - gap, y, speed)


STEADY = np.full(FRAMES, 20.0)
SLOWING = np.concatenate([np.linspace(25.0, 18.0, MERGE), np.full(FRAMES - MERGE, 18.0)])
BACK = np.concatenate([np.linspace(25.0, 18.0, MERGE), np.full(FRAMES - MERGE, 30.0)])


@pytest.mark.parametrize(
    ("av", "kind"),
    [
        (follower(SLOWING, lateral()), SLOWS),
        (follower(STEADY, lateral((MERGE - 15, LANES[2]))), YIELDS),
        (follower(BACK, lateral((MERGE + 5, LANES[2]))), OVERTAKES),
        (follower(SLOWING, lateral((MERGE + 5, LANES[2]))), SLOWS),  # it moved over, but stayed behind
        (follower(STEADY, lateral()), OTHER),
        (follower(STEADY, lateral(start=LANES[2])), NONE),  # in the far lane throughout
        (follower(STEADY, lateral(), gap=150.0), NONE),  # too far behind to be meant
    ],
    ids=["slows", "left", "overtakes", "behind", "keeps on", "far lane", "far behind"],
)
def test_the_guide_av_is_sorted_by_how_it_made_room(av: Track, kind: str) -> None:
    found = guided(drive(av))
    assert found.kind == kind
    assert found.merged == pytest.approx(INTERVAL * MERGE)
    assert found.guide == ("" if kind == NONE else "av")


def test_the_guide_is_the_nearest_and_an_episode_without_a_merge_has_none() -> None:
    near, far = follower(SLOWING, lateral(), 12.0, "near"), follower(STEADY, lateral(), 40.0, "far")
    found = guided(drive(far, near))
    assert (found.guide, found.mission) == ("near", "mission")
    assert found.guide_speed[MERGE] == pytest.approx(18.0)
    assert found.times[MERGE] == 0.0
    data = drive(near)
    alone = [t for t in data.tracks if not t.mission]
    assert guided(ReplayData(**{**vars(data), "tracks": tuple(alone)})).merged is None


def test_the_page_counts_the_kinds_and_shows_the_first_of_each(tmp_path: Path) -> None:
    slows = asdict(guided(drive(follower(SLOWING, lateral()))))
    never = {**slows, "merged": None, "kind": OTHER}
    episodes = [
        {"seed": k, "trace_hash": "ab" * 32, "guided": kind, "pictures": []}
        for k, kind in enumerate((never, slows))
    ]
    (key, arm), *_ = arms({("merge", "altruist"): rows([], 2)}).items()
    arm.cell.scenario = type("Scenario", (), {"behavior": "moderate"})  # type: ignore[misc, assignment]
    page = figure8.write({key: (arm, episodes)}, Settings(), tmp_path).read_text()
    assert "An AV made room in 1 of 2 episodes of `altruist`." in page
    assert "| 50 (9 to 91) % |" in page
    assert (
        "## altruist: slows down in its lane\n\n, moderate HVs, seed 1, trace hash\n`abababababababab`;"
        in page
    )
    assert "## altruist: yields to the left" not in page
    assert (tmp_path / "t_figure8-altruist-1.svg").stat().st_size > 1000
    assert "altruist,,slows down in its lane,share,0.5," in (tmp_path / "data" / "t_figure8.csv").read_text()


def test_episodes_are_recorded_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path), "--workers", "1"]
    flags += ["--seeds", "150000:150001", "--duration", "1.2"]
    assert figure8.main(flags) == 0
    files = sorted((tmp_path / "runs" / figure8.FOLDER).glob("*.json"))
    assert len(files) == 2 * 2  # arms and demands
    before = (tmp_path / "t_figure8.md").read_bytes()
    monkeypatch.setattr(GuideRunner, "run", lambda *_: pytest.fail("driven again"))
    assert figure8.main(flags) == 0
    assert (tmp_path / "t_figure8.md").read_bytes() == before
