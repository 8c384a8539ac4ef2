"""The guide AV of an episode, and how it makes room for the merging vehicle (T, figure 8)."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cosim.recording.replay_data import ReplayData, Track
from cosim.report.replay.strip import Strip, poses_at
from cosim.road import Lane
from cosim.scenario.options import EpisodeOptions
from cosim.types import Floats, Kind
from cosim.workers.tasks import Progress
from research.drive import Runner

SLOWS, YIELDS, OVERTAKES, OTHER, NONE = KINDS = (
    "slows down in its lane",
    "yields to the left",
    "yields, then overtakes",
    "neither",
    "no AV at the merging point",
)
LOOKBACK = 15.0  # s before the merge in which the guide AV may make room
GUIDE_REACH = (-125.0, 20.0)  # m along the road from the merging vehicle: AVs that perceive or pass it
MIN_SLOWING = 2.0  # m/s lost by an AV that makes room
LANE_WIDTH = 3.2  # m
WIDTH, HEIGHT = 760, 120  # pixels of a snapshot
PICTURE_TIMES = (-5.0, 0.0, 5.0)  # s from the merge


@dataclass(frozen=True, slots=True)
class Guided:
    """One episode: times in s from the merge, speeds in m/s."""

    kind: str
    merged: float | None  # s from the episode's start; None: it never merged
    guide: str = ""
    mission: str = ""
    times: tuple[float, ...] = ()
    guide_speed: tuple[float | None, ...] = ()  # None: not on the road then
    mission_speed: tuple[float | None, ...] = ()


class GuideRunner(Runner):
    """Hosted by the engine: drives an episode, classifies its guide AV and takes three pictures."""

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """`seed`, `trace_hash`, `crashed`; `guided`: the fields of `Guided`; `pictures`: PNG files."""
        result, replay = self.open(case, warnings).run_recorded(case.seed, progress)
        found = guided(replay)
        facts = {"seed": case.seed, "trace_hash": result.trace_hash, "crashed": result.value("crashed")}
        return {**facts, "guided": asdict(found), "pictures": _pictures(replay, found)}


def guided(r: ReplayData) -> Guided:
    """The guide AV of a recorded episode, and the kind of its maneuver."""
    mission = next((t for t in r.tracks if t.mission), None)
    at = None if mission is None else _merge(r, mission)
    if mission is None or at is None:
        return Guided(OTHER, None)
    k = at - mission.first
    frame = _Frame(mission, k, r.road.lanes[int(mission.lane[k])])
    avs = [t for t in r.tracks if t.kind == Kind.AV]
    candidates = [(gap, t) for t in avs if (gap := frame.distance(t, at, r.interval)) is not None]
    merged = float(r.times[at] - r.begin)
    if not candidates:
        return Guided(NONE, merged, mission=mission.id)
    guide = min(candidates, key=lambda one: one[0])[1]
    times = r.times - r.times[at]
    return Guided(
        frame.kind(guide, at, r.interval),
        merged,
        guide.id,
        mission.id,
        tuple(np.round(times, 3).tolist()),
        _speeds(guide, len(times)),
        _speeds(mission, len(times)),
    )


def _merge(r: ReplayData, mission: Track) -> int | None:
    """The first frame after the merging vehicle's change to the left; None without a change."""
    lanes = r.road.lanes
    for k in range(1, len(mission.lane)):
        a, b = int(mission.lane[k - 1]), int(mission.lane[k])
        if (
            a >= 0
            and b >= 0
            and a != b
            and lanes[a].edge == lanes[b].edge
            and lanes[b].index > lanes[a].index
        ):
            return mission.first + k
    return None


class _Frame:
    """The road along the (straight) lane that was merged into, and to the left of it, in m."""

    def __init__(self, mission: Track, k: int, lane: Lane) -> None:
        self._mission, self._k = mission, k
        ahead = lane.shape[-1] - lane.shape[0]
        self._ahead = ahead / np.hypot(*ahead)
        self._left = np.array([-self._ahead[1], self._ahead[0]])
        self._middle = float(lane.shape[0] @ self._left)

    def along(self, t: Track) -> Floats:
        """[k] m"""
        return np.asarray(np.stack([t.x, t.y], 1) @ self._ahead)

    def across(self, t: Track) -> Floats:
        """[k] m to the left of the middle of the lane that was merged into."""
        return np.asarray(np.stack([t.x, t.y], 1) @ self._left) - self._middle

    def distance(self, t: Track, at: int, interval: float) -> float | None:
        """m from the merging vehicle along the road; None: not in the target lane shortly before, or far."""
        now = at - t.first
        first = max(now - round(LOOKBACK / interval), 0)
        if not 0 <= now < len(t.x) or not (np.abs(self.across(t)[first : now + 1]) < LANE_WIDTH / 2).any():
            return None
        gap = float(self.along(t)[now] - self.along(self._mission)[self._k])
        return abs(gap) if GUIDE_REACH[0] <= gap <= GUIDE_REACH[1] else None

    def kind(self, t: Track, at: int, interval: float) -> str:
        """One of KINDS."""
        now = at - t.first
        first = max(now - round(LOOKBACK / interval), 0)
        across = self.across(t)
        if across[now] - across[first] > LANE_WIDTH / 2:
            return YIELDS
        speeds = t.speed[first : now + 1]
        slowed = float((np.maximum.accumulate(speeds) - speeds).max()) >= MIN_SLOWING
        end = min(t.first + len(t.x), self._mission.first + len(self._mission.x)) - 1
        ahead = self.along(t)[end - t.first] - self.along(self._mission)[end - self._mission.first]
        if slowed and (across[now:] - across[now]).max() > LANE_WIDTH / 2 and ahead > 0.0:
            return OVERTAKES
        return SLOWS if slowed else OTHER


def _speeds(t: Track, frames: int) -> tuple[float | None, ...]:
    """[frames] m/s, the vehicle's speed; None: not on the road."""
    found: list[float | None] = [None] * frames
    for k, speed in enumerate(t.speed.tolist()):
        found[t.first + k] = round(speed, 3)
    return tuple(found)


def _pictures(r: ReplayData, found: Guided) -> list[bytes]:
    """The road around the merging vehicle at PICTURE_TIMES; [] without a guide AV."""
    if not found.guide or found.merged is None:
        return []
    pictures = []
    for shift in PICTURE_TIMES:
        time = float(np.clip(r.begin + found.merged + shift, r.times[0], r.times[-1]))
        poses = poses_at(r, time)
        middle = next((p for p in poses if p.track.id == found.mission), None)
        if middle is None:
            continue
        strip = Strip(middle.x, middle.y, WIDTH, HEIGHT)
        strip.road(r)
        for pose in poses:
            strip.vehicle(pose)
        for pose in poses:
            if pose.track.id in (found.mission, found.guide):
                strip.name(pose)
        raw = io.BytesIO()
        strip.finished().save(raw, "PNG", optimize=True)
        pictures.append(raw.getvalue())
    return pictures
