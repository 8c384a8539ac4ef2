"""What stands in the way of the ego's futures: first contacts, and the gaps around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry import Boxes, time_to_collision
from cosim.road import LanePath, RoadMap
from cosim.types import Bools, Floats, MetaAction
from policy.motion import Rollout, project_all
from policy.safety.config import SafetyConfig
from policy.safety.maneuver import Futures
from policy.scene import Scene
from policy.traffic import Traffic


def others_near(
    b: int, me: int, scene: Scene, traffic: Traffic, road: RoadMap, reach: float
) -> npt.NDArray[np.int64]:
    """Vehicles within `reach` m that this AV knows and can touch.

    Its own rows; with shared perception also those of its allies, for rows are few in a queue.
    """
    if scene.shared:
        x, y = traffic.rollout.x[:, 0], traffic.rollout.y[:, 0]
        rows = np.flatnonzero((x - x[me]) ** 2 + (y - y[me]) ** 2 < reach**2)
        rows = rows[rows != me]
    else:
        rows = scene.row[b, 1:]
        rows = rows[rows >= 0]
    rows = rows[traffic.known[rows]]
    return np.asarray(rows[road.contact.touch(int(scene.lane[me]), scene.lane[rows])])


def first_contact(
    ego: Rollout, traffic: Traffic, me: int, others: npt.NDArray[np.int64], c: SafetyConfig
) -> Floats:
    """When the ego's box first touches each other's: [A,O] s, inf for never.

    Between two frames both boxes keep their velocity, so nothing is jumped over.
    """
    touch = _sweep(ego, traffic, me, others, c.margin_length, c.margin_width, c.dt)
    close = (touch == 0.0).any(
        0
    )  # within the margin already: only the cars themselves can tell actions apart
    if close.any():
        touch[:, close] = _sweep(ego, traffic, me, others[close], 0.0, 0.0, c.dt)
    return touch


def _sweep(
    ego: Rollout,
    traffic: Traffic,
    me: int,
    others: npt.NDArray[np.int64],
    longer: float,
    wider: float,
    dt: float,
) -> Floats:
    """`first_contact` with the ego's box made `longer` and `wider` (m)."""
    r = traffic.rollout
    mine = Boxes(
        ego.x[:, None],
        ego.y[:, None],
        ego.heading[:, None],
        traffic.length[me] + longer,
        traffic.width[me] + wider,
        ego.speed[:, None],
    )
    frames = ego.x.shape[1]
    theirs = Boxes(
        r.x[None, others, :frames],
        r.y[None, others, :frames],
        r.heading[None, others, :frames],
        traffic.length[others][None, :, None],
        traffic.width[others][None, :, None],
        r.speed[None, others, :frames],
    )
    ttc = time_to_collision(mine, theirs, dt)  # [A,O,T+1], dt where nothing happens before the next frame
    hit = ttc < dt
    step = np.argmax(hit, 2)
    when = dt * step + np.take_along_axis(ttc, step[:, :, None], 2)[:, :, 0]
    return np.where(hit.any(2), when, np.inf)


class Neighbours(NamedTuple):
    """The others as they stand to one path of the ego now."""

    in_lane: Bools  # [O] in the path's lane, or moving into it
    gap: Floats  # [O] m, bumper to bumper; negative when side by side
    ahead: Bools  # [O] drives before the ego
    behind: Bools  # [O] follows the ego in this lane

    @staticmethod
    def of(
        path: LanePath,
        arc: float,
        length: float,
        others: npt.NDArray[np.int64],
        traffic: Traffic,
        now: Floats,
        c: SafetyConfig,
    ) -> Neighbours:
        """`arc`: the ego's place on the path, m; `now`: its state."""
        r = traffic.rollout
        theirs, offset = project_all(path.points, path.arc, r.x[others, 0], r.y[others, 0])
        soon = min(5, r.x.shape[1] - 1)  # 1 s ahead: who drifts in is in
        _, later = project_all(path.points, path.arc, r.x[others, soon], r.y[others, soon])
        turn = np.abs((r.heading[others, 0] - now[3] + np.pi) % (2 * np.pi) - np.pi)
        same = turn < c.same_way
        in_lane = same & (np.minimum(np.abs(offset), np.abs(later)) < c.lane_half)
        distance = theirs - arc
        gap = np.abs(distance) - 0.5 * (length + traffic.length[others])
        return Neighbours(in_lane, gap, in_lane & (distance > 0), in_lane & (distance < 0) & (gap > 0))


def gap_margin(
    action: int,
    changes: bool,
    futures: Futures,
    near: Neighbours,
    traffic: Traffic,
    others: npt.NDArray[np.int64],
    intended: Bools,
    c: SafetyConfig,
) -> tuple[float, int]:
    """The score (s) that the gaps around the ego leave, and which of the others limits it.

    Leader: if it brakes with `leader_brake` from now on, and the ego as hard as it can from its next decision
    on, they must not touch; one that shares its intentions brakes no earlier than they say. A lane change
    further needs the place beside the ego, and a new follower that need not brake harder than
    `follower_brake`. At the limit the score is safe_th, below it falls with the gap. Decelerating never makes
    a gap smaller.
    """
    ego, r = futures.under, traffic.rollout
    speed = r.speed[others, 0]
    ratio = np.full(len(others), np.inf)  # of the gap there is to the gap needed
    if action != MetaAction.DECELERATE:
        soon = r.speed[others, min(round(c.reaction / c.dt), r.speed.shape[1] - 1)]
        braking = np.where(intended[others], soon, speed)  # m/s when it begins to brake hard
        theirs = braking**2 / (2 * c.leader_brake)
        theirs = theirs + np.where(intended[others], 0.5 * (speed + soon) * c.reaction, 0.0)
        need = np.maximum(futures.stopping[action] - theirs, 0.0) + c.standstill_gap
        ratio = np.where(near.ahead, near.gap / need, ratio)
    if changes:
        closing = np.maximum(speed - ego.speed[action, 0], 0.0)
        need = c.follower_gap + speed * c.follower_reaction + closing**2 / (2 * c.follower_brake)
        ratio = np.where(near.behind, near.gap / need, ratio)
        ratio = np.where(near.in_lane & (near.gap < c.standstill_gap), 0.0, ratio)
    who = int(np.argmin(ratio))
    if ratio[who] >= 1.0:
        return np.inf, who
    return 0.999 * c.safe_th * max(float(ratio[who]), 0.0), who
