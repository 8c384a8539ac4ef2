"""The safety prioritizer (P, algorithms 2 and 3): masks the actions that would lead to a collision.

Algorithm 2 rolls the ego out under each meta-action along its real lane centre lines, the others by their
predicted speeds along theirs, and finds when their (swept, oriented) boxes first touch. With first contact
at T, the time to collision at step h of the horizon is T - h, capped. A car ahead in the own lane counts only
if braking a little later would touch it as well: who can follow need not fall back. Two further limits look
at what a time to collision cannot see, because it is infinite at equal speeds: a leader that brakes hard, and
the new follower that a lane change asks to brake. Algorithm 3 takes the best action that is left.

AVs decide front to back, each knowing the rollouts chosen before it (V2V intentions, switchable).
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from cosim.control import LANE_CHANGE_TIME
from cosim.road import RoadMap
from cosim.types import Bools, Decision, Floats, Floats32, History, MetaAction
from policy.inputs.scene import Scene
from policy.prediction.motion import Rollout
from policy.prediction.traffic import Traffic
from policy.safety.config import SafetyConfig
from policy.safety.conflicts import Others, first_contact, gap_margin, neighbours, others_near
from policy.safety.maneuver import (
    ACTIONS,
    KEEPING,
    LANE_END,
    REFUSED,
    STRADDLING,
    TOO_SLOW,
    Futures,
    Way,
    Ways,
    at_lane_end,
    packed,
    roll_braked,
    roll_ego,
    straddling,
    ways_of,
)


class Evaluation(NamedTuple):
    """Algorithm 2 for one AV."""

    ttc: Floats  # [A] s until first contact under the action, capped
    score: Floats  # [A] s, P's weighted time to collision; -1 for impossible actions
    unsafe: Bools  # [A]
    blamed: tuple[str | None, ...]  # [A] who makes it unsafe
    futures: Futures  # the ego under each action


def prioritize(
    q: Floats32,
    scene: Scene,
    traffic: Traffic,
    road: RoadMap,
    config: SafetyConfig,
    share_intentions: bool = True,
    refused: Mapping[str, MetaAction] | None = None,
) -> dict[str, Decision]:
    """Decide for every AV of the scene, front to back (P, algorithm 3).

    Args:
        q: [B,A] action values, in the order of `scene.agents`.
        scene: what the AVs know (`policy.inputs.scene.join`).
        traffic: where everybody in it goes, `config.frames` frames of `config.dt` s ahead; not changed.
        road: the road map.
        config: thresholds and driving limits.
        share_intentions: V2V: the chosen rollouts of the AVs ahead replace their predictions.
        refused: AV -> the lane change just found impossible.

    Returns:
        AV -> decision with action, safety scores [A] s, mask [A] and who is to blame for it.

    Raises:
        ValueError: `traffic` does not reach `config.frames` frames ahead.
    """
    if traffic.rollout.x.shape[1] != config.frames + 1:
        raise ValueError(f"traffic must be predicted {config.frames} frames ahead")
    ours = Rollout(*(array.copy() for array in traffic.rollout)) if share_intentions else traffic.rollout
    traffic = traffic._replace(rollout=ours)
    intended = np.zeros(len(scene.vehicles), np.bool_)
    copies = _copies(scene)
    decisions: dict[str, Decision] = {}
    for b in front_to_back(scene, config):
        no = refused.get(scene.agents[b]) if refused else None
        evaluation = evaluate(b, scene, traffic, road, config, intended, no)
        decision = select(q[b], evaluation, config, _ties(scene.histories[b], config))
        decisions[scene.agents[b]] = decision
        if share_intentions:
            me = copies[scene.agents[b]]
            intended[me] = True
            for mine, shared in zip(ours, evaluation.futures.shared(decision.action), strict=True):
                mine[me] = shared
    return {agent: decisions[agent] for agent in scene.agents}


def _copies(scene: Scene) -> dict[str, list[int]]:
    """AV -> its places among the vehicles: with pooled knowledge one, else one for each AV that hears of its
    intentions, and its own."""
    if scene.shared:
        return {name: [k] for k, name in enumerate(scene.vehicles)}
    found: dict[str, list[int]] = {name: [] for name in scene.agents}
    for name, history, row in zip(scene.agents, scene.histories, scene.row, strict=True):
        for other, k in zip(history.ids, row, strict=True):
            if other in found and (other == name or history.hears is None or other in history.hears):
                found[other].append(int(k))
    return found


def _ties(history: History, c: SafetyConfig) -> tuple[MetaAction, ...]:
    """Order of equally valued actions: an AV that once gave way does not crawl or stand for ever."""
    if history.target_speed < c.resume_below * history.route.speed_limit:
        return (MetaAction.ACCELERATE, *(a for a in c.ties if a != MetaAction.ACCELERATE))
    return c.ties


def select(
    q: Floats32, evaluation: Evaluation, config: SafetyConfig, ties: Sequence[MetaAction] = ()
) -> Decision:
    """The best valued safe action; if there is none, the one with the highest score (P, algorithm 3).

    Args:
        q: [A] action values.
        evaluation: of this AV (`evaluate`).
        config: thresholds.
        ties: the order of equally valued actions (default: the configured one).
    """
    values = q.tolist()
    order = sorted(ties or config.ties, key=lambda a: -values[a])  # stable
    preferred = order[0]
    chosen = next((a for a in order if not evaluation.unsafe[a]), None)
    fallback = chosen is None
    if chosen is None:  # equal scores: better slower than as preferred
        chosen = max(order, key=lambda a: (float(evaluation.score[a]), a == MetaAction.DECELERATE))
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
    refused: MetaAction | None = None,
) -> Evaluation:
    """Times to collision and safety scores of all five actions of one AV (P, algorithm 2).

    Args:
        b: place of the AV among `scene.agents`.
        scene, traffic, road, config: as in `prioritize`.
        intended: [V] whose rollout is a shared intention, not a prediction.
        refused: a lane change found impossible.
    """
    c, history = config, scene.histories[b]
    me = int(scene.ego[b])
    ways = ways_of(history, road, int(scene.lane[me]))
    course = packed(tuple(way.path for way in ways))
    futures = roll_ego(history, course.paths, scene.state[me, -1], c)
    ego = Rollout(*(array[: len(ACTIONS)] for array in futures.under))
    others = others_near(b, me, scene, traffic, road, c, intended, ways[KEEPING[0]].path.lanes)
    contact, limit, blamed = _met(history, ways, course, futures.stopping, ego, others, scene, me, c)
    for a in map(int, straddling(ego, c)):
        if 0.9 * c.safe_th < limit[a]:
            limit[a] = 0.9 * c.safe_th
            blamed[a] = blamed[a] or STRADDLING
    ends = at_lane_end(ego, course, c) if not c.assisted else {}
    for a, reached in ends.items():
        if reached < contact[a]:
            contact[a], blamed[a] = reached, LANE_END
    steps, weight, total = _weights(c)
    remaining = np.clip(contact[:, None] - steps, 0.0, c.cap)  # [A,M]: T - h
    score = np.minimum(remaining @ weight / total, limit)
    unsafe = (score < c.safe_th) | (remaining.min(1) < c.critical_th)
    for a, way in enumerate(ways):
        forbidden = way.forbidden
        if way.changes and ego.speed[a, : round(LANE_CHANGE_TIME / c.dt)].min() < c.lane_change_speed:
            forbidden = TOO_SLOW
        if way.changes and ACTIONS[a] == refused:
            forbidden = REFUSED
        if forbidden is not None:
            unsafe[a], score[a], blamed[a] = True, -1.0, forbidden
    who = tuple(name if bad else None for name, bad in zip(blamed, unsafe, strict=True))
    return Evaluation(np.minimum(contact, c.cap), score, unsafe, who, futures)


def _met(
    history: History,
    ways: list[Way],
    course: Ways,
    stopping: Floats,
    ego: Rollout,
    others: Others,
    scene: Scene,
    me: int,
    c: SafetyConfig,
) -> tuple[Floats, Floats, list[str | None]]:
    """Whom each action meets: first contact [A] s, the score [A] s that leader and follower allow (both inf
    for nobody), and who it is [A]."""
    count = len(ACTIONS)
    if not len(others.rows):
        return np.full(count, np.inf), np.full(count, np.inf), [None] * count
    now = scene.state[me, -1]
    length, width = float(now[4]), float(now[5])
    near = neighbours(course, ego.arc[:, 0] - 0.5 * length, float(now[3]), length, others, c)
    times = first_contact(ego, length, width, others, c)  # [A,O] s
    times[near.behind] = np.inf  # followers brake: a change asks by `gap_margin` whether they must
    held, ahead = times[KEEPING], near.ahead[KEEPING]
    if c.assisted:
        times[KEEPING] = held = np.where(ahead, np.inf, held)
    if c.brake_after < c.frames * c.dt and np.isfinite(held[ahead]).any():
        braked = roll_braked(history, ways[KEEPING[0]].path, now, ego, KEEPING, c)
        late = first_contact(braked, length, width, others, c)
        times[KEEPING] = np.where(ahead, np.maximum(held, late), held)
    first = times.argmin(1)
    contact = times[np.arange(count), first]
    changes = np.array([way.changes for way in ways])
    limit, tightest = gap_margin(stopping, float(now[2]), changes, near, others, c)
    if c.assisted:
        limit[KEEPING] = np.inf
    blamed: list[str | None] = [None] * count
    for a in range(count):
        if contact[a] > c.horizon + c.critical_th and limit[a] < c.safe_th:
            blamed[a] = scene.vehicles[others.rows[tightest[a]]]
        elif contact[a] < np.inf:
            blamed[a] = scene.vehicles[others.rows[first[a]]]
    return contact, limit, blamed


@cache
def _weights(c: SafetyConfig) -> tuple[Floats, Floats, float]:
    """The horizon's steps [M] s, their weights [M], and the sum of these."""
    steps: Floats = c.dt * np.arange(1, round(c.horizon / c.dt) + 1, dtype=np.float64)
    weight: Floats = np.exp(-c.decay * (steps - steps[0]))
    return steps, weight, float(weight.sum())


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
    near = dx * dx + dy * dy < 150.0**2  # m: further away nobody matters
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
