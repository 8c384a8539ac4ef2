"""First contacts of the ego's futures with other vehicles, and the gaps around it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry import Boxes, first_contacts
from cosim.geometry.compiled import compiled
from cosim.road import RoadMap
from cosim.types import HEADING, Bools, Floats, Ints, MetaAction
from policy.inputs.scene import Scene
from policy.prediction.motion import Rollout, project_each
from policy.prediction.traffic import Traffic
from policy.safety.config import SafetyConfig
from policy.safety.maneuver import ActionPaths


class Others(NamedTuple):
    """The O vehicles known to an AV and within its reach."""

    rows: Ints  # [O] indices into the scene
    boxes: Boxes  # [O,T+1] frame 0 is now
    intended: Bools  # [O] motion is a shared intention, not a prediction


def others_near(
    b: int,
    me: int,
    scene: Scene,
    traffic: Traffic,
    road: RoadMap,
    c: SafetyConfig,
    intended: Bools,
    way: tuple[int, ...] = (),
) -> Others:
    """The vehicles within an AV's reach: its own rows; with shared perception also the other AVs' rows.

    Args:
        b: index of the AV in `scene.agents`.
        me: its index in `scene.vehicles`.
        scene, traffic, road: as in `policy.safety.prioritize`.
        c: limits.
        intended: [V] the rollout is a shared intention.
        way: the lanes ahead on the AV's paths.
    """
    r = traffic.rollout
    if scene.shared:
        number = road.contact.numbers(scene.lane)
        rows = _within(me, r.x[:, 0], r.y[:, 0], traffic.known, c.reach, number, road.contact.table)
    else:
        rows = scene.row[b, 1:]
        rows = rows[rows >= 0]
        rows = rows[traffic.known[rows]]
        rows = rows[road.contact.touch(int(scene.lane[me]), scene.lane[rows])]
    if c.assisted:
        rows = _along(rows, me, scene.state[:, -1, HEADING], scene.lane, np.array(way, np.int64), c.same_way)
    boxes = Boxes(r.x, r.y, r.heading, traffic.length, traffic.width, r.speed)
    return Others(rows, _only(boxes, rows), intended[rows])


@compiled
def _within(me: int, x: Floats, y: Floats, known: Bools, reach: float, number: Ints, touch: Bools) -> Ints:
    """Known vehicles of x, y [V] less than `reach` m from `me` on roads connected to its own."""
    out = np.empty(len(x), np.int64)
    count = 0
    for v in range(len(x)):
        if v == me or not known[v] or not touch[number[me], number[v]]:
            continue
        if (x[v] - x[me]) ** 2 + (y[v] - y[me]) ** 2 < reach**2:
            out[count] = v
            count += 1
    return out[:count]


@compiled
def _along(
    rows: Ints, me: int, heading: Floats, lane: npt.NDArray[np.int32], way: Ints, same_way: float
) -> Ints:
    """Rows [O] in the direction of `me` or on a lane of its path; heading [V] rad, lane [V]."""
    chosen = np.zeros(len(rows), np.bool_)
    for k, v in enumerate(rows):
        turn = heading[v] - heading[me]
        chosen[k] = abs((turn + np.pi) % (2 * np.pi) - np.pi) < same_way
        for one in way:
            chosen[k] |= lane[v] == one
    return rows[chosen]


def first_contact(ego: Rollout, length: float, width: float, others: Others, c: SafetyConfig) -> Floats:
    """Time of first contact between the ego's box and each other box (P, algorithm 2).

    Boxes are swept at constant velocity between frames, so no contact is missed.

    Args:
        ego: [A,T+1] its futures.
        length, width: m, of its box.
        others: the O vehicles near the ego.
        c: margins and time step.

    Returns:
        [A,O] s, inf for never.
    """
    mine = Boxes(ego.x, ego.y, ego.heading, length + c.margin_length, width + c.margin_width, ego.speed)
    touch = first_contacts(mine, others.boxes, c.dt)
    close = (touch == 0.0).any(0)  # inside the margin already: margins would make all actions equal
    if close.any():
        exact = mine._replace(length=length, width=width)
        touch[:, close] = first_contacts(exact, _only(others.boxes, close), c.dt)
    return touch


def _only(boxes: Boxes, which: Bools | Ints) -> Boxes:
    return Boxes(*(np.asarray(array)[which] for array in boxes))


class Neighbours(NamedTuple):
    """Present positions of the others relative to the path of every action."""

    in_lane: Bools  # [A,O] in the path's lane or moving into it
    gap: Floats  # [A,O] m, bumper to bumper; negative when side by side
    ahead: Bools  # [A,O] ahead of the ego
    behind: Bools  # [A,O] behind the ego in this lane


def neighbours(
    course: ActionPaths, arc: Floats, heading: float, length: float, others: Others, c: SafetyConfig
) -> Neighbours:
    """Present positions of the others relative to the path of every action.

    Args:
        course: the paths.
        arc: [A] m, arc of the ego's centre on each path.
        heading: rad, of the ego.
        length: m, of the ego.
        others: the O vehicles near it.
        c: limits.
    """
    paths, same = course.paths, course.same
    x, y, headings, lengths = (np.asarray(array) for array in others.boxes[:4])
    soon = min(5, x.shape[1] - 1)  # 1 s ahead: a vehicle moving in counts as in the lane
    theirs, offset = project_each(*paths, same, x[:, 0], y[:, 0])
    _, later = project_each(*paths, same, x[:, soon], y[:, soon])
    stand = _positions(
        *(theirs, offset, later, arc, heading, length), headings[:, 0], lengths, c.same_way, c.lane_half
    )
    return Neighbours(*stand)


@compiled
def _positions(
    theirs: Floats,  # [A,O] m, arc along each path
    offset: Floats,  # [A,O] m, present lateral offset
    later: Floats,  # [A,O] m, lateral offset in 1 s
    arc: Floats,  # [A] m, arc of the ego
    heading: float,
    length: float,
    headings: Floats,  # [O] rad
    lengths: Floats,  # [O] m
    same_way: float,
    lane_half: float,
) -> tuple[Bools, Floats, Bools, Bools]:
    """The fields of `Neighbours`."""
    shape = theirs.shape
    in_lane, gap = np.empty(shape, np.bool_), np.empty(shape)
    ahead, behind = np.empty(shape, np.bool_), np.empty(shape, np.bool_)
    for o in range(shape[1]):
        along = abs((headings[o] - heading + np.pi) % (2 * np.pi) - np.pi) < same_way
        for a in range(shape[0]):
            beside = min(abs(offset[a, o]), abs(later[a, o]))
            distance = theirs[a, o] - arc[a]
            gap[a, o] = abs(distance) - 0.5 * (length + lengths[o])
            in_lane[a, o] = along and beside < lane_half
            ahead[a, o] = in_lane[a, o] and distance > 0
            behind[a, o] = in_lane[a, o] and distance < 0 and gap[a, o] > 0
    return in_lane, gap, ahead, behind


def gap_margin(
    stopping: Floats, speed: float, changes: Bools, near: Neighbours, others: Others, c: SafetyConfig
) -> tuple[Floats, Ints]:
    """The score [A] s from the gaps around the ego, and the limiting vehicle [A].

    Leader: it brakes with `leader_brake` from now on, the ego fully from its next decision on, and they must
    not touch. A leader with shared intentions brakes no earlier than it announced. A lane change also needs
    free space beside the ego, and must not make the new follower brake harder than `follower_brake`. At the
    limit the score is safe_th, below it the score falls with the gap. Decelerating never makes a gap smaller.

    Args:
        stopping: [A] m, the ego's stopping distance.
        speed: present speed of the ego, m/s.
        changes: [A] the action changes lanes.
        near: positions of the others relative to the path of every action.
        others: the O vehicles near it.
        c: limits.
    """
    speeds = np.asarray(others.boxes.speed)
    soon = speeds[:, min(round(c.reaction / c.dt), speeds.shape[1] - 1)]
    ratio, tightest = _tightest(
        stopping,
        speed,
        changes,
        *near,
        speeds[:, 0],
        soon,
        others.intended,
        c.leader_brake,
        c.reaction,
        c.standstill_gap,
        c.follower_gap,
        c.follower_reaction,
        c.follower_brake,
    )
    return np.where(ratio >= 1.0, np.inf, 0.999 * c.safe_th * np.maximum(ratio, 0.0)), tightest


_DECELERATE = int(MetaAction.DECELERATE)


@compiled
def _tightest(
    stopping: Floats,
    own_speed: float,
    changes: Bools,
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
) -> tuple[Floats, Ints]:
    """Smallest ratio of actual to required gap [A], and the limiting vehicle [A]; see `gap_margin`."""
    actions, count = gap.shape
    best, tightest = np.full(actions, np.inf), np.zeros(actions, np.int64)
    for a in range(actions):
        for k in range(count):
            ratio = np.inf
            if a != _DECELERATE and ahead[a, k]:
                braking = soon[k] if intended[k] else speed[k]  # m/s at the start of hard braking
                theirs = braking * braking / (2 * leader_brake)
                if intended[k]:
                    theirs += 0.5 * (speed[k] + soon[k]) * reaction
                ratio = gap[a, k] / (max(stopping[a] - theirs, 0.0) + standstill_gap)
            if changes[a]:
                if behind[a, k]:
                    closing = max(speed[k] - own_speed, 0.0)
                    needed = speed[k] * follower_reaction + closing * closing / (2 * follower_brake)
                    ratio = gap[a, k] / (follower_gap + needed)
                if in_lane[a, k] and gap[a, k] < standstill_gap:
                    ratio = 0.0
            if ratio < best[a]:
                best[a], tightest[a] = ratio, k
    return best, tightest
