"""The road of one moment from above, drawn by Pillow twice as fine as it is shown."""

import math
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cosim.recording.recorder import Choice
from cosim.recording.replay_data import ReplayData, Track
from cosim.types import Floats, Kind, MetaAction

FINE = 2  # drawn this much larger, then reduced: smooth edges
ACROSS = 200.0  # m of road in the picture's width
SIGMAS = 2.0  # half the width of a predicted interval, in standard deviations

GROUND, ROAD, EDGE, JUNCTION = (238, 241, 244), (201, 206, 214), (255, 255, 255), (188, 194, 203)
TEXT, BAD, WARN = (27, 33, 41), (200, 30, 30), (180, 83, 9)
MISSION, AV = (184, 69, 155), (0, 114, 178)
DRIVERS = {"conservative": (0, 158, 115), "moderate": (230, 159, 0), "aggressive": (213, 94, 0)}
OTHER = (125, 133, 144)
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


def poses_at(r: ReplayData, time: float) -> list[Pose]:
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
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib; `size` in pixels."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    with resources.as_file(resources.files("matplotlib") / "mpl-data" / "fonts" / "ttf" / name) as file:
        return ImageFont.truetype(str(file), size)


class Strip:
    """A picture of `width` x `height` pixels around (x, y) in m; metres become pixels here."""

    def __init__(self, x: float, y: float, width: int, height: int) -> None:
        self._image = Image.new("RGB", (width * FINE, height * FINE), GROUND)
        self._pen = ImageDraw.Draw(self._image, "RGBA")
        self._x, self._y = x, y
        self._scale = width * FINE / ACROSS  # pixels per m
        self._middle = 0.5 * width * FINE, 0.5 * height * FINE
        self._half = 0.5 * ACROSS + 15.0, 0.5 * ACROSS * height / width + 15.0  # m seen, and some

    def _pixels(self, points: Floats) -> list[tuple[float, float]]:
        """[p,2] m -> pixels"""
        columns = self._middle[0] + (points[:, 0] - self._x) * self._scale
        rows = self._middle[1] - (points[:, 1] - self._y) * self._scale
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def _pixel(self, x: float, y: float) -> tuple[float, float]:
        return self._pixels(np.array([[x, y]]))[0]

    def sees(self, points: Floats) -> bool:
        """Whether points [p,2] m reach into the picture."""
        low, high = points.min(0), points.max(0)
        here = np.array([self._x, self._y])
        return bool((high > here - self._half).all() and (low < here + self._half).all())

    def finished(self) -> Image.Image:
        """The picture in its own size."""
        return self._image.reduce(FINE)

    def road(self, r: ReplayData) -> None:
        """Junctions, then lanes with their edges."""
        for outline in r.road.junctions:
            if self.sees(outline):
                self._pen.polygon(self._pixels(outline), fill=JUNCTION)
        lanes = [lane for lane in r.road.lanes if self.sees(lane.shape)]
        for internal, colour, less in ((True, ROAD, 0.2), (False, EDGE, -0.2), (False, ROAD, 0.2)):
            for lane in lanes:
                if lane.internal == internal:
                    width = max(round((lane.width - less) * self._scale), 1)
                    self._pen.line(self._pixels(lane.shape), fill=colour, width=width, joint="curve")

    def forecast(self, r: ReplayData, k: int) -> None:
        """Predicted paths, with an ellipse every second that holds the interval."""
        forecast = r.forecasts[k] if 0 <= k < len(r.forecasts) else None
        if forecast is None:
            return
        colours = {t.id: colour_of(t) for t in r.tracks}
        every = max(round(1.0 / forecast.interval), 1)
        for v, name in enumerate(forecast.ids):
            points = np.stack([forecast.x[v], forecast.y[v]], axis=1)
            if name not in colours or not self.sees(points):
                continue
            colour = colours[name]
            self._pen.line(self._pixels(points), fill=(*colour, 190), width=FINE + 1)
            deviations = np.stack([forecast.along_std[v], forecast.across_std[v]])  # [2,M] m
            along, across = np.maximum(SIGMAS * deviations, 0.3)
            for m in range(every - 1, len(points), every):
                ring = _ellipse(points[m], along[m], across[m], forecast.heading[v, m])
                self._pen.polygon(self._pixels(ring), fill=(*colour, 36), outline=(*colour, 130))

    def vehicle(self, p: Pose) -> None:
        """The box, its windscreen, brake lights, and the sensor on an AV's roof."""
        t, length, w = p.track, p.track.length, p.track.width

        def box(back: float, front: float, side: float) -> list[tuple[float, float]]:
            corners = np.array([[back, -side], [front, -side], [front, side], [back, side]])
            return self._pixels(_placed(corners, p.x, p.y, p.heading))

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
        d = c.decision
        if d.vetoed or d.fallback:
            colour = BAD if d.fallback else WARN
            ring = _ellipse(np.array([p.x, p.y]), 0.62 * p.track.length, 0.62 * p.track.length, 0.0)
            self._pen.line(self._pixels(np.concatenate([ring, ring[:1]])), fill=colour, width=2 * FINE)
            if other := others.get(d.blamed or ""):
                ends = [self._pixel(p.x, p.y), self._pixel(other.x, other.y)]
                self._pen.line(ends, fill=(*colour, 170), width=FINE)
        glyph = "×" if c.blocked else GLYPHS.get(d.action)
        if glyph:
            x, y = self._pixel(p.x, p.y - p.track.width / 2 - 1.2)
            self._text(x, y, glyph, BAD if c.blocked else AV, 15, bold=True)

    def name(self, p: Pose) -> None:
        """The vehicle's id above it."""
        x, y = self._pixel(p.x, p.y + p.track.width / 2 + 1.3)
        self._text(x, y, p.track.id, TEXT, 11)

    def crash(self, x: float, y: float) -> None:
        """A cross in a ring."""
        px, py = self._pixel(x, y)
        a, b = 16 * FINE, 9 * FINE
        self._pen.ellipse((px - a, py - a, px + a, py + a), outline=BAD, width=3 * FINE)
        self._pen.line((px - b, py - b, px + b, py + b), fill=BAD, width=3 * FINE)
        self._pen.line((px - b, py + b, px + b, py - b), fill=BAD, width=3 * FINE)

    def _text(self, x: float, y: float, text: str, colour: Colour, size: int, *, bold: bool = False) -> None:
        """Centred at pixel (x, y) of the fine picture, with a light rim."""
        self._pen.text(
            (x, y), text, fill=colour, font=font(size * FINE, bold), anchor="mm",
            stroke_width=2 * FINE, stroke_fill=(255, 255, 255),
        )  # fmt: skip


def _placed(points: Floats, x: float, y: float, heading: float) -> Floats:
    """Points [p,2] m of a body's own frame, in the world."""
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + (x, y))


def _ellipse(centre: Floats, along: float, across: float, heading: float) -> Floats:
    """[24,2] m"""
    turn = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
    ring = np.stack([along * np.cos(turn), across * np.sin(turn)], axis=1)
    return _placed(ring, float(centre[0]), float(centre[1]), heading)
