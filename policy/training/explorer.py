"""The agent in training: exploration, and recording of the learning AVs' trajectories."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from cosim.errors import in_range
from cosim.rewards import RewardTerms
from cosim.types import IS_MISSION, Decision, Floats32, History, MetaAction
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States, to_numpy
from policy.networks.vfn import VFN
from policy.training.experience import Ending, Trajectory

STATE_FIELDS = ("ahead", "kinematics", "situation", "unsafe")  # fields of `Trajectory` with D + 1 values


INTERACTION_RADIUS = 60.0  # m, distance to the mission vehicle that makes a decision an interaction


@dataclass(frozen=True, slots=True)
class ExploreConfig:
    """Number of learning AVs per episode and their exploration."""

    learners: int = 4  # AVs that explore and are recorded; the others act with frozen weights (P, Alg. 4)
    repeat: float = 2.0  # mean decisions that a random action is repeated: a gap does not open in 0.4 s

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="learners repeat")


class Explorer(PredictionAware):
    """`PredictionAware` whose first few AVs explore with the learner's weights.

    The others act greedily with `frozen` weights, so that one AV's transitions do not depend on its
    neighbours' exploration (semi-sequential training, P algorithm 4; T, section IV). `episode` must be called
    after `reset`.
    """

    def __init__(self, name: str, config: AgentConfig, explore: ExploreConfig) -> None:
        super().__init__(name, config)
        self.explore = explore
        self.frozen = VFN(config.vfn).eval()
        self.frozen.load_state_dict(self.vfn.state_dict())

    def episode(
        self, label: str, epsilon: float, rng: np.random.Generator, record: bool = True, keep: int = 0
    ) -> None:
        """Start an episode.

        Args:
            label: scenario, demand and seed of the trajectories.
            epsilon: share of exploration, 0 to 1.
            rng: source of the explored actions and of the learning AVs.
            record: False: no AV learns, all drive greedily with the frozen network.
            keep: decisions that an action drawn from the preferences is repeated; 0: epsilon-greedy.
        """
        self._label, self._epsilon, self._rng, self._keep = label, epsilon, rng, keep
        self._learners = self.explore.learners if record else 0
        self.learning: dict[str, dict[str, list[Any]]] = {}  # AV -> field of `Trajectory` -> values so far
        self._repeated: dict[str, int] = {}  # AV -> repeated random action
        # AV -> drawn action, and decisions left
        self._held: dict[str, tuple[MetaAction, int]] = {}
        self.done: list[Trajectory] = []

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """The agent's decisions with exploration; the states of learning AVs are recorded."""
        if not histories:
            return {}
        inputs = self.perceive(histories)
        if self._learners:
            self._choose_learners(inputs)
        scene = inputs.scene
        decisions = self.choose(self._explored(self.values(inputs), scene.agents), inputs)
        for b, av in enumerate(scene.agents):
            if av in self.learning:
                self._record(av, b, inputs, decisions[av])
        return decisions

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """See `PredictionAware.perceive`; with an encoder, shared by both networks, latents replace maps."""
        inputs = self.encoded(super().perceive(histories))
        maps = inputs.states.maps
        if maps.is_floating_point():  # same precision as in the replay buffer
            maps = maps.to(torch.float16)
        return inputs._replace(states=inputs.states._replace(maps=maps))

    def values(self, inputs: Inputs) -> Floats32:
        """The learner's values for learning AVs, the frozen ones for the others."""
        mine = np.array([av in self.learning for av in inputs.scene.agents])
        q = np.zeros((len(mine), len(MetaAction)), np.float32)
        for rows, network in ((mine, self.vfn), (~mine, self.frozen)):
            if rows.any():
                part = np.flatnonzero(rows)
                agents = [inputs.scene.agents[b] for b in part]
                states = States(*(t[torch.from_numpy(part)] for t in inputs.states))
                q[rows] = self.valued(network, agents, states)
        return q

    def pay(self, terms: Mapping[str, RewardTerms], crashed: frozenset[str], present: frozenset[str]) -> None:
        """Rewards of the last decision; trajectories of `crashed` AVs and of those not `present` end."""
        for av in [av for av in self.learning if av in terms]:
            t = terms[av]
            self.learning[av]["terms"].append(np.array((t.ego, t.av_social, t.hv_social), np.float32))
            if av in crashed or av not in present:
                # the state after the last decision was never observed: the one before is a placeholder
                self._close(av, "crashed" if av in crashed else "left", again=True)

    def finish(self) -> list[Trajectory]:
        """The trajectories of a finished episode; open trajectories are cut at the last state."""
        for av in list(self.learning):
            self._close(av, "cut", again=False)
        return self.done

    # ---- inside ----

    def _choose_learners(self, inputs: Inputs) -> None:
        """AVs that perceive a mission vehicle first, then any."""
        scene = inputs.scene
        sees = [bool((h.kinematics[-1, :, IS_MISSION] * h.valid[-1] > 0.5).any()) for h in scene.histories]
        draws = self._rng.random(len(scene.agents))
        order = sorted(range(len(scene.agents)), key=lambda b: (not sees[b], draws[b]))
        self.learning = {scene.agents[b]: defaultdict(list) for b in sorted(order[: self._learners])}
        self._learners = 0

    def _explored(self, q: Floats32, agents: Sequence[str]) -> Floats32:
        """Random preferences in place of some learning AVs' values; the prioritizer still applies."""
        q = q.copy()
        if self._keep:
            self._draw(q, agents)
            return q
        for b, av in enumerate(agents):
            if av not in self.learning:
                continue
            draws = self._rng.random(2)
            if av in self._repeated and draws[0] < 1.0 / self.explore.repeat:
                del self._repeated[av]
            # start rate for a share epsilon of random decisions
            start = self._epsilon / max(self.explore.repeat - self._epsilon * (self.explore.repeat - 1), 1.0)
            if av not in self._repeated and draws[1] < start:
                self._repeated[av] = int(self._rng.integers(len(MetaAction)))
            if av in self._repeated:
                q[b] = self._rng.random(len(MetaAction)).astype(np.float32)
                q[b, self._repeated[av]] = 2.0
        return q

    def _draw(self, q: Floats32, agents: Sequence[str]) -> None:
        """Preferences q [B,A] of learning AVs, changed so that the drawn action is preferred."""
        mine = [b for b, av in enumerate(agents) if av in self.learning]
        # the largest of log-preferences + Gumbel noise is a draw from their softmax
        noise = self._rng.gumbel(size=(len(mine), q.shape[1])).astype(np.float32)
        for b, noises in zip(mine, noise, strict=True):
            if not self._holds(agents[b], q[b]):
                q[b] += noises
                if self._keep > 1:
                    self._held[agents[b]] = MetaAction(int(q[b].argmax())), self._keep - 1

    def _holds(self, av: str, q: Floats32) -> bool:
        """Whether an action is fixed for this decision; then q [A] is set to prefer it."""
        action, more = self._held.pop(av, (None, 0))
        if action is None:
            return False
        q[action] = q.max() + 1.0
        if more > 1:
            self._held[av] = action, more - 1
        return True

    def _record(self, av: str, b: int, inputs: Inputs, decision: Decision) -> None:
        """One decision of the learning AV `av`, row `b` of the inputs."""
        history, states, recorded = inputs.scene.histories[b], inputs.states, self.learning[av]
        assert decision.q is not None
        free = np.zeros(len(MetaAction), np.bool_)  # without a prioritizer nothing is masked
        unsafe = free if decision.unsafe is None else decision.unsafe
        preferred = int(np.argmax(decision.q))
        newest, maps, past = history.kinematics[-1], states.maps[b].numpy(), self.observation.frames
        mission = history.valid[-1] & (newest[:, IS_MISSION] > 0.5)
        close = mission & (np.hypot(newest[:, 0], newest[:, 1]) < INTERACTION_RADIUS)
        now = {
            "frames": maps[past - self._stride if recorded["frames"] else 0 : past].copy(),
            "ahead": maps[past:].copy(),
            "kinematics": to_numpy(states.kinematics[b]).astype(np.float16),
            "situation": to_numpy(states.situation[b]),
            "unsafe": unsafe,
            "action": np.int8(decision.action),
            "vetoed": np.int8(preferred if unsafe[preferred] else -1),
            "interacting": np.bool_(close.any() or unsafe[preferred]),
        }
        for name, value in now.items():
            recorded[name].append(value)

    @property
    def _stride(self) -> int:
        timing = self._context.timing
        return round(timing.decision / timing.frame)

    def _close(self, av: str, ending: Ending, *, again: bool) -> None:
        """End a trajectory; `again`: the last state is stored twice."""
        recorded = self.learning.pop(av)
        count = len(recorded["terms"])  # decisions with a reward
        if not count:
            return
        if again:
            recorded["frames"].append(recorded["frames"][-1][-self._stride :])
            for name in STATE_FIELDS:
                recorded[name].append(recorded[name][-1])
        frames = np.concatenate(recorded.pop("frames"))[: self.observation.frames + count * self._stride]
        arrays: dict[str, Any] = {
            name: np.stack(values[: count + (name in STATE_FIELDS)]) for name, values in recorded.items()
        }
        self.done.append(
            Trajectory(
                episode=self._label,
                av=av,
                stride=self._stride,
                frames=frames,
                phi=self._context.svo,
                ending=ending,
                **arrays,
            )
        )
