"""The safety prioritizer (P, algorithms 2 and 3): a mask of actions that would lead to a collision.

Algorithm 2 rolls the ego out under each meta-action along its real lane centre lines, and the others at their
predicted speeds along theirs. It finds the first contact of their (swept, oriented) boxes. With first contact
at T, the time to collision at step h of the horizon is T - h, capped. A vehicle ahead in the own lane counts
only if slightly later braking would touch it as well, so that normal following is safe. Two further limits
cover cases of equal speed, where the time to collision is infinite: a leader that brakes hard, and a new
follower that has to brake for a lane change. Algorithm 3 takes the best remaining action.

AVs decide front to back; each knows the rollouts chosen before it (V2V intentions, switchable).
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
    HELD_ACTIONS,
    LANE_END,
    REFUSED,
    STRADDLING,
    TOO_SLOW,
    ActionPath,
    ActionPaths,
    Futures,
    at_lane_end,
    packed,
    paths_of_actions,
    roll_braked,
    roll_ego,
    straddling,
)


class Evaluation(NamedTuple):
    """Algorithm 2 for one AV."""

    ttc: Floats  # [A] s until first contact under the action, capped
    score: Floats  # [A] s, P's weighted time to collision; -1 for impossible actions
    unsafe: Bools  # [A]
    blamed: tuple[str | None, ...]  # [A] vehicle or reason that makes it unsafe
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
        scene: the AVs' joined knowledge (`policy.inputs.scene.join`).
        traffic: predicted traffic, `config.frames` frames of `config.dt` s ahead; not modified.
        road: the road map.
        config: thresholds and driving limits.
        share_intentions: V2V: the chosen rollouts of the AVs ahead replace their predictions.
        refused: AV -> lane change that was just refused.

    Returns:
        AV -> decision with action, safety scores [A] s, mask [A] and the reason for each masked action.

    Raises:
        ValueError: `traffic` does not reach `config.frames` frames ahead.
    """
    if traffic.rollout.x.shape[1] != config.frames + 1:
        raise ValueError(f"traffic must be predicted {config.frames} frames ahead")
    ours = Rollout(*(array.copy() for array in traffic.rollout)) if share_intentions else traffic.rollout
    traffic = traffic._replace(rollout=ours)
    intended = np.zeros(len(scene.vehicles), np.bool_)
    copies = _scene_indices(scene)
    decisions: dict[str, Decision] = {}
    for b in front_to_back(scene, config):
        no = refused.get(scene.agents[b]) if refused else None
        evaluation = evaluate(b, scene, traffic, road, config, intended, no)
        decision = select(q[b], evaluation, config, _tie_order(scene.histories[b], config))
        decisions[scene.agents[b]] = decision
        if share_intentions:
            me = copies[scene.agents[b]]
            intended[me] = True
            for mine, shared in zip(ours, evaluation.futures.shared(decision.action), strict=True):
                mine[me] = shared
    return {agent: decisions[agent] for agent in scene.agents}


def _scene_indices(scene: Scene) -> dict[str, list[int]]:
    """AV -> its indices among the vehicles: one with pooled knowledge, else its own and one per AV that
    receives its intentions."""
    if scene.shared:
        return {name: [k] for k, name in enumerate(scene.vehicles)}
    found: dict[str, list[int]] = {name: [] for name in scene.agents}
    for name, history, row in zip(scene.agents, scene.histories, scene.row, strict=True):
        for other, k in zip(history.ids, row, strict=True):
            if other in found and (other == name or history.hears is None or other in history.hears):
                found[other].append(int(k))
    return found


def _tie_order(history: History, c: SafetyConfig) -> tuple[MetaAction, ...]:
    """Order of equally valued actions, chosen so that an AV speeds up again after giving way."""
    if history.target_speed < c.resume_below * history.route.speed_limit:
        return (MetaAction.ACCELERATE, *(a for a in c.ties if a != MetaAction.ACCELERATE))
    return c.ties


def select(
    q: Floats32, evaluation: Evaluation, config: SafetyConfig, ties: Sequence[MetaAction] = ()
) -> Decision:
    """The best valued safe action; if there is none, the one with the highest score (P, algorithm 3).

    Args:
        q: [A] action values.
        evaluation: from `evaluate`, for this AV.
        config: thresholds.
        ties: the order of equally valued actions (default: the configured one).
    """
    values = q.tolist()
    order = sorted(ties or config.ties, key=lambda a: -values[a])  # stable
    preferred = order[0]
    chosen = next((a for a in order if not evaluation.unsafe[a]), None)
    fallback = chosen is None
    if chosen is None:  # equal scores: the slower action first
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
        b: index of the AV in `scene.agents`.
        scene, traffic, road, config: as in `prioritize`.
        intended: [V] the rollout is a shared intention, not a prediction.
        refused: lane change that was just refused.
    """
    c, history = config, scene.histories[b]
    me = int(scene.ego[b])
    ways = paths_of_actions(history, road, int(scene.lane[me]))
    course = packed(tuple(way.path for way in ways))
    futures = roll_ego(history, course.paths, scene.state[me, -1], c)
    ego = Rollout(*(array[: len(ACTIONS)] for array in futures.under))
    others = others_near(b, me, scene, traffic, road, c, intended, ways[HELD_ACTIONS[0]].path.lanes)
    contact, limit, blamed = _contacts(history, ways, course, futures.stopping, ego, others, scene, me, c)
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
    reasons = tuple(name if bad else None for name, bad in zip(blamed, unsafe, strict=True))
    return Evaluation(np.minimum(contact, c.cap), score, unsafe, reasons, futures)


def _contacts(
    history: History,
    ways: list[ActionPath],
    course: ActionPaths,
    stopping: Floats,
    ego: Rollout,
    others: Others,
    scene: Scene,
    me: int,
    c: SafetyConfig,
) -> tuple[Floats, Floats, list[str | None]]:
    """Per action: first contact [A] s, the score [A] s from leader and follower (both inf without one), and
    the responsible vehicle [A]."""
    count = len(ACTIONS)
    if not len(others.rows):
        return np.full(count, np.inf), np.full(count, np.inf), [None] * count
    now = scene.state[me, -1]
    length, width = float(now[4]), float(now[5])
    near = neighbours(course, ego.arc[:, 0] - 0.5 * length, float(now[3]), length, others, c)
    times = first_contact(ego, length, width, others, c)  # [A,O] s
    times[near.behind] = np.inf  # followers are assumed to brake; `gap_margin` checks them for lane changes
    held, ahead = times[HELD_ACTIONS], near.ahead[HELD_ACTIONS]
    if c.assisted:
        times[HELD_ACTIONS] = held = np.where(ahead, np.inf, held)
    if c.brake_after < c.frames * c.dt and np.isfinite(held[ahead]).any():
        braked = roll_braked(history, ways[HELD_ACTIONS[0]].path, now, ego, HELD_ACTIONS, c)
        late = first_contact(braked, length, width, others, c)
        times[HELD_ACTIONS] = np.where(ahead, np.maximum(held, late), held)
    first = times.argmin(1)
    contact = times[np.arange(count), first]
    changes = np.array([way.changes for way in ways])
    limit, tightest = gap_margin(stopping, float(now[2]), changes, near, others, c)
    if c.assisted:
        limit[HELD_ACTIONS] = np.inf
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
    """The decision order: always next is the AV with the fewest undecided AVs ahead of it.

    `a` is ahead of `b` when it is in front of b and drives in the same direction; on crossing paths the AV
    nearer to the conflict zone is ahead. Ties are broken by id.
    """
    count = len(scene.agents)
    x, y, heading = scene.pose.T
    dx, dy = x[None, :] - x[:, None], y[None, :] - y[:, None]  # [b,a] of a as seen from b
    ahead_by = dx * np.cos(heading)[:, None] + dy * np.sin(heading)[:, None]
    turn = np.abs((heading[None, :] - heading[:, None] + np.pi) % (2 * np.pi) - np.pi)
    near = dx * dx + dy * dy < 150.0**2  # m, range of the comparison
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
