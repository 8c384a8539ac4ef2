"""The joined scene of all AVs: every vehicle once, in world coordinates, with the rows that refer to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.types import (
    HEADING,
    KINEMATIC_FEATURES,
    LENGTH,
    SPEED,
    WIDTH,
    Bools,
    Floats,
    Floats32,
    History,
    Ints,
    X,
    Y,
)


class Scene(NamedTuple):
    """B deciding AVs and the V vehicles known to any of them."""

    agents: tuple[str, ...]  # [B] sorted by id
    histories: tuple[History, ...]  # [B]
    vehicles: tuple[str, ...]  # [V] names
    state: Floats  # [V,N,8] KINEMATIC_FEATURES in the world: m, m/s, rad (heading unwrapped)
    valid: Bools  # [V,N]
    lane: npt.NDArray[np.int32]  # [V] newest frame, -1 unknown
    lane_position: Floats  # [V] m, front bumper
    row: Ints  # [B,R] vehicle of each kinematic row, -1 for an empty one; row 0 the ego
    pose: Floats  # [B,3] each AV's x m, y m, heading rad
    shared: bool  # V2V: every AV knows all of these vehicles

    @property
    def ego(self) -> Ints:
        """[B] index of each AV among the vehicles."""
        return np.asarray(self.row[:, 0])

    def without_history(self) -> Scene:
        """The scene with the newest frame only (P, figure 6: without history)."""
        valid = self.valid.copy()
        valid[:, :-1] = False
        return self._replace(valid=valid)


def join(histories: Mapping[str, History], share: bool = True) -> Scene:
    """Join the histories of AVs that decide together.

    Args:
        histories: AV -> its observations.
        share: V2V, the AVs' knowledge of a vehicle is pooled; otherwise each AV keeps its own copy.
    """
    agents = tuple(sorted(histories))
    each = tuple(histories[a] for a in agents)
    kinematics = np.stack([h.kinematics for h in each])  # [B,N,R,8]
    valid = np.stack([h.valid for h in each])  # [B,N,R]
    pose = np.stack([h.pose for h in each])
    rows = np.full((len(each), kinematics.shape[2]), -1, np.int64)
    found: dict[tuple[str, str], int] = {}
    source: list[tuple[int, int]] = []
    for b, history in enumerate(each):
        for r, name in ((r, name) for r, name in enumerate(history.ids) if name):
            k = rows[b, r] = found.setdefault((name, "" if share else agents[b]), len(found))
            if k == len(source):
                source.append((b, r))
    of, row = np.array(source, np.int64).T  # [V] the perceiving AV and its row for each vehicle
    return Scene(
        agents,
        each,
        tuple(name for name, _ in found),
        to_world(kinematics, pose)[of, :, row],  # [V,N,8]
        valid[of, :, row],
        np.stack([h.lane for h in each])[of, row],
        np.stack([h.lane_position for h in each])[of, row],
        rows,
        pose,
        share,
    )


def to_world(kinematics: Floats32 | Floats, pose: Floats) -> Floats:
    """[B,N,R,8] in each ego's frame, pose [B,3] -> [B,N,R,8] in the world (m, m/s, rad)."""
    world = kinematics.astype(np.float64)
    c, s = np.cos(pose[:, 2])[:, None, None], np.sin(pose[:, 2])[:, None, None]
    x, y = world[..., X].copy(), world[..., Y].copy()
    world[..., X] = pose[:, 0, None, None] + c * x - s * y
    world[..., Y] = pose[:, 1, None, None] + s * x + c * y
    world[..., HEADING] += pose[:, 2, None, None]
    return world


def rows_ahead(scene: Scene, x: Floats, y: Floats, speed: Floats, heading: Floats) -> tuple[Floats, Bools]:
    """Predicted vehicles as kinematic rows. x, y, speed, heading [V,M] in the world.

    Returns rows [B,M,R,8] in each ego's frame at the newest frame (m, m/s, rad) and their validity [B,R].
    """
    known = (scene.row >= 0) & scene.valid[np.maximum(scene.row, 0), -1]  # [B,R]
    index = np.maximum(scene.row, 0)
    # headings continue the vehicle's history row: the same multiple of 2 pi
    base = (
        np.stack([h.kinematics[-1, :, HEADING] for h in scene.histories]) - scene.state[index, -1, HEADING]
    )  # [B,R]
    return _rows(scene, index, known, base, (x, y, speed, heading)), known


def pictured(
    scene: Scene, x: Floats, y: Floats, speed: Floats, heading: Floats, reach: float = np.inf
) -> tuple[Floats, Bools, Ints]:
    """Rows of the vehicles known to an AV, row 0 the ego, for drawing its predicted maps.

    Vehicles further than `reach` m (plus their length) from the ego in every frame are left out.

    Returns rows [B,M,k,8], their validity [B,k] and the index of each vehicle in the scene [B,k].
    """
    owned = np.ones((1, 1), np.bool_)
    if not scene.shared:
        owned = np.zeros((len(scene.agents), len(scene.vehicles)), np.bool_)
        for mine, row in zip(owned, scene.row, strict=True):
            mine[row[row >= 0]] = True
    size = scene.state[:, -1, LENGTH] + scene.state[:, -1, WIDTH]
    index, known = _near(scene.ego, scene.valid[:, -1], owned, x, y, size, reach)
    base = np.repeat(-scene.pose[:, 2:3], index.shape[1], 1)
    return _rows(scene, index, known, base, (x, y, speed, heading)), known, index


@compiled
def _near(
    ego: Ints,  # [B]
    valid: Bools,  # [V]
    owned: Bools,  # [B,V] vehicles known to each ego; [1,1]: all
    x: Floats,  # [V,M] m
    y: Floats,  # [V,M] m
    size: Floats,  # [V] m
    reach: float,  # m
) -> tuple[Ints, Bools]:
    """Vehicles drawn for each ego [B,k], the ego first, padded with 0, and their validity [B,k]."""
    count, vehicles, frames = ego.shape[0], x.shape[0], x.shape[1]
    index, known = np.zeros((count, vehicles), np.int64), np.zeros((count, vehicles), np.bool_)
    most = 1
    for b in range(count):
        e, n = ego[b], 1
        index[b, 0], known[b, 0] = e, valid[e]
        for j in range(1, vehicles):
            v = 0 if j == e else j  # the ego and the first vehicle swap places
            if not valid[v] or (owned.shape[1] > 1 and not owned[b, v]):
                continue
            limit = (reach + size[v]) ** 2
            for k in range(frames):
                if not (x[v, k] - x[e, k]) ** 2 + (y[v, k] - y[e, k]) ** 2 > limit:  # true for nan too
                    index[b, n], known[b, n] = v, True
                    n += 1
                    break
        most = max(most, n)
    return index[:, :most].copy(), known[:, :most].copy()


def _rows(
    scene: Scene, index: Ints, known: Bools, base: Floats, states: tuple[Floats, Floats, Floats, Floats]
) -> Floats:
    """[B,M,k,8] of the vehicles `index` [B,k]; `base` [B,k] rad is added to their headings."""
    x, y, speed, heading = states
    rows = np.zeros((len(index), x.shape[1], index.shape[1], len(KINEMATIC_FEATURES)))
    dx = x[index] - scene.pose[:, 0, None, None]  # [B,k,M]
    dy = y[index] - scene.pose[:, 1, None, None]
    c, s = np.cos(scene.pose[:, 2])[:, None, None], np.sin(scene.pose[:, 2])[:, None, None]
    rows[..., X] = (c * dx + s * dy).transpose(0, 2, 1)
    rows[..., Y] = (c * dy - s * dx).transpose(0, 2, 1)
    rows[..., SPEED] = speed[index].transpose(0, 2, 1)
    rows[..., HEADING] = (heading[index] + base[..., None]).transpose(0, 2, 1)
    rows[..., 4:] = scene.state[index, -1, 4:][:, None]
    rows *= known[:, None, :, None]
    return rows
