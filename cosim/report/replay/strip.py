"""The road at one time from above, drawn by Pillow at twice the shown resolution."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cosim.recording.recorder import Choice
from cosim.recording.replay_data import ReplayData, Track
from cosim.report.replay.shapes import BODY, BRAKES, DARK, LEAST, LIGHT, SENSOR, SHAPES, Shape
from cosim.report.replay.signs import LAMPS, StopLine, heading_at_end, states_at, zebra
from cosim.road import Rule
from cosim.types import Actor, Floats, Kind, MetaAction

FINE = 2  # factor of the drawn resolution, for smooth edges
ACROSS = 200.0  # m of road across the picture's width
SEEN = 10.0  # pixels, minimum length of persons and bicycles
SIGMAS = 2.0  # half the width of a predicted interval, in standard deviations

GROUND, ROAD, EDGE, JUNCTION = (238, 241, 244), (201, 206, 214), (255, 255, 255), (188, 194, 203)
MARK = (255, 255, 255)  # paint on the road
TEXT, BAD, WARN = (27, 33, 41), (200, 30, 30), (180, 83, 9)
LAW, CORRECTION, ERROR = (109, 40, 217), (14, 116, 144), (124, 90, 18)
HOUSING, SIGN = (32, 37, 43), (200, 30, 30)
MISSION, AV = (184, 69, 155), (0, 114, 178)
DRIVERS = {"conservative": (0, 158, 115), "moderate": (230, 159, 0), "aggressive": (213, 94, 0)}
OTHER, PERSON = (125, 133, 144), (76, 52, 112)
SPEED = {MetaAction.ACCELERATE: "+", MetaAction.DECELERATE: "−"}
LANE = {MetaAction.LANE_LEFT: math.pi / 4, MetaAction.LANE_RIGHT: -math.pi / 4}  # rad from the heading
ARROWS = "→↗↑↖←↙↓↘"  # by eighths of a turn
Colour = tuple[int, ...]


def command_sign(action: MetaAction, heading: float) -> str:
    """The sign of a command beside an AV with `heading` (rad); "" for IDLE."""
    if action in LANE:
        return ARROWS[round((heading + LANE[action]) / (math.pi / 4)) % len(ARROWS)]
    return SPEED.get(action, "")


class Pose(NamedTuple):
    """One vehicle at one moment."""

    track: Track
    x: float  # m
    y: float  # m
    heading: float  # rad
    speed: float  # m/s
    accel: float  # m/s2


def poses_at(r: ReplayData, time: float) -> list[Pose]:
    """All vehicles and persons at `time` s, interpolated linearly between two frames."""
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
    """The colour by role: mission vehicle, person, AV, or the HV's driver class."""
    if track.mission:
        return MISSION
    if track.kind == Kind.PERSON:
        return PERSON
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
        self._half = 0.5 * ACROSS + 15.0, 0.5 * ACROSS * height / width + 15.0  # m, with a margin of 15

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

    def signs(self, r: ReplayData, lines: Sequence[StopLine], time: float) -> None:
        """Pedestrian crossings, stop lines with their signs, and signals in their colour at `time` s."""
        states = states_at(r, time)
        for crossing in r.road.crossings:
            if self.sees(crossing.shape):
                for stripe in zebra(crossing):
                    self._pen.polygon(self._pixels(stripe), fill=MARK)
                if 0 <= crossing.signal < len(states):
                    for x, y in (crossing.shape[0], crossing.shape[-1]):
                        self._lamp(_ellipse(np.array([x, y]), 0.5, 0.5, 0.0), states[crossing.signal])
        for line in lines:
            lane = r.road.lanes[line.lane]
            end = lane.shape[-1]
            if self.sees(end[None]):
                self._stop_line(end, heading_at_end(lane.shape), 0.46 * lane.width, line, states)

    def _stop_line(self, end: Floats, heading: float, side: float, line: StopLine, states: str) -> None:
        """`end` [2] m, `side`: half the width of the lane, m."""

        def paint(points: Sequence[tuple[float, float]], colour: Colour) -> None:
            self._pen.polygon(
                self._pixels(_placed(np.array(points), float(end[0]), float(end[1]), heading)), fill=colour
            )

        if line.signals or line.rule != Rule.YIELD:
            paint(((-0.5, -side), (0.0, -side), (0.0, side), (-0.5, side)), MARK)
        else:
            for k in range(4):
                y = side * (k / 2 - 1)
                paint(((0.0, y), (0.0, y + 0.5 * side), (-1.1, y + 0.25 * side)), MARK)
        if line.rule in (Rule.STOP, Rule.ALL_WAY_STOP) and not line.signals:
            turns = np.pi * (np.arange(8) / 4 + 0.125)
            for size, colour in ((1.0, MARK), (0.8, SIGN)):
                octagon = np.stack([np.cos(turns), np.sin(turns)], 1) * size + (1.2, 0.0)
                paint([(x, y) for x, y in octagon.tolist()], colour)
        lamps = [states[s] for s in line.signals if s < len(states)]
        wide = 2.0 * side / max(len(lamps), 1)
        for k, state in enumerate(lamps):
            left = side - wide * k
            corners = np.array([(0.15, left), (1.25, left), (1.25, left - wide), (0.15, left - wide)])
            self._lamp(_placed(corners, float(end[0]), float(end[1]), heading), state)

    def _lamp(self, outline: Floats, state: str) -> None:
        points = self._pixels(outline)
        self._pen.polygon(points, fill=LAMPS.get(state, OTHER), outline=HOUSING, width=FINE)

    def forecast(self, r: ReplayData, k: int) -> None:
        """Predicted paths, with the interval as an ellipse every second."""
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
        """Its shape; brake lights; the sensor on an AV's roof."""
        t = p.track
        parts = SHAPES[t.actor]
        if p.accel < -1.0 and t.actor not in (Actor.PERSON, Actor.BICYCLE):
            parts += BRAKES
        self.shape(parts + SENSOR * (t.kind == Kind.AV), p, colour_of(t))

    def shape(self, parts: Shape, p: Pose, colour: Colour) -> None:
        """Parts of a shape, enlarged to the minimum drawn size."""
        least = LEAST.get(p.track.actor, (0.0, 0.0))
        grown = max(SEEN * FINE / (self._scale * max(least)), 1.0) if any(least) else 1.0
        size = max(p.track.length, grown * least[0]), max(p.track.width, grown * least[1])
        fills: Mapping[str, Colour] = {BODY: colour, LIGHT: (255, 255, 255, 205), DARK: HOUSING}
        for name, points in parts:
            pixels = self._pixels(_placed(np.array(points) * size, p.x, p.y, p.heading))
            rim = (255, 255, 255) if name == BODY else None
            self._pen.polygon(pixels, fill=fills.get(name, (255, 32, 32)), outline=rim, width=FINE)

    def choice(self, p: Pose, c: Choice, others: Mapping[str, Pose]) -> None:
        """The command beside the car; a ring for a veto, a line to the blamed vehicle."""
        d = c.decision
        if d.vetoed or d.fallback:
            colour = BAD if d.fallback else WARN
            ring = _ellipse(np.array([p.x, p.y]), 0.62 * p.track.length, 0.62 * p.track.length, 0.0)
            self._pen.line(self._pixels(np.concatenate([ring, ring[:1]])), fill=colour, width=2 * FINE)
            if other := others.get(d.blamed or ""):
                ends = [self._pixel(p.x, p.y), self._pixel(other.x, other.y)]
                self._pen.line(ends, fill=(*colour, 170), width=FINE)
        if sign := "×" if c.blocked else command_sign(d.action, p.heading):
            x, y = self._pixel(p.x, p.y - p.track.width / 2 - 1.2)
            self._text(x, y, sign, BAD if c.blocked else AV, 15, bold=True)

    def broken(self, p: Pose, what: str) -> None:
        """The violated law, below the car."""
        x, y = self._pixel(p.x, p.y - p.track.width / 2 - 2.6)
        self._text(x, y, what, LAW, 12, bold=True)

    def corrected(self, p: Pose) -> None:
        """A square around an AV with an intervention of its car."""
        side = 0.62 * p.track.length * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        self._pen.line(self._pixels(side + np.array([p.x, p.y])), fill=CORRECTION, width=2 * FINE)

    def driver_error(self, p: Pose, other: Pose | None) -> None:
        """A triangle on a driver with an error, and a line to the vehicle affected first."""
        x, y = self._pixel(p.x, p.y)
        if other is not None:
            self._pen.line([(x, y), self._pixel(other.x, other.y)], fill=(*ERROR, 170), width=FINE)
        r, w = 8.0 * FINE, 1.0 * FINE
        corners = [(x, y - r), (x + r, y + 0.8 * r), (x - r, y + 0.8 * r)]
        self._pen.polygon(corners, fill=MARK, outline=ERROR, width=2 * FINE)
        self._pen.rectangle((x - w, y - 0.35 * r, x + w, y + 0.2 * r), fill=ERROR)
        self._pen.rectangle((x - w, y + 0.35 * r, x + w, y + 0.35 * r + 2 * w), fill=ERROR)

    def name(self, p: Pose, words: str = "", colour: Colour = TEXT) -> None:
        """The vehicle's id, or other words, above it."""
        x, y = self._pixel(p.x, p.y + p.track.width / 2 + 1.3)
        self._text(x, y, words or p.track.id, colour, 11)

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


def icon(actor: Actor, colour: Colour, size: tuple[int, int] = (18, 12)) -> Image.Image:
    """The shape of an actor for a legend, `size` pixels wide and high."""
    fine, (wide, high) = 4, size
    picture = Image.new("RGB", (wide * fine, high * fine), GROUND)
    pen = ImageDraw.Draw(picture)
    narrow = {Actor.PERSON: (0.5, 0.9), Actor.BICYCLE: (0.9, 0.6), Actor.MOTORCYCLE: (0.9, 0.6)}
    along, across = narrow.get(actor, (1.0, 0.7))
    fills: Mapping[str, Colour] = {BODY: colour, LIGHT: (255, 255, 255), DARK: HOUSING}
    for name, points in SHAPES[actor]:
        shape = np.array(points) * (along * wide, -across * high) + (0.5 * wide, 0.5 * high)
        pen.polygon([(x, y) for x, y in (fine * shape).tolist()], fill=fills[name])
    return picture.reduce(fine)


def _placed(points: Floats, x: float, y: float, heading: float) -> Floats:
    """Points [p,2] m of a body's own frame, in the world."""
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + (x, y))


def _ellipse(centre: Floats, along: float, across: float, heading: float) -> Floats:
    """[24,2] m"""
    turn = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
    ring = np.stack([along * np.cos(turn), across * np.sin(turn)], axis=1)
    return _placed(ring, float(centre[0]), float(centre[1]), heading)
