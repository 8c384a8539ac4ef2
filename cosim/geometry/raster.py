"""Draws VelocityMaps: rotated vehicle boxes and the road surface, in any ego frame (numba kernels).

Rows run across the road (row 0 furthest to the left), columns along it (column 0 furthest behind);
the ego's centre lies in the middle, looking towards rising columns. Pixels are stored as uint8 (255 = 1).
Version 2 of the road channel also draws the law: stop lines by what they ask for now, and crossings.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled, compiled_fast
from cosim.road import Lane, RoadMap, Rule
from cosim.road.rules import RED, STOP_SIGNS, STOP_STATES, YELLOW, YIELD_STATES
from cosim.types import (
    HEADING,
    IS_AV,
    IS_MISSION,
    LENGTH,
    SPEED,
    WIDTH,
    Bools,
    Bytes,
    Floats,
    Ints,
    Kind,
    ObservationConfig,
    Snapshot,
    X,
    Y,
)

CHANNELS = ("av", "hv", "road", "mission", "ego")
# A vehicle's pixel, of 1: LOWEST + SPAN clip((dv + SPEED) / (2 SPEED), 0, 1), dv in m/s relative to the ego.
PIXEL_LOWEST, PIXEL_SPAN, PIXEL_SPEED = 0.1, 0.9, 30.0
ROAD_SURFACE = 128  # a lane's surface
ROAD_LINE = 255  # within LINE_WIDTH of a lane's edge, so that neighbouring lanes can be distinguished
LINE_WIDTH = 0.5  # m
# Version 2 only, upon the surface: pedestrian crossings, and the last STOP_BAR m before a stop line.
CROSSING, GIVE_WAY, STOP_SIGN, YELLOW_LINE, RED_LINE = 160, 176, 192, 208, 224
STOP_BAR = 2.5  # m, so that a row of pixels of 2 m always meets it
RASTER_CELL = 0.5  # m, the finest cell of the world raster (paper size has 0.5 m pixels)
RASTER_CELLS = 64_000_000  # bytes at most; larger nets get coarser cells


@dataclass(frozen=True)
class RoadRaster:
    """The whole net's surface, drawn once, sampled for every map; in version 2 `show` draws the signals."""

    cells: Bytes  # [rows, cols] 0, ROAD_SURFACE or ROAD_LINE, in version 2 also the law's; row = y, col = x
    x: float  # m, left edge
    y: float  # m, lower edge
    cell: float  # m
    bars: tuple["_Bar", ...] = ()  # stop lines with signals (version 2)
    _shown: list[Bytes] = field(default_factory=list, repr=False)  # the states that are drawn now

    def show(self, signals: Bytes) -> None:
        """Draw the stop lines by the states of all signals [s] (`Snapshot.signals`); in version 1 nothing."""
        if not self.bars:
            return
        flat, states = self.cells.reshape(-1), signals.tobytes().decode("latin-1")
        bars: Iterable[_Bar] = self.bars
        if self._shown and len(self._shown[0]) == len(signals):
            changed = np.flatnonzero(self._shown[0] != signals).tolist()
            bars = (bar for signal in changed for bar in self._bars_of.get(signal, ()))
        for bar in bars:
            flat[bar.cells] = np.maximum(bar.below, bar.value(states))
        self._shown[:] = [signals]

    @cached_property
    def _bars_of(self) -> dict[int, list["_Bar"]]:
        """Signal -> the stop lines that it governs."""
        found: dict[int, list[_Bar]] = {}
        for bar in self.bars:
            for signal in {signal for signal, _ in bar.ways}:
                found.setdefault(signal, []).append(bar)
        return found


def rasterize_road(road: RoadMap, version: int = 1) -> RoadRaster:
    """Draw every lane of the net into one raster (a second or less for a city of 1,000 lanes).

    `version`: `ObservationConfig.road_version`; 2 draws crossings and stop lines too.
    """
    if not road.lanes:
        return RoadRaster(np.zeros((1, 1), np.uint8), 0.0, 0.0, 1.0)
    points = np.concatenate([lane.shape for lane in road.lanes])
    low, high = points.min(0) - 10.0, points.max(0) + 10.0
    cell = max(RASTER_CELL, float(np.sqrt(np.prod(high - low) / RASTER_CELLS)))
    cells = np.zeros(tuple(np.ceil((high - low)[::-1] / cell).astype(int)), np.uint8)
    for value, inset in ((ROAD_LINE, 0.0), (ROAD_SURFACE, LINE_WIDTH)):
        for lane in road.lanes:
            _draw_lane(cells, lane.shape - low, lane.width / 2 - inset, cell, value)
    bars = _draw_law(cells, road, low, cell) if version > 1 else ()
    raster = RoadRaster(cells, float(low[0]), float(low[1]), cell, bars)
    raster.show(np.zeros(0, np.uint8))
    return raster


@dataclass(frozen=True)
class _Bar:
    """One lane's stop line with a signal: its cells, and what the ways that begin there ask for."""

    cells: Ints  # [k] indices into the raster's cells, flat
    below: Bytes  # [k] what is there without it
    ways: tuple[tuple[int, int], ...]  # (index of the signal or -1, pixel value without one)

    def value(self, states: str) -> int:
        """The pixel value of what every way asks for; 0 for nothing."""
        return min(_pixel(states[signal : signal + 1], rule) for signal, rule in self.ways)


def _pixel(state: str, rule: int) -> int:
    """The pixel of a stop line in this state ("" without a signal: by its rule); 0 where one may drive on."""
    if not state:
        return rule
    letters = ((RED, RED_LINE), (YELLOW, YELLOW_LINE), (STOP_STATES, STOP_SIGN), (YIELD_STATES, GIVE_WAY))
    return next((value for those, value in letters if state in those), 0)


def _draw_law(cells: Bytes, road: RoadMap, low: Floats, cell: float) -> tuple[_Bar, ...]:
    """Draw crossings and the stop lines without signals; the stop lines with one."""
    flat = cells.reshape(-1)
    for crossing in road.crossings:
        first = np.floor((crossing.shape.min(0) - crossing.width - low) / cell).astype(int).clip(0)
        last = np.ceil((crossing.shape.max(0) + crossing.width - low) / cell).astype(int)
        window = cells[first[1] : last[1], first[0] : last[0]]
        mask = np.zeros_like(window)
        _draw_lane(mask, crossing.shape - low - first * cell, crossing.width / 2, cell, 1)
        window[(mask > 0) & (window > 0)] = CROSSING
    ways: dict[int, list[tuple[int, int]]] = {}
    for link in road.links:
        rule = 0 if link.rule == Rule.PRIORITY else STOP_SIGN if link.rule in STOP_SIGNS else GIVE_WAY
        ways.setdefault(link.origin, []).append((link.signal, rule))
    bars = []
    for origin, here in ways.items():
        place = _stop_line(road.lanes[origin], low, cell, cells.shape)
        bar = _Bar(place, flat[place].copy(), tuple(here))
        if any(signal >= 0 for signal, _ in here):
            bars.append(bar)
        else:
            flat[place] = np.maximum(bar.below, bar.value(""))
    return tuple(bars)


def _stop_line(lane: Lane, low: Floats, cell: float, shape: tuple[int, ...]) -> Ints:
    """Flat indices of the cells of a lane's last STOP_BAR m, between its edges."""
    end, ahead = lane.shape[-1] - low, lane.shape[-1] - lane.shape[-2]
    ux, uy = ahead / max(float(np.hypot(*ahead)), 1e-9)
    half = max(lane.width / 2 - LINE_WIDTH, cell / 2)
    reach = STOP_BAR + half
    columns, rows = (
        np.arange(max(int((e - reach) / cell), 0), min(int((e + reach) / cell) + 1, most))
        for e, most in zip(end, shape[::-1], strict=True)
    )
    dx, dy = (columns + 0.5) * cell - end[0], ((rows + 0.5) * cell - end[1])[:, None]
    along, across = dx * ux + dy * uy, dy * ux - dx * uy
    row, column = np.nonzero((along > -max(STOP_BAR, cell)) & (along <= 0.0) & (abs(across) <= half))
    return np.asarray(rows[row] * shape[1] + columns[column], np.int64)


@lru_cache
def channel_indices(config: ObservationConfig) -> npt.NDArray[np.int64]:
    """[5] index of each of CHANNELS in the config's channels, -1 where it has none.

    Without an "ego" channel the ego is drawn into "mission" (observation.md: ego + mission vehicle).
    """
    found = [config.channels.index(c) if c in config.channels else -1 for c in CHANNELS]
    if found[4] < 0:
        found[4] = found[3]
    return np.array(found, np.int64)


def draw_snapshot(
    out: Bytes,
    slots: npt.NDArray[np.int64],
    snapshot: Snapshot,
    ego: npt.NDArray[np.int64],
    seen: Bools,
    raster: RoadRaster,
    config: ObservationConfig,
) -> None:
    """Draw the frame of every ego, centred on it and looking along its heading.

    Args:
        out: [S,C,H,W] uint8, overwritten at `slots`.
        slots: [B] where in `out` each ego's frame goes.
        snapshot: the n vehicles.
        ego: [B] the egos' rows in the snapshot.
        seen: [B,n] which vehicles each ego perceives; the ego itself is always drawn.
        raster: the road's surface (`rasterize_road`); in version 2 with the snapshot's signals after this.
        config: size, scale and channels of a frame.
    """
    s = snapshot
    raster.show(s.signals)
    vehicles = s.x, s.y, s.heading, s.speed, s.length, s.width, s.kind == int(Kind.AV), s.mission
    draw_scene(out, slots, ego, *vehicles, seen, *_view(raster, config))


def draw_kinematics(
    out: Bytes, rows: Floats, valid: Bools, pose: Floats, raster: RoadRaster, config: ObservationConfig
) -> None:
    """Draw one frame per batch entry from kinematic rows, seen from row 0.

    Args:
        out: [B,C,H,W] uint8, overwritten.
        rows: [B,R,8] KINEMATIC_FEATURES (m, rad, m/s) in any one frame of reference per entry; row 0 the ego.
        valid: [B,R] which rows hold a vehicle.
        pose: [B,3] that frame of reference in the world: x m, y m, heading rad (for the road).
        raster: the road's surface (`rasterize_road`).
        config: size, scale and channels of a frame.
    """
    draw_rows(out, rows, valid, pose, *_view(raster, config))


def _view(r: RoadRaster, c: ObservationConfig) -> tuple[Any, ...]:
    """The last arguments of both kernels: the picture's channels and scale, and the road's raster."""
    return channel_indices(c), c.metres_across, c.metres_along, r.cells, r.x, r.y, r.cell


@compiled_fast
def draw_scene(
    out: Bytes,  # [S,C,H,W]; the slots named are overwritten
    slots: npt.NDArray[np.int64],  # [B] where in `out` each ego's frame goes
    ego: npt.NDArray[np.int64],  # [B] row of each ego among the vehicles
    x: Floats,  # [n] m, world
    y: Floats,  # [n] m
    heading: Floats,  # [n] rad
    speed: Floats,  # [n] m/s
    length: Floats,  # [n] m
    width: Floats,  # [n] m
    is_av: Bools,  # [n]
    mission: Bools,  # [n]
    seen: Bools,  # [B,n] who is perceived by whom
    channels: npt.NDArray[np.int64],  # [5] from `channel_indices`
    across: float,  # m per pixel
    along: float,  # m per pixel
    cells: Bytes,
    cells_x: float,
    cells_y: float,
    cell: float,
) -> None:
    """One frame of every ego, all looking at the same vehicles (the ego itself is always drawn)."""
    for b in range(ego.shape[0]):
        e = ego[b]
        frame = out[slots[b]]
        frame[:] = 0
        if channels[2] >= 0:
            _sample_road(
                frame[channels[2]], x[e], y[e], heading[e], across, along, cells, cells_x, cells_y, cell
            )
        c, s = np.cos(heading[e]), np.sin(heading[e])
        for j in range(x.shape[0]):
            if not seen[b, j] and j != e:
                continue
            dx, dy = x[j] - x[e], y[j] - y[e]
            _draw_vehicle(
                frame,
                c * dx + s * dy,
                c * dy - s * dx,
                heading[j] - heading[e],
                speed[j] - speed[e],
                length[j],
                width[j],
                is_av[j],
                mission[j],
                j == e,
                channels,
                across,
                along,
            )


@compiled_fast
def draw_rows(
    out: Bytes,  # [B,C,H,W] overwritten
    rows: Floats,  # [B,R,8] KINEMATIC_FEATURES in any one frame per b (m, m/s, rad); row 0 the ego
    valid: Bools,  # [B,R]
    pose: Floats,  # [B,3] that frame's x m, y m, heading rad in the world (for the road)
    channels: npt.NDArray[np.int64],  # [5]
    across: float,
    along: float,
    cells: Bytes,
    cells_x: float,
    cells_y: float,
    cell: float,
) -> None:
    """One frame per batch entry from kinematic rows, seen from row 0: predicted kinematics as a map."""
    for b in range(out.shape[0]):
        out[b] = 0
        ex, ey, eh = rows[b, 0, X], rows[b, 0, Y], rows[b, 0, HEADING]
        if channels[2] >= 0:
            pc, ps = np.cos(pose[b, 2]), np.sin(pose[b, 2])
            _sample_road(
                out[b, channels[2]],
                pose[b, 0] + pc * ex - ps * ey,
                pose[b, 1] + ps * ex + pc * ey,
                pose[b, 2] + eh,
                across,
                along,
                cells,
                cells_x,
                cells_y,
                cell,
            )
        c, s = np.cos(eh), np.sin(eh)
        for j in range(rows.shape[1]):
            if not valid[b, j]:
                continue
            dx, dy = rows[b, j, X] - ex, rows[b, j, Y] - ey
            _draw_vehicle(
                out[b],
                c * dx + s * dy,
                c * dy - s * dx,
                rows[b, j, HEADING] - eh,
                rows[b, j, SPEED] - rows[b, 0, SPEED],
                rows[b, j, LENGTH],
                rows[b, j, WIDTH],
                rows[b, j, IS_AV] > 0.5,
                rows[b, j, IS_MISSION] > 0.5,
                j == 0,
                channels,
                across,
                along,
            )


@compiled_fast
def _draw_vehicle(
    out: Bytes,  # [C,H,W]
    ahead: float,  # m, centre in the ego frame
    left: float,  # m
    turn: float,  # rad, heading relative to the ego
    dv: float,  # m/s
    length: float,
    width: float,
    is_av: bool,
    mission: bool,
    is_ego: bool,
    channels: npt.NDArray[np.int64],
    across: float,
    along: float,
) -> None:
    height, columns = out.shape[1], out.shape[2]
    c, s = np.cos(turn), np.sin(turn)
    half_l, half_w = 0.5 * length, 0.5 * width
    reach_x = abs(c) * half_l + abs(s) * half_w
    reach_y = abs(s) * half_l + abs(c) * half_w
    # nan and far away fail these comparisons and draw nothing
    if not (abs(ahead) - reach_x < 0.5 * columns * along and abs(left) - reach_y < 0.5 * height * across):
        return
    level = min(max((dv + PIXEL_SPEED) / (2.0 * PIXEL_SPEED), 0.0), 1.0)
    value = np.uint8(255.0 * (PIXEL_LOWEST + PIXEL_SPAN * level) + 0.5)
    first = channels[4] if is_ego else (channels[0] if is_av else channels[1])
    second = channels[3] if mission and not is_ego else -1
    u0 = max(int(np.floor((ahead - reach_x) / along + 0.5 * columns)), 0)
    u1 = min(int(np.floor((ahead + reach_x) / along + 0.5 * columns)), columns - 1)
    v0 = max(int(np.floor(0.5 * height - (left + reach_y) / across)), 0)
    v1 = min(int(np.floor(0.5 * height - (left - reach_y) / across)), height - 1)
    drawn = False
    for v in range(v0, v1 + 1):
        dy = (0.5 * height - v - 0.5) * across - left
        for u in range(u0, u1 + 1):
            dx = (u + 0.5 - 0.5 * columns) * along - ahead
            if abs(c * dx + s * dy) <= half_l and abs(c * dy - s * dx) <= half_w:
                drawn = True
                if first >= 0:
                    out[first, v, u] = value
                if second >= 0:
                    out[second, v, u] = value
    if not drawn:  # smaller than a pixel: never let a vehicle vanish
        u = int(np.floor(ahead / along + 0.5 * columns))
        v = int(np.floor(0.5 * height - left / across))
        if 0 <= u < columns and 0 <= v < height:
            if first >= 0:
                out[first, v, u] = value
            if second >= 0:
                out[second, v, u] = value


@compiled_fast
def _sample_road(
    out: Bytes,  # [H,W]
    x: float,
    y: float,
    heading: float,
    across: float,
    along: float,
    cells: Bytes,
    cells_x: float,
    cells_y: float,
    cell: float,
) -> None:
    height, width = out.shape
    rows, columns = cells.shape
    flat = cells.ravel()
    c, s = np.cos(heading), np.sin(heading)
    # fixed point, 16 bits after the point: the inner loop is additions and one look-up
    step_x, step_y = int(65536 * c * along / cell), int(65536 * s * along / cell)
    back = (0.5 - 0.5 * width) * along
    for v in range(height):
        left = (0.5 * height - v - 0.5) * across
        px = int(np.floor(65536 * (x + c * back - s * left - cells_x) / cell))
        py = int(np.floor(65536 * (y + s * back + c * left - cells_y) / cell))
        end_x, end_y = (px + step_x * (width - 1)) >> 16, (py + step_y * (width - 1)) >> 16
        inside = px >= 0 and py >= 0 and (px >> 16) < columns and (py >> 16) < rows
        if inside and 0 <= end_x < columns and 0 <= end_y < rows:
            for u in range(width):
                out[v, u] = flat[np.uintp((py >> 16) * columns + (px >> 16))]
                px += step_x
                py += step_y
        else:
            for u in range(width):
                fx, fy = px >> 16, py >> 16
                if 0 <= fx < columns and 0 <= fy < rows:
                    out[v, u] = flat[np.uintp(fy * columns + fx)]
                else:
                    out[v, u] = 0
                px += step_x
                py += step_y


@compiled
def _draw_lane(cells: Bytes, shape: Floats, half: float, cell: float, value: int) -> None:
    """Fill everything within `half` m of the centre line [p,2] (round joints close the outer bends)."""
    rows, columns = cells.shape
    for i in range(shape.shape[0] - 1):
        ax, ay = shape[i, 0], shape[i, 1]
        dx, dy = shape[i + 1, 0] - ax, shape[i + 1, 1] - ay
        span2 = dx * dx + dy * dy
        if span2 < 1e-12:
            continue
        x0 = max(int((min(ax, ax + dx) - half) / cell), 0)
        x1 = min(int((max(ax, ax + dx) + half) / cell), columns - 1)
        y0 = max(int((min(ay, ay + dy) - half) / cell), 0)
        y1 = min(int((max(ay, ay + dy) + half) / cell), rows - 1)
        for r in range(y0, y1 + 1):
            py = (r + 0.5) * cell - ay
            for k in range(x0, x1 + 1):
                px = (k + 0.5) * cell - ax
                t = min(max((px * dx + py * dy) / span2, 0.0), 1.0)
                ex, ey = px - t * dx, py - t * dy
                if ex * ex + ey * ey <= half * half:
                    cells[r, k] = value
