"""The replay as an MP4: a strip of road that follows one vehicle, drawn by Pillow, encoded by PyAV."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cosim.evaluation.replay.recorder import Choice, Recording, Track
from cosim.types import Floats, Kind, MetaAction

WIDTH, HEIGHT = 1280, 400  # pixels
PANEL = 124  # pixels of text beneath the road
FINE = 2  # drawn this much larger, then reduced: smooth edges
RATE = 10  # pictures a second
ACROSS = 200.0  # m of road in the picture's width
SIGMAS = 2.0  # half the width of a predicted interval, in standard deviations
SHOWN_CRASH = 4.0  # s that a collision stays marked

GROUND, ROAD, EDGE, JUNCTION = (238, 241, 244), (201, 206, 214), (255, 255, 255), (188, 194, 203)
TEXT, QUIET, BAD, WARN, GOOD = (27, 33, 41), (95, 107, 122), (200, 30, 30), (180, 83, 9), (21, 128, 61)
MISSION, AV = (184, 69, 155), (0, 114, 178)
DRIVERS = {"conservative": (0, 158, 115), "moderate": (230, 159, 0), "aggressive": (213, 94, 0)}
OTHER = (125, 133, 144)
ACTIONS = {
    MetaAction.LANE_LEFT: "lane left",
    MetaAction.IDLE: "idle",
    MetaAction.LANE_RIGHT: "lane right",
    MetaAction.ACCELERATE: "accelerate",
    MetaAction.DECELERATE: "decelerate",
}
GLYPHS = {
    MetaAction.LANE_LEFT: "←",
    MetaAction.LANE_RIGHT: "→",
    MetaAction.ACCELERATE: "↑",
    MetaAction.DECELERATE: "↓",
}
Colour = tuple[int, ...]


class Pose(NamedTuple):
    """One vehicle at one moment."""

    track: Track
    x: float  # m
    y: float  # m
    heading: float  # rad
    speed: float  # m/s
    accel: float  # m/s2


def film(
    recording: Recording,
    path: Path,
    *,
    follow: str | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> None:
    """Write the MP4. `follow`: a vehicle's id (default: the mission vehicle, else the first AV).

    The file appears whole or not at all. Raises OSError when it cannot be written.
    """
    r = recording
    begin, end = float(r.times[0]), float(r.times[-1])
    count = max(round((end - begin) * RATE) + 1, 1)
    camera = _Camera(r, follow)
    draft = path.with_name(f".{path.name}.part")
    try:
        with av.open(str(draft), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", rate=RATE)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            stream.options = {"crf": "23", "preset": "veryfast"}
            for k in range(count):
                picture = picture_at(r, min(begin + k / RATE, end), camera)
                for packet in stream.encode(av.VideoFrame.from_image(picture)):
                    container.mux(packet)
                if progress is not None:
                    progress(k + 1, count)
            for packet in stream.encode():
                container.mux(packet)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


class _Camera:
    """Whom the film follows, and where it looks while that vehicle is not on the road."""

    def __init__(self, recording: Recording, follow: str | None) -> None:
        tracks = recording.tracks
        wanted = [t for t in tracks if t.id == follow] if follow is not None else []
        wanted = wanted or [t for t in tracks if t.mission] or [t for t in tracks if t.kind == Kind.AV]
        self.follow = (wanted or [*tracks] or [None])[0]
        self.x, self.y = (0.0, 0.0) if self.follow is None else (self.follow.x[0], self.follow.y[0])

    def look(self, poses: list[Pose]) -> Pose | None:
        """Move to the followed vehicle; the AV whose decision is explained: itself, else the nearest one."""
        name = None if self.follow is None else self.follow.id
        here = next((p for p in poses if p.track.id == name), None)
        if here is not None:
            self.x, self.y = here.x, here.y
            if here.track.kind == Kind.AV:
                return here
        avs = [p for p in poses if p.track.kind == Kind.AV]
        return min(avs, key=lambda p: math.hypot(p.x - self.x, p.y - self.y), default=None)


def picture_at(r: Recording, time: float, camera: _Camera) -> Image.Image:
    """One picture of the film, WIDTH x HEIGHT."""
    poses = poses_at(r, time)
    shown = camera.look(poses)
    strip = _Strip(camera.x, camera.y)
    k = int(np.searchsorted(r.decided, time + 1e-6, side="right")) - 1
    choices: Mapping[str, Choice] = r.choices[k] if 0 <= k < len(r.choices) else {}
    strip.road(r)
    strip.forecast(r, k)
    for pose in poses:
        strip.vehicle(pose)
    by_name = {p.track.id: p for p in poses}
    for pose in poses:
        if pose.track.id in choices:
            strip.choice(pose, choices[pose.track.id], by_name)
        if pose.track.mission or pose is shown:
            strip.name(pose)
    for crash in r.collisions:
        if math.isfinite(crash.x) and 0.0 <= time - crash.time + 0.05 < SHOWN_CRASH:
            strip.crash(crash.x, crash.y)
    strip.panel(r, time, camera, by_name, shown, choices)
    return strip.image.reduce(FINE)


def poses_at(r: Recording, time: float) -> list[Pose]:
    """Everybody on the road at `time` s, on the straight line between two frames."""
    k = max(int(np.searchsorted(r.times, time + 1e-6, side="right")) - 1, 0)
    span = r.times[k + 1] - r.times[k] if k + 1 < len(r.times) else 1.0
    u = min(max((time - r.times[k]) / span, 0.0), 1.0)
    found = []
    for t in r.tracks:
        i = k - t.first
        if not 0 <= i < len(t.x):
            continue
        j = min(i + 1, len(t.x) - 1)
        turn = (t.heading[j] - t.heading[i] + math.pi) % (2.0 * math.pi) - math.pi
        x, y, speed, accel = (a[i] + u * (a[j] - a[i]) for a in (t.x, t.y, t.speed, t.accel))
        found.append(Pose(t, x, y, t.heading[i] + u * turn, speed, accel))
    return found


def colour_of(track: Track) -> Colour:
    """Mission vehicles first, then AVs, then HVs by class."""
    if track.mission:
        return MISSION
    return AV if track.kind == Kind.AV else DRIVERS.get(track.driver, OTHER)


@lru_cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib; `size` in pixels of the finished picture."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    with resources.as_file(resources.files("matplotlib") / "mpl-data" / "fonts" / "ttf" / name) as file:
        return ImageFont.truetype(str(file), size * FINE)


class _Strip:
    """The picture under the pen; metres become pixels here."""

    def __init__(self, x: float, y: float) -> None:
        self.image = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), GROUND)
        self._pen = ImageDraw.Draw(self.image, "RGBA")
        self._x, self._y = x, y
        self._scale = WIDTH * FINE / ACROSS  # pixels per m
        self._middle = 0.5 * WIDTH * FINE, 0.5 * (HEIGHT - PANEL) * FINE
        self._half = 0.5 * ACROSS + 15.0, 0.5 * ACROSS * (HEIGHT - PANEL) / WIDTH + 15.0  # m seen, and some

    def _pixels(self, points: Floats) -> list[tuple[float, float]]:
        """[p,2] m -> pixels"""
        columns = self._middle[0] + (points[:, 0] - self._x) * self._scale
        rows = self._middle[1] - (points[:, 1] - self._y) * self._scale
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def _pixel(self, x: float, y: float) -> tuple[float, float]:
        return self._pixels(np.array([[x, y]]))[0]

    def _sees(self, points: Floats) -> bool:
        low, high = points.min(0), points.max(0)
        here = np.array([self._x, self._y])
        return bool((high > here - self._half).all() and (low < here + self._half).all())

    def road(self, r: Recording) -> None:
        """Junctions, then lanes with their edges."""
        for outline in r.road.junctions:
            if self._sees(outline):
                self._pen.polygon(self._pixels(outline), fill=JUNCTION)
        lanes = [lane for lane in r.road.lanes if self._sees(lane.shape)]
        for internal in (True, False):
            mine = [lane for lane in lanes if lane.internal == internal]
            for colour, less in ((EDGE, -0.2), (ROAD, 0.2)):
                if internal and colour == EDGE:
                    continue
                for lane in mine:
                    width = max(round((lane.width - less) * self._scale), 1)
                    self._pen.line(self._pixels(lane.shape), fill=colour, width=width, joint="curve")

    def forecast(self, r: Recording, k: int) -> None:
        """Predicted paths, with an ellipse every second that holds the interval."""
        forecast = r.forecasts[k] if 0 <= k < len(r.forecasts) else None
        if forecast is None:
            return
        tracks = {t.id: t for t in r.tracks}
        every = max(round(1.0 / forecast.interval), 1)
        for v, name in enumerate(forecast.ids):
            points = np.stack([forecast.x[v], forecast.y[v]], axis=1)
            if name not in tracks or not self._sees(points):
                continue
            colour = colour_of(tracks[name])
            self._pen.line(self._pixels(points), fill=(*colour, 190), width=FINE + 1)
            for m in range(every - 1, len(points), every):
                along = max(SIGMAS * forecast.along_std[v, m], 0.3)
                across = max(SIGMAS * forecast.across_std[v, m], 0.3)
                ring = _ellipse(points[m], along, across, forecast.heading[v, m])
                self._pen.polygon(self._pixels(ring), fill=(*colour, 36), outline=(*colour, 130))

    def vehicle(self, p: Pose) -> None:
        """The box, its windscreen, brake lights, and the sensor on an AV's roof."""
        t = p.track
        length, w = t.length, t.width

        def box(back: float, front: float, side: float) -> list[tuple[float, float]]:
            corners = np.array([[back, -side], [front, -side], [front, side], [back, side]])
            return self._pixels(_placed(corners, p.x, p.y, p.heading))

        if not self._sees(np.array([[p.x, p.y]])):
            return
        self._pen.polygon(
            box(-length / 2, length / 2, w / 2), fill=colour_of(t), outline=(255, 255, 255), width=FINE
        )
        self._pen.polygon(box(0.12 * length, 0.25 * length, 0.38 * w), fill=(255, 255, 255, 200))
        if p.accel < -1.0:
            self._pen.polygon(box(-length / 2, -0.4 * length, w / 2), fill=(255, 32, 32))
        if t.kind == Kind.AV:
            roof = _ellipse(np.zeros(2), 0.2 * w, 0.2 * w, 0.0) - (0.16 * length, 0.0)
            self._pen.polygon(self._pixels(_placed(roof, p.x, p.y, p.heading)), fill=(255, 255, 255, 210))

    def choice(self, p: Pose, c: Choice, others: Mapping[str, Pose]) -> None:
        """The command beside the car; a ring where it was vetoed, a line to who was blamed."""
        if not self._sees(np.array([[p.x, p.y]])):
            return
        d = c.decision
        if d.vetoed or d.fallback:
            colour = BAD if d.fallback else WARN
            ring = _ellipse(np.array([p.x, p.y]), 0.62 * p.track.length, 0.62 * p.track.length, 0.0)
            self._pen.line(self._pixels(np.concatenate([ring, ring[:1]])), fill=colour, width=2 * FINE)
            if d.blamed in others:
                other = others[d.blamed]
                ends = [self._pixel(p.x, p.y), self._pixel(other.x, other.y)]
                self._pen.line(ends, fill=(*colour, 170), width=FINE)
        glyph = "×" if c.blocked else GLYPHS.get(d.action)
        if glyph:
            x, y = self._pixel(p.x, p.y - p.track.width / 2 - 1.2)
            self._text(x, y, glyph, BAD if c.blocked else AV, 15, bold=True, anchor="mm", around=True)

    def name(self, p: Pose) -> None:
        """The vehicle's id above it."""
        x, y = self._pixel(p.x, p.y + p.track.width / 2 + 1.3)
        self._text(x, y, p.track.id, TEXT, 11, anchor="mm", around=True)

    def crash(self, x: float, y: float) -> None:
        """A cross in a ring."""
        px, py = self._pixel(x, y)
        a, b = 16 * FINE, 9 * FINE
        self._pen.ellipse((px - a, py - a, px + a, py + a), outline=BAD, width=3 * FINE)
        self._pen.line((px - b, py - b, px + b, py + b), fill=BAD, width=3 * FINE)
        self._pen.line((px - b, py + b, px + b, py - b), fill=BAD, width=3 * FINE)

    def panel(
        self,
        r: Recording,
        time: float,
        camera: _Camera,
        here: Mapping[str, Pose],
        shown: Pose | None,
        choices: Mapping[str, Choice],
    ) -> None:
        """What the page says too: the episode, the followed vehicle, and one AV's decision explained."""
        top = (HEIGHT - PANEL) * FINE
        self._pen.rectangle((0, top, WIDTH * FINE, HEIGHT * FINE), fill=(255, 255, 255))
        f, line = r.facts, top / FINE
        label = f" ({f['policy_label']})" if f.get("policy_label") else ""
        title = f"{f.get('scenario')} / {f.get('demand')} / {f.get('policy')}{label}"
        self._line(14, line + 8, title, TEXT, 15, bold=True)
        self._line(
            14, line + 30, f"seed {f.get('seed')}, {f.get('preset')}, svo {f.get('svo_deg'):g}°", QUIET
        )
        self._line(14, line + 50, f"{time - r.begin:5.1f} s of {r.times[-1] - r.begin:.0f} s", TEXT, 14)
        outcome, colour = _outcome(r, time)
        self._line(14, line + 72, outcome, colour, 14)
        followed = None if camera.follow is None else here.get(camera.follow.id)
        if camera.follow is not None:
            t = camera.follow
            what = "AV" if t.kind == Kind.AV else f"human, {t.driver}"
            what += ", mission vehicle" if t.mission else ""
            where = f"{followed.speed:.1f} m/s" if followed is not None else "not on the road"
            self._line(14, line + 96, f"{t.id} ({what}): {where}", colour_of(t), 13)
        if shown is not None:
            self._decision(470, line, shown, choices.get(shown.track.id))

    def _decision(self, left: float, top: float, av_: Pose, c: Choice | None) -> None:
        name = f"{av_.track.id}, {av_.speed:.1f} m/s: "
        if c is None:
            self._line(left, top + 8, f"{name}driven by SUMO, no command", AV, 14)
            return
        d = c.decision
        self._line(left, top + 8, f"{name}{ACTIONS[d.action]}, target {c.target:.0f} m/s", AV, 14, bold=True)
        words, colour = [], QUIET
        if d.vetoed:
            words, colour = [f"preferred action vetoed, blamed {d.blamed}"], WARN
        if d.fallback:
            words, colour = [*words, "no action safe"], BAD
        if c.blocked:
            words, colour = [*words, f"command blocked: {c.blocked}"], BAD
        self._line(left, top + 28, "; ".join(words) or "command executed", colour, 13)
        rows = [
            (n, a) for n, a in (("Q", d.q), ("score s", d.safety_score), ("TTC s", d.ttc)) if a is not None
        ]
        if not rows:
            return
        for a in MetaAction:
            x = left + 90 + 132 * int(a)
            unsafe = d.unsafe is not None and bool(d.unsafe[a])
            colour = AV if a == d.action else BAD if unsafe else TEXT
            self._line(x, top + 50, ACTIONS[a], colour, 13, bold=a == d.action)
            for k, (_, values) in enumerate(rows):
                self._line(x, top + 67 + 17 * k, f"{values[a]:.2f}", BAD if unsafe else TEXT, 13)
        for k, (row, _) in enumerate(rows):
            self._line(left, top + 67 + 17 * k, row, QUIET, 13)

    def _line(
        self, x: float, y: float, text: str, colour: Colour, size: int = 13, *, bold: bool = False
    ) -> None:
        self._text(x * FINE, y * FINE, text, colour, size, bold=bold)

    def _text(
        self,
        x: float,
        y: float,
        text: str,
        colour: Colour,
        size: int,
        *,
        bold: bool = False,
        anchor: str = "la",
        around: bool = False,
    ) -> None:
        stroke = 2 * FINE if around else 0
        self._pen.text(
            (x, y), text, fill=colour, font=_font(size, bold), anchor=anchor,
            stroke_width=stroke, stroke_fill=(255, 255, 255),
        )  # fmt: skip


def _outcome(r: Recording, time: float) -> tuple[str, Colour]:
    """What has happened so far, in a few words."""
    crashes = [c for c in r.collisions if c.time <= time + 0.05]
    if crashes:
        return f"collision: {crashes[-1].collider} hit {crashes[-1].victim}", BAD
    served = r.facts.get("mission_time_s")
    if served is not None and time - r.begin >= served - 0.05:
        return f"mission fulfilled at {served:.1f} s", GOOD
    return "no collision so far", QUIET


def _placed(points: Floats, x: float, y: float, heading: float) -> Floats:
    """Points [p,2] m of a body's own frame, in the world."""
    c, s = math.cos(heading), math.sin(heading)
    return points @ np.array([[c, s], [-s, c]]) + (x, y)


def _ellipse(centre: Floats, along: float, across: float, heading: float) -> Floats:
    """[24,2] m"""
    turn = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
    ring = np.stack([along * np.cos(turn), across * np.sin(turn)], axis=1)
    return _placed(ring, float(centre[0]), float(centre[1]), heading)
