"""The agent while it learns: explores, and writes down what its learning AVs see, do and are paid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from cosim.rewards import RewardTerms
from cosim.types import IS_MISSION, Bools, Decision, Floats32, History, MetaAction
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.tensors import States, to_numpy
from policy.training.experience import Ending, Trajectory
from policy.training.mentor import AS_GOOD, YIELD, Mentor
from policy.vfn import VFN


@dataclass(frozen=True, slots=True)
class ExploreConfig:
    """Who learns in an episode, and how it explores."""

    learners: int = 4  # AVs that explore and are recorded; the others act with frozen weights (P, Alg. 4)
    repeat: float = 2.0  # decisions a random action is kept on average: a gap does not open in 0.4 s
    sample: bool = False  # actions drawn from the network's preferences (A2C), not epsilon-greedy
    near: float = 60.0  # m to the mission vehicle within which a decision counts as interaction


@dataclass
class _Tape:
    """One learning AV's record while the episode runs."""

    frames: list[np.ndarray] = field(default_factory=list)
    ahead: list[np.ndarray] = field(default_factory=list)
    kinematics: list[np.ndarray] = field(default_factory=list)
    situation: list[np.ndarray] = field(default_factory=list)
    unsafe: list[np.ndarray] = field(default_factory=list)
    action: list[int] = field(default_factory=list)
    vetoed: list[int] = field(default_factory=list)
    wrong: list[Bools] = field(default_factory=list)
    terms: list[tuple[float, float, float]] = field(default_factory=list)
    interacting: list[bool] = field(default_factory=list)
    yielding: list[bool] = field(default_factory=list)


class Explorer(PredictionAware):
    """`PredictionAware` whose first few AVs explore with the learner's weights.

    The others act greedily with `frozen` ones, so that one AV's lesson is not blurred by its neighbours'
    (semi-sequential training, P algorithm 4; T, section IV). `episode` must be called after `reset`.
    """

    def __init__(self, name: str, config: AgentConfig, explore: ExploreConfig) -> None:
        super().__init__(name, config)
        self.explore = explore
        self.frozen = VFN(config.vfn).eval()
        self.frozen.load_state_dict(self.vfn.state_dict())
        self._mentor = Mentor(knows_command=config.vfn.kinematic > 0)

    def episode(
        self, label: str, epsilon: float, rng: np.random.Generator, guided: bool = False, record: bool = True
    ) -> None:
        """A new episode, with this much exploration (0 to 1), or `guided`: the mentor drives every AV.

        Without `record` nobody learns: all drive greedily by the frozen network.
        """
        self._label, self._epsilon, self._rng = label, epsilon, rng
        self._guided, self._learners = guided, self.explore.learners if record else 0
        self._mentored = guided or record
        self._mentor.reset(self._context)
        self.learning: dict[str, _Tape] = {}
        self._chosen = False
        self._whim: dict[str, int] = {}  # random action an AV is keeping up
        self.done: list[Trajectory] = []

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """As the agent's, with exploration; the states of learning AVs are recorded."""
        if not histories:
            return {}
        inputs = self.perceive(histories)
        if not self._chosen:
            self._choose_learners(inputs)
        scene = inputs.scene
        advice = np.zeros((len(scene.agents), len(MetaAction)), np.float32)  # no opinion
        if self._mentored:
            advice = self._mentor.preferences(dict(zip(scene.agents, scene.histories, strict=True)))
        q = advice if self._guided else self._explored(self.values(inputs), inputs)
        decisions = self.choose(q, inputs)
        for b, av in enumerate(scene.agents):
            if av in self.learning:
                self._record(self.learning[av], b, inputs, decisions[av], advice[b])
        return decisions

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
        """What the last decision brought; `crashed` AVs and those no longer `present` have ended."""
        for av, tape in list(self.learning.items()):
            if av not in terms:
                continue
            t = terms[av]
            tape.terms.append((t.ego, t.av_social, t.hv_social))
            if av in crashed or av not in present:
                # the state after the last decision was never seen: the one before stands in, unused
                self._close(av, "crashed" if av in crashed else "left", again=True)

    def finish(self) -> list[Trajectory]:
        """The episode is over, its last state has been decided upon: every open record is cut there."""
        for av in list(self.learning):
            self._close(av, "cut", again=False)
        return self.done

    # ---- inside ----

    def _choose_learners(self, inputs: Inputs) -> None:
        """Those who see a mission vehicle first, then any."""
        scene = inputs.scene
        sees = [bool((h.kinematics[-1, :, IS_MISSION] * h.valid[-1] > 0.5).any()) for h in scene.histories]
        luck = self._rng.random(len(scene.agents))
        order = sorted(range(len(scene.agents)), key=lambda b: (not sees[b], luck[b]))
        self.learning = {scene.agents[b]: _Tape() for b in sorted(order[: self._learners])}
        self._chosen = True

    def _explored(self, q: Floats32, inputs: Inputs) -> Floats32:
        """Random preferences in place of some learning AVs' values; the prioritizer still guards them."""
        q = q.copy()
        if self.explore.sample:  # the largest of preferences + Gumbel noise is a draw from their softmax
            mine = [b for b, av in enumerate(inputs.scene.agents) if av in self.learning]
            if self._epsilon > 0.0:
                q[mine] += self._rng.gumbel(size=(len(mine), q.shape[1])).astype(np.float32)
            return q
        for b, av in enumerate(inputs.scene.agents):
            if av not in self.learning:
                continue
            draws = self._rng.random(2)
            if av in self._whim and draws[0] < 1.0 / self.explore.repeat:
                del self._whim[av]
            # started so often that a share epsilon of the decisions is random
            start = self._epsilon / max(self.explore.repeat - self._epsilon * (self.explore.repeat - 1), 1.0)
            if av not in self._whim and draws[1] < start:
                self._whim[av] = int(self._rng.integers(len(MetaAction)))
            if av in self._whim:
                q[b] = self._rng.random(len(MetaAction)).astype(np.float32)
                q[b, self._whim[av]] = 2.0
        return q

    def _record(self, tape: _Tape, b: int, inputs: Inputs, decision: Decision, advice: Floats32) -> None:
        history, n = inputs.scene.histories[b], self.observation.frames
        if tape.frames:
            stride = self._stride
            tape.frames.append(history.velocity_map[-stride:].copy())
        else:
            tape.frames.append(history.velocity_map.copy())
        tape.ahead.append(inputs.states.maps[b, n:].numpy().copy())
        tape.kinematics.append(to_numpy(inputs.states.kinematics[b]).astype(np.float16))
        tape.situation.append(to_numpy(inputs.states.situation[b]))
        assert decision.q is not None
        free = np.zeros(len(MetaAction), np.bool_)  # without a prioritizer nothing is masked
        unsafe = free if decision.unsafe is None else decision.unsafe
        tape.unsafe.append(unsafe)
        tape.action.append(int(decision.action))
        preferred = int(np.argmax(decision.q))
        tape.vetoed.append(preferred if unsafe[preferred] else -1)
        # in a hopeless moment the mentor knows no better either
        best = -np.inf if unsafe.all() else advice[~unsafe].max()
        tape.wrong.append(~unsafe & (advice < best - AS_GOOD))
        tape.yielding.append(bool(advice.max() == YIELD))
        newest = history.kinematics[-1]
        mission = history.valid[-1] & (newest[:, IS_MISSION] > 0.5)
        close = mission & (np.hypot(newest[:, 0], newest[:, 1]) < self.explore.near)
        tape.interacting.append(bool(close.any()) or tape.vetoed[-1] >= 0)

    @property
    def _stride(self) -> int:
        timing = self._context.timing
        return round(timing.decision / timing.frame)

    def _close(self, av: str, ending: Ending, *, again: bool) -> None:
        tape = self.learning.pop(av)
        count = len(tape.terms)  # decisions that were paid
        if count == 0:
            return
        if again:
            tape.frames.append(tape.frames[-1][-self._stride :])
            for states in (tape.ahead, tape.kinematics, tape.situation, tape.unsafe):
                states.append(states[-1])
        self.done.append(
            Trajectory(
                episode=self._label,
                av=av,
                stride=self._stride,
                frames=np.concatenate(tape.frames)[: self.observation.frames + count * self._stride],
                ahead=np.stack(tape.ahead[: count + 1]),
                kinematics=np.stack(tape.kinematics[: count + 1]),
                situation=np.stack(tape.situation[: count + 1]),
                unsafe=np.stack(tape.unsafe[: count + 1]),
                action=np.array(tape.action[:count], np.int8),
                vetoed=np.array(tape.vetoed[:count], np.int8),
                wrong=np.stack(tape.wrong[:count]),
                terms=np.array(tape.terms, np.float32),
                interacting=np.array(tape.interacting[:count], np.bool_),
                yielding=np.array(tape.yielding[:count], np.bool_),
                phi=self._context.svo,
                ending=ending,
            )
        )
