"""What stands in the way of the ego's futures: first contacts, and the gaps around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.compiled import compiled
from cosim.geometry import Boxes, first_contacts
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
    close = (touch == 0.0).any(0)  # within the margin already: only the cars themselves tell actions apart
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
    length, width = float(traffic.length[me]) + longer, float(traffic.width[me]) + wider
    mine = Boxes(ego.x, ego.y, ego.heading, length, width, ego.speed)
    x, y, heading, speed = (array[others, : ego.x.shape[1]] for array in (r.x, r.y, r.heading, r.speed))
    theirs = Boxes(x, y, heading, traffic.length[others], traffic.width[others], speed)
    return first_contacts(mine, theirs, dt)


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
    r = traffic.rollout
    soon = r.speed[others, min(round(c.reaction / c.dt), r.speed.shape[1] - 1)]
    ratio, who = _tightest(
        action != MetaAction.DECELERATE,
        changes,
        float(futures.stopping[action]),
        float(futures.under.speed[action, 0]),
        *near,
        r.speed[others, 0],
        soon,
        intended[others],
        c.leader_brake,
        c.reaction,
        c.standstill_gap,
        c.follower_gap,
        c.follower_reaction,
        c.follower_brake,
    )
    if ratio >= 1.0:
        return np.inf, who
    return 0.999 * c.safe_th * max(ratio, 0.0), who


@compiled
def _tightest(
    faces: bool,  # a leader counts
    changes: bool,
    stopping: float,
    own_speed: float,
    in_lane: Bools,
    gap: Floats,
    ahead: Bools,
    behind: Bools,
    speed: Floats,
    soon: Floats,
    intended: Bools,
    leader_brake: float,
    reaction: float,
    standstill_gap: float,
    follower_gap: float,
    follower_reaction: float,
    follower_brake: float,
) -> tuple[float, int]:
    """Smallest ratio of the gap there is to the gap needed, and whose; see `gap_margin`."""
    best, who = np.inf, 0
    for k in range(len(gap)):
        ratio = np.inf
        if faces and ahead[k]:
            braking = soon[k] if intended[k] else speed[k]  # m/s when it begins to brake hard
            theirs = braking * braking / (2 * leader_brake)
            if intended[k]:
                theirs += 0.5 * (speed[k] + soon[k]) * reaction
            ratio = gap[k] / (max(stopping - theirs, 0.0) + standstill_gap)
        if changes:
            if behind[k]:
                closing = max(speed[k] - own_speed, 0.0)
                needed = (
                    follower_gap + speed[k] * follower_reaction + closing * closing / (2 * follower_brake)
                )
                ratio = gap[k] / needed
            if in_lane[k] and gap[k] < standstill_gap:
                ratio = 0.0
        if ratio < best:
            best, who = ratio, k
    return best, who
