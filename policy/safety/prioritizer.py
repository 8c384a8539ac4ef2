"""The safety prioritizer (P, algorithms 2 and 3): masks the actions that would lead to a collision.

Algorithm 2 rolls the ego out under each meta-action along its real lane centre lines, the others by their
predicted speeds along theirs, and finds when their (swept, oriented) boxes first touch. With first contact
at T, the time to collision at step h of the horizon is T - h, capped. A car ahead in the own lane counts only
if braking a little later would touch it as well: who can follow need not fall back. Two further limits look
at what a time to collision cannot see, because it is infinite at equal speeds: a leader that brakes hard, and
the new follower that a lane change asks to brake. Algorithm 3 takes the best action that is left.

AVs decide front to back, each knowing the rollouts chosen before it (V2V intentions, switchable).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from cosim.actions import LANE_CHANGE_TIME
from cosim.road import RoadMap
from cosim.types import Bools, Decision, Floats, Floats32, History, MetaAction
from policy.motion import Rollout
from policy.safety.config import SafetyConfig
from policy.safety.conflicts import Neighbours, first_contact, gap_margin, others_near
from policy.safety.maneuver import (
    ACTIONS,
    KEEPING,
    LANE_END,
    REFUSED,
    STRADDLING,
    TOO_SLOW,
    roll_braked,
    roll_ego,
    straddles,
    ways_of,
)
from policy.scene import Scene
from policy.traffic import Traffic


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
    refused: Mapping[str, MetaAction] | None = None,
) -> dict[str, Decision]:
    """Decide for every AV of the scene. q [B,A] action values; refused: lane changes just found impossible.

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
        no = refused.get(scene.agents[b]) if refused else None
        evaluation = evaluate(b, scene, traffic, road, config, intended, no)
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
    refused: MetaAction | None = None,
) -> Evaluation:
    """Algorithm 2 for AV `b`, all five actions at once; `refused`: a lane change found impossible.

    `intended` [V]: whose rollout is a shared intention, not a prediction.
    """
    c, history = config, scene.histories[b]
    me = int(scene.ego[b])
    length = float(traffic.length[me])
    ways = ways_of(history, road, int(scene.lane[me]))
    paths = [w.path for w in ways]
    futures = roll_ego(history, paths, scene.state[me, -1], c)
    ego = futures.under
    others = others_near(b, me, scene, traffic, road, c.reach)
    contact = np.full(len(ACTIONS), np.inf)  # s
    limit = np.full(len(ACTIONS), np.inf)  # score allowed by the leader and follower limits
    blamed: list[str | None] = [None] * len(ACTIONS)
    if len(others):
        touch = first_contact(ego, traffic, me, others, c)  # [A,O] s
        seen: dict[int, Neighbours] = {}
        late: Floats | None = None  # [K,O] s first contact when braking follows
        for a, way in enumerate(ways):
            near = seen.get(id(way.path))
            if near is None:
                arc = ego.arc[a, 0] - 0.5 * length  # m, centre
                near = Neighbours.of(way.path, arc, length, others, traffic, scene.state[me, -1], c)
                seen[id(way.path)] = near
            times = np.where(near.behind, np.inf, touch[a])  # followers brake: checked below for changes
            if a in KEEPING and np.isfinite(times[near.ahead]).any() and c.brake_after < c.frames * c.dt:
                if late is None:
                    braked = roll_braked(history, way.path, scene.state[me, -1], ego, KEEPING, c)
                    late = first_contact(braked, traffic, me, others, c)
                leader = np.maximum(times, late[KEEPING.index(a)])
                times = np.where(near.ahead, leader, times)
            first = int(np.argmin(times))
            contact[a] = times[first]
            if np.isfinite(times[first]):
                blamed[a] = scene.vehicles[others[first]]
            allowed, who = gap_margin(a, way.changes, futures, near, traffic, others, intended, c)
            if allowed < c.safe_th:
                limit[a] = allowed
                if contact[a] > c.horizon + c.critical_th:
                    blamed[a] = scene.vehicles[others[who]]
    for a in map(int, np.flatnonzero(straddles(ego, c))):
        if 0.9 * c.safe_th < limit[a]:
            limit[a] = 0.9 * c.safe_th
            blamed[a] = blamed[a] or STRADDLING
    for a, way in enumerate(ways):
        if way.path.dead_end:  # an obstacle at its end
            over = ego.arc[a] + 0.5 > way.path.length
            if over.any() and c.dt * int(np.argmax(over)) < contact[a]:
                contact[a], blamed[a] = c.dt * int(np.argmax(over)), LANE_END
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
    blamed = [who if bad else None for who, bad in zip(blamed, unsafe, strict=True)]
    return Evaluation(np.minimum(contact, c.cap), score, unsafe, tuple(blamed), futures.intention)


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
