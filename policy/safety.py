"""The safety prioritizer (P, algorithms 2 and 3): masks the actions that would lead to a collision.

Algorithm 2 rolls the ego out under each meta-action along its real lane centre lines, the others by their
predicted speeds along theirs, and finds when their (swept, oriented) boxes first touch. With first contact
at T, the time to collision at step h of the horizon is T - h, capped. Two further limits look at what a
time to collision cannot see, because it is infinite at equal speeds: a leader that brakes hard, and the new
follower that a lane change asks to brake. Algorithm 3 takes the best action that is left.

AVs decide front to back, each knowing the rollouts chosen before it (V2V intentions, switchable).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry import Boxes, time_to_collision
from cosim.road import LanePath, RoadMap
from cosim.types import Bools, Decision, Floats, Floats32, History, MetaAction
from policy.motion import (
    LANE_CHANGE_TIME,
    MAX_DECEL,
    SPEED_STEP,
    Rollout,
    braking_speeds,
    fronts,
    next_target,
    pack,
    project,
    project_all,
    project_many,
    roll_out,
    tracked_speeds,
)
from policy.scene import Scene
from policy.traffic import Traffic

ACTIONS = tuple(MetaAction)
SIDE = {MetaAction.LANE_LEFT: 0, MetaAction.LANE_RIGHT: 2}  # index into RouteAhead.paths
LANE_END = "(lane end)"
ROAD_EDGE = "(no lane)"
UNDER_WAY = "(lane change under way)"
TOO_SLOW = "(too slow to change lanes)"
STRADDLING = "(stands across two lanes)"


@dataclass(frozen=True, slots=True)
class SafetyConfig:
    """Thresholds (contract.md, What is not in the papers) and the driving limits behind them."""

    safe_th: float = 3.0  # s, P: safe_th
    critical_th: float = 1.5  # s, P: critical_th
    decay: float = 0.5  # 1/s, lambda of the weights
    cap: float = 10.0  # s, time to collision counts no further
    horizon: float = 4.0  # s, P, Table I
    dt: float = 0.2  # s
    margin_length: float = 1.0  # m, added to the ego's box along
    margin_width: float = 0.6  # m, and across: half of the room between cars in neighbouring lanes
    reach: float = 125.0  # m, as the kinematic rows
    reaction: float = 0.4  # s until the next decision can brake
    leader_brake: float = 8.0  # m/s2, a leader's hardest expected braking
    standstill_gap: float = 1.0  # m left between standing cars
    follower_reaction: float = 0.5  # s of a new follower
    follower_brake: float = 3.0  # m/s2, the most that a lane change may ask of it
    follower_gap: float = 2.0  # m, at least
    lane_change_speed: float = 3.0  # m/s: slower, a car cannot get sideways within a lane change's time
    straddle: float = 1.0  # m beside the centre line: a car whose rear stands there blocks two lanes
    lane_half: float = 1.6  # m from a centre line within which a vehicle is in that lane
    same_way: float = 1.05  # rad, headings closer than this (60 degrees) drive the same way
    resume_below: float = 0.5  # of the speed limit: slower commands are not kept among equal values
    # among equally valued actions: keep going, else give way, else evade
    ties: tuple[MetaAction, ...] = (
        MetaAction.IDLE,
        MetaAction.DECELERATE,
        MetaAction.ACCELERATE,
        MetaAction.LANE_LEFT,
        MetaAction.LANE_RIGHT,
    )

    @property
    def frames(self) -> int:
        """Steps of a rollout: far enough to see every contact that either threshold asks about."""
        seen = max(self.horizon + self.critical_th, self.safe_th + 0.5 * self.horizon)  # s
        return int(np.ceil(seen / self.dt - 1e-9))


class Evaluation(NamedTuple):
    """Algorithm 2 for one AV."""

    ttc: Floats  # [A] s until first contact under the action, capped
    score: Floats  # [A] s, P's weighted time to collision; -1 for impossible actions
    unsafe: Bools  # [A]
    blamed: tuple[str | None, ...]  # [A] who makes it unsafe
    rollout: Rollout  # [A,T+1] the ego under each action, as its allies are told


def prioritize(
    q: Floats32,
    scene: Scene,
    traffic: Traffic,
    road: RoadMap,
    config: SafetyConfig,
    share_intentions: bool = True,
) -> dict[str, Decision]:
    """Decide for every AV of the scene. q [B,A] action values.

    With `share_intentions` the rollouts of the AVs ahead replace their predictions; `traffic` is not changed.
    It must reach `config.frames` steps ahead (ValueError).
    """
    if traffic.rollout.x.shape[1] != config.frames + 1:
        raise ValueError(f"traffic must be predicted {config.frames} frames ahead")
    ours = Rollout(*(array.copy() for array in traffic.rollout)) if share_intentions else traffic.rollout
    traffic = traffic._replace(rollout=ours)
    intended = np.zeros(len(scene.vehicles), np.bool_)
    name_row = {name: k for k, name in enumerate(scene.vehicles)}
    decisions: dict[str, Decision] = {}
    for b in front_to_back(scene, config):
        evaluation = evaluate(b, scene, traffic, road, config, intended)
        decision = select(q[b], evaluation, config, _ties(scene.histories[b], config))
        decisions[scene.agents[b]] = decision
        if share_intentions:
            me = name_row[scene.agents[b]]
            intended[me] = True
            for mine, chosen in zip(ours, evaluation.rollout, strict=True):
                mine[me] = chosen[decision.action]
    return {agent: decisions[agent] for agent in scene.agents}


def _ties(history: History, c: SafetyConfig) -> tuple[MetaAction, ...]:
    """Order of equally valued actions: an AV that once gave way does not crawl or stand for ever."""
    if history.target_speed < c.resume_below * history.route.speed_limit:
        return (MetaAction.ACCELERATE, *(a for a in c.ties if a != MetaAction.ACCELERATE))
    return c.ties


def select(
    q: Floats32, evaluation: Evaluation, config: SafetyConfig, ties: Sequence[MetaAction] = ()
) -> Decision:
    """Algorithm 3: the best valued safe action; if there is none, the one with the highest score.

    `ties`: the order of equally valued actions (default: the configured one).
    """
    order = sorted(ties or config.ties, key=lambda a: -float(q[a]))  # stable
    preferred = order[0]
    safe = [a for a in order if not evaluation.unsafe[a]]
    fallback = not safe
    # equal scores: better slower than as preferred
    last = max(order, key=lambda a: (float(evaluation.score[a]), a == MetaAction.DECELERATE))
    chosen = safe[0] if safe else last
    return Decision(
        chosen,
        q=np.asarray(q, np.float32),
        safety_score=evaluation.score.astype(np.float32),
        unsafe=evaluation.unsafe,
        ttc=evaluation.ttc.astype(np.float32),
        blamed=evaluation.blamed[preferred],
        vetoed=bool(evaluation.unsafe[preferred]),
        fallback=fallback,
    )


def evaluate(
    b: int,
    scene: Scene,
    traffic: Traffic,
    road: RoadMap,
    config: SafetyConfig,
    intended: Bools,
) -> Evaluation:
    """Algorithm 2 for AV `b`, all five actions at once.

    `intended` [V]: whose rollout is a shared intention, not a prediction.
    """
    c, history = config, scene.histories[b]
    me = int(scene.ego[b])
    length = float(traffic.length[me])
    ways = _ways(history, road, int(scene.lane[me]))
    paths = [w.path for w in ways]
    futures = _roll_ego(history, paths, scene.state[me, -1], c)
    ego = futures.under
    others = _others(b, me, scene, traffic, road, c.reach)
    contact = np.full(len(ACTIONS), np.inf)  # s
    limit = np.full(len(ACTIONS), np.inf)  # score allowed by the leader and follower limits
    blamed: list[str | None] = [None] * len(ACTIONS)
    if len(others):
        touch = _first_contact(ego, traffic, me, others, c)  # [A,O] s
        seen: dict[int, _Neighbours] = {}
        for a, way in enumerate(ways):
            near = seen.get(id(way.path))
            if near is None:
                arc = ego.arc[a, 0] - 0.5 * length  # m, centre
                near = _Neighbours.of(way.path, arc, length, others, traffic, scene.state[me, -1], c)
                seen[id(way.path)] = near
            times = np.where(near.behind, np.inf, touch[a])  # followers brake: checked below for changes
            first = int(np.argmin(times))
            contact[a] = times[first]
            if np.isfinite(times[first]):
                blamed[a] = scene.vehicles[others[first]]
            allowed, who = _margin(a, way.changes, futures, near, traffic, others, intended, c)
            if allowed < c.safe_th:
                limit[a] = allowed
                if contact[a] > c.horizon + c.critical_th:
                    blamed[a] = scene.vehicles[others[who]]
    for a in map(int, np.flatnonzero(_straddles(ego, c))):
        if 0.9 * c.safe_th < limit[a]:
            limit[a] = 0.9 * c.safe_th
            blamed[a] = blamed[a] or STRADDLING
    for a, way in enumerate(ways):
        if way.path.dead_end:  # an obstacle at its end
            over = ego.arc[a] + 0.5 > way.path.length
            if over.any() and c.dt * int(np.argmax(over)) < contact[a]:
                contact[a], blamed[a] = c.dt * int(np.argmax(over)), LANE_END
    steps = c.dt * np.arange(1, round(c.horizon / c.dt) + 1)  # [M] s
    weight = np.exp(-c.decay * (steps - steps[0]))
    remaining = np.clip(contact[:, None] - steps, 0.0, c.cap)  # [A,M]: T - h
    score = np.minimum(remaining @ weight / weight.sum(), limit)
    unsafe = (score < c.safe_th) | (remaining.min(1) < c.critical_th)
    for a, way in enumerate(ways):
        forbidden = way.forbidden
        if way.changes and ego.speed[a, : round(LANE_CHANGE_TIME / c.dt)].min() < c.lane_change_speed:
            forbidden = TOO_SLOW
        if forbidden is not None:
            unsafe[a], score[a], blamed[a] = True, -1.0, forbidden
    blamed = [who if bad else None for who, bad in zip(blamed, unsafe, strict=True)]
    return Evaluation(np.minimum(contact, c.cap), score, unsafe, tuple(blamed), futures.intention)


def front_to_back(scene: Scene, config: SafetyConfig) -> list[int]:
    """The order in which AVs decide: always the one with the fewest undecided AVs ahead of it.

    `a` is ahead of `b` when it lies before b's nose and drives the same way; on crossing ways the one that is
    nearer to the conflict zone is. Equal counts go by id.
    """
    count = len(scene.agents)
    x, y, heading = scene.pose.T
    dx, dy = x[None, :] - x[:, None], y[None, :] - y[:, None]  # [b,a] of a as seen from b
    ahead_by = dx * np.cos(heading)[:, None] + dy * np.sin(heading)[:, None]
    turn = np.abs((heading[None, :] - heading[:, None] + np.pi) % (2 * np.pi) - np.pi)
    near = dx * dx + dy * dy < 150.0**2  # m: further away nobody cares
    conflict = np.array([h.route.conflict_distance for h in scene.histories])
    same = turn < config.same_way
    ahead = near & np.where(same, ahead_by > 0.0, conflict[None, :] < conflict[:, None])
    np.fill_diagonal(ahead, False)
    order: list[int] = []
    waiting = ahead.sum(1).astype(np.int64)
    for _ in range(count):
        b = int(np.argmin(waiting))
        order.append(b)
        waiting -= ahead[:, b]
        waiting[b] = np.iinfo(np.int64).max // 2
    return order


class _Way(NamedTuple):
    """Where one action leads."""

    path: LanePath
    changes: bool  # to another lane
    forbidden: str | None  # why it cannot be done


def _ways(history: History, road: RoadMap, lane: int) -> list[_Way]:
    """[A] the path of every action. While a lane change is under way all of them end in its target lane."""
    left, keep, right = history.route.paths
    assert keep is not None
    under_way = history.lane_changing
    if under_way:
        # the lane index flips half way: before that the target lane is the neighbour
        x, y, heading = history.pose
        half = 0.5 * float(history.kinematics[-1, 0, 4])
        x, y = x + half * np.cos(heading), y + half * np.sin(heading)  # front
        _, offset = project(keep.points, keep.arc, 0, len(keep.arc), x, y, history.route.arc)
        side = left if under_way > 0 else right
        if offset * under_way > 0.05 and side is not None:
            keep = side
    ways = []
    for action in ACTIONS:
        index = SIDE.get(action)
        if index is None:
            ways.append(_Way(keep, False, None))
            continue
        target = history.route.paths[index]
        if target is None or under_way or road.lanes[lane].internal:
            ways.append(_Way(keep, False, ROAD_EDGE if target is None else UNDER_WAY))
            continue
        worse = target.dead_end and (
            not keep.dead_end or target.length - history.route.arc < keep.length - history.route.arc - 1.0
        )
        ways.append(_Way(target, True, LANE_END if worse else None))
    return ways


class _Ego(NamedTuple):
    """The ego's possible futures."""

    under: Rollout  # [A,T+1] what each action is judged by
    intention: Rollout  # [A,T+1] what the allies are told
    lag: Floats  # [A] s until braking begins: the target speed may be far above the speed


def _roll_ego(history: History, paths: list[LanePath], now: Floats, c: SafetyConfig) -> _Ego:
    """The ego (state `now` [8]) under every action, along the path of each.

    An action is held, as P's algorithm 2 says. Decelerating again and again means braking to a standstill, so
    Decelerate is judged by that: it is safe as long as braking helps. The allies are told of one step of it.
    """
    speed, limit = float(now[2]), history.route.speed_limit
    targets = np.array([next_target(history.target_speed, a, limit) for a in ACTIONS], np.float64)
    slower = ACTIONS.index(MetaAction.DECELERATE)
    rows = [*range(len(ACTIONS)), slower]  # the last one: Decelerate once
    packed = pack([paths[k] for k in rows])
    count = len(rows)
    speeds = tracked_speeds(speed, targets[rows], c.frames, c.dt)
    speeds[slower] = braking_speeds(speed, targets[slower], c.frames, c.dt, c.reaction)
    x, y = fronts(np.repeat(now[None], count, 0))
    arc, offset = project_many(*packed, x, y, np.full(count, history.route.arc))
    wide = np.abs(offset) > 0.3  # a lane change, new or under way
    out = roll_out(
        packed,
        arc,
        offset,
        np.zeros(count),
        np.full(count, now[3]),
        np.where(wide, 2 * c.lane_half / LANE_CHANGE_TIME, 0.3),
        np.full(count, now[4]),
        speeds,
        np.full(count, np.inf),
        MAX_DECEL,
        c.dt,
    )
    told = [*rows[:slower], len(ACTIONS), *rows[slower + 1 : -1]]
    steps = np.ceil((targets - speed) / SPEED_STEP - 1e-6)  # decisions until the target is below the speed
    return _Ego(
        Rollout(*(array[: len(ACTIONS)] for array in out)),
        Rollout(*(array[told] for array in out)),
        c.reaction * np.maximum(steps, 0.0),
    )


def _straddles(ego: Rollout, c: SafetyConfig) -> Bools:
    """[A] whether the ego would come to a stop across two lanes."""
    standing = (ego.speed < 1.0) & (np.abs(ego.rear) > c.straddle)
    return np.asarray(standing.any(1))


def _others(
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
    lane = int(scene.lane[me])
    return np.array([k for k in rows if road.connected(lane, int(scene.lane[k]))], np.int64)


def _first_contact(
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
    """`_first_contact` with the ego's box made `longer` and `wider` (m)."""
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


class _Neighbours(NamedTuple):
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
    ) -> _Neighbours:
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
        return _Neighbours(in_lane, gap, in_lane & (distance > 0), in_lane & (distance < 0) & (gap > 0))


def _margin(
    action: int,
    changes: bool,
    futures: _Ego,
    near: _Neighbours,
    traffic: Traffic,
    others: npt.NDArray[np.int64],
    intended: Bools,
    c: SafetyConfig,
) -> tuple[float, int]:
    """The score (s) that the gaps around the ego leave, and which of the others limits it.

    Leader: if it brakes with `leader_brake` from now on, and the ego with full force after one more decision,
    they must not touch; one that shares its intentions tells when it brakes, in time to brake with it.
    A lane change further needs the place beside the ego, and a new follower that need not brake harder than
    `follower_brake`. At the limit the score is safe_th, below it falls with the gap. Decelerating never makes
    a gap smaller.
    """
    ego = futures.under
    speed = traffic.rollout.speed[others, 0]
    ratio = np.full(len(others), np.inf)  # of the gap there is to the gap needed
    if action != MetaAction.DECELERATE:
        told = intended[others]
        stopping = np.where(
            told,
            _stopping(ego, action, futures.lag[action], c),
            _stopping(ego, action, futures.lag[action] + c.reaction, c),
        )
        need = np.maximum(stopping - speed**2 / (2 * c.leader_brake), 0.0) + c.standstill_gap
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


def _stopping(ego: Rollout, action: int, delay: float, c: SafetyConfig) -> float:
    """m until standstill when the ego goes on under the action for `delay` s and then brakes."""
    frame = min(round(delay / c.dt), ego.speed.shape[1] - 1)
    travelled = float(ego.arc[action, frame] - ego.arc[action, 0])
    return travelled + float(ego.speed[action, frame]) ** 2 / (2 * MAX_DECEL)
