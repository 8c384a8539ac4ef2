"""Recordings for learners: tracks of all vehicles, and the rebuilt histories of each AV."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cosim.observation.observer import Observer
from cosim.recording.file import Recording
from cosim.road import RoadMap
from cosim.types import Bools, Floats, History, Ints, Kind, ObservationConfig


class Tracks(NamedTuple):
    """Every vehicle over a whole episode; nan (or -1) while it is off the road."""

    state: Floats  # [V,T,4] x m, y m, speed m/s, heading rad (unwrapped)
    lane: Ints  # [V,T]
    lane_position: Floats  # [V,T] m, front bumper
    length: Floats  # [V] m
    is_av: Bools  # [V]


def tracks(recording: Recording) -> Tracks:
    """The recording as dense arrays over vehicles and frames."""
    t, shape = recording.table, (len(recording.ids), len(recording.times))
    at = (t["vehicle"], t["frame"])
    state = np.full((*shape, 4), np.nan)
    for f, name in enumerate(("x", "y", "speed", "heading")):
        state[(*at, f)] = t[name]
    turn = np.diff(state[:, :, 3], axis=1)
    state[:, 1:, 3] -= 2 * np.pi * np.cumsum(np.nan_to_num(np.round(turn / (2 * np.pi))), 1)
    lane = np.full(shape, -1, np.int64)
    lane[at] = t["lane"]
    position = np.full(shape, np.nan)
    position[at] = t["lane_position"]
    length = np.zeros(shape[0])
    length[t["vehicle"]] = t["length"]
    is_av = np.zeros(shape[0], np.bool_)
    is_av[t["vehicle"]] = t["kind"] == int(Kind.AV)
    return Tracks(state, lane, position, length, is_av)


def histories(
    recording: Recording, road: RoadMap, config: ObservationConfig
) -> Iterator[tuple[int, dict[str, History]]]:
    """(frame, AV -> History) at every decision, as observed by the policy; maps are drawn on demand.

    Views inside a History stay valid for N further frames; copy them to keep them longer.
    """
    observer, known = Observer(road, config), recording.known()
    for frame, snapshot in enumerate(recording.snapshots()):
        observer.add(snapshot)
        here = known.get(frame)
        if here is None:
            continue
        yield (
            frame,
            observer.histories(
                lambda name, here=here: here[name].route,  # type: ignore[misc]
                lambda name, here=here: here[name][1:],  # type: ignore[misc]
            ),
        )


class Windows(NamedTuple):
    """S moments of single vehicles: the known past of each, and its future."""

    past: Floats  # [S,N,4] x m, y m, speed m/s, heading rad (unwrapped); nan while absent
    future: Floats  # [S,M,4] as `past`, with continuous headings; nan after the vehicle left
    lane: Ints  # [S] at the moment
    lane_position: Floats  # [S] m, front bumper
    length: Floats  # [S] m
    is_av: Bools  # [S]
    frame: Ints  # [S]


def windows(
    recording: Recording, *, every: int, frames: int = 10, horizon: int = 20, perceived: float | None = 125.0
) -> Windows:
    """Every vehicle perceived by an AV (within `perceived` m; None: all), at every `every`th frame of the
    counted time except the last."""
    t = tracks(recording)
    lead = np.full((len(t.state), frames, 4), np.nan)
    tail = np.full((len(t.state), horizon, 4), np.nan)
    padded = np.concatenate([lead, t.state, tail], 1)
    parts = []
    for k in range(recording.first, len(recording.times) - 1, every):
        here = t.state[:, k]  # [V,4]
        chosen = np.flatnonzero(np.isfinite(here[:, 0]))
        if perceived is not None:
            avs = here[chosen[t.is_av[chosen]]]
            gap2 = ((here[chosen, None, :2] - avs[None, :, :2]) ** 2).sum(2)
            chosen = chosen[(gap2 <= perceived**2).any(1)]
        at = k + frames  # of frame k in `padded`
        parts.append(
            Windows(
                padded[chosen, at - frames + 1 : at + 1],
                padded[chosen, at + 1 : at + 1 + horizon],
                t.lane[chosen, k],
                t.lane_position[chosen, k],
                t.length[chosen],
                t.is_av[chosen],
                np.full(len(chosen), k),
            )
        )
    return Windows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
