"""Attribution: the inputs that a value network uses, found by evaluating it with one input replaced.

Attribution does not change the agent's behaviour. With an encoder, latents are replaced in place of maps:
each latent belongs to one frame, so replacing a latent equals replacing the map of that frame.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import torch

from cosim.types import Decision, Floats, Floats32, History, Ints, PolicyContext
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States, svo_tensor, to_numpy
from policy.networks.vfn import VFN

ZEROED, PRESENT, OTHERS = "zeroed", "as at present", "another AV's"
MAP_BRANCH_OFF = "map branch", "its last layer zero"
ORACLE = "prediction", "the fair oracle's"  # in closed loop only: a separate agent
ANGLES = (0, 90)  # degrees that replace phi: egoist and full altruist


Arguments = tuple[torch.Tensor | None, torch.Tensor, torch.Tensor, torch.Tensor]  # of VFN.forward
# Sums over the decisions of single AVs: count; changed actions, after the prioritizer and by value alone;
# mean absolute difference of the five action values; highest value minus second highest
SUMS = ("decisions", "choices_changed", "unmasked_changed", "mean_abs_dq", "spread")


def questions(
    network: VFN, states: States, past: int, only: tuple[str, str] | None = None
) -> Iterator[tuple[str, str, Arguments]]:
    """Every replacement of every input, or `only` one: (input, replacement, arguments of the network).

    Args:
        network: the evaluated network.
        states: inputs of B AVs that decide together; the first `past` frames of maps and kinematics are
            perceived, the others predicted.

    Replacements: zeroed; as at present (the newest perceived frame in every frame); another AV's of the same
    instant (the next row, with at least two AVs). Without maps the layer behind the convolutions acts as if
    its weights were zero (`VFN.forward`).
    """
    spans = {"past ": slice(past), "predicted ": slice(past, None), "all ": slice(None)}
    for field in network_inputs(network):
        whole: torch.Tensor = getattr(states, field)
        encoded = field == "maps" and whole.dim() == 3
        ways = {ZEROED: network.maps.blank.expand_as(whole) if encoded else torch.zeros_like(whole)}
        if field != "situation":
            ways[PRESENT] = whole[:, past - 1 : past].expand_as(whole)
        if len(whole) > 1:
            ways[OTHERS] = whole.roll(1, 0)
        predicts = field != "situation" and whole.shape[1] > past
        for span, part in spans.items() if predicts else (("", slice(None)),):
            for how, other in ways.items():
                if only not in (None, (span + field, how)):
                    continue
                changed = whole.clone()
                changed[:, part] = other[:, part]
                yield span + field, how, states._replace(**{field: changed})
    if only in (None, MAP_BRANCH_OFF):
        yield *MAP_BRANCH_OFF, (None, *states[1:])
    for angle in ANGLES:
        if only not in (None, ("phi", f"{angle} degrees")):
            continue
        phi = svo_tensor(math.radians(angle), len(states.phi))
        yield "phi", f"{angle} degrees", states._replace(phi=phi)


def network_inputs(network: VFN) -> tuple[str, ...]:
    """The fields of `States` that the network takes, except phi."""
    kinematics = ("kinematics",) if network.kinematics is not None else ()
    return ("maps", *kinematics, *(("situation",) if network.config.kinematic else ()))


def answer(agent: PredictionAware, arguments: Arguments) -> Floats32:
    """The action values [B,A] of the agent's network."""
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=agent.config.bf16):
        return to_numpy(agent.vfn(*arguments))


def replacements(network: VFN, past: int) -> list[tuple[str, str]]:
    """The pairs (input, replacement) for episodes in closed loop, where an input carries no information.

    Another AV's input of the same instant is within the training distribution; zeros are not. Predictions
    are also replaced by the present.
    """
    found, predicts = [], network.config.frames > past
    for field in network_inputs(network):
        whole = field if field == "situation" or not predicts else f"all {field}"
        found.append((whole, OTHERS))
        if whole != field:
            found += [(f"predicted {field}", how) for how in (OTHERS, PRESENT)]
    return [*found, MAP_BRANCH_OFF, ("phi", f"{ANGLES[0]} degrees")]


class _Encoding(PredictionAware):
    """The agent with latents in place of maps, if its network has an encoder."""

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """See `PredictionAware.perceive`."""
        return self.encoded(super().perceive(histories))


class Replaced(_Encoding):
    """The agent with one network input replaced; `what` None: the unchanged network."""

    def __init__(self, name: str, config: AgentConfig, what: tuple[str, str] | None) -> None:
        super().__init__(name, config)
        self._what = what

    def values(self, inputs: Inputs) -> Floats32:
        """The action values [B,A]; an AV that decides alone keeps its own input."""
        if self._what is not None:
            for _, _, arguments in questions(self.vfn, inputs.states, self.observation.frames, self._what):
                return answer(self, arguments)
        return super().values(inputs)


class Questioned(_Encoding):
    """The unchanged agent; `answers` holds the episode's SUMS by input and replacement."""

    def reset(self, context: PolicyContext) -> None:
        """Start an episode."""
        super().reset(context)
        self.answers: dict[tuple[str, str], Floats] = {}

    def choose(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """The agent's choice, after all counterfactual evaluations."""
        states, plain = inputs.states, answer(self, inputs.states)
        chosen, ordered = self._actions(plain, inputs), np.sort(plain, 1)
        for name, how, arguments in questions(self.vfn, states, self.observation.frames):
            other = answer(self, arguments)
            same = np.array_equal(other, plain)  # equal values need no second run of the prioritizer
            sums = (
                len(plain),
                0 if same else (self._actions(other, inputs) != chosen).sum(),
                (other.argmax(1) != plain.argmax(1)).sum(),
                np.abs(other - plain).mean(1).sum(),
                (ordered[:, -1] - ordered[:, -2]).sum(),
            )
            self.answers[name, how] = self.answers.get((name, how), 0.0) + np.array(sums, np.float64)
        return super().choose(q, inputs)

    def _actions(self, q: Floats32, inputs: Inputs) -> Ints:
        """[B] actions that follow from these values; the record of commanded lane changes is unchanged."""
        kept, self._asked = self._asked, dict(self._asked)
        decisions = super().choose(q, inputs)
        self._asked = kept
        return np.array([decision.action for decision in decisions.values()], np.int64)


class Explainer:
    """Attribution of one AV's choice at each of its decisions.

    The agent's behaviour is unchanged. `uses`: [input, replacement, resulting action, mean absolute
    difference of the five action values] of every pair in `replacements`, () without an observed AV.
    """

    def __init__(self, agent: PredictionAware) -> None:
        self.asked: str | None = None  # the observed AV
        self.uses: tuple[tuple[str, str, int, float], ...] = ()
        self._agent, self._choose = agent, agent.choose
        setattr(agent, "choose", self._explained)  # noqa: B010 - of this agent only

    def _explained(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """The agent's choice, and `uses`."""
        agent, asked = self._agent, self._agent._asked
        before = dict(asked)
        decisions = self._choose(q, inputs)
        agents, self.uses = inputs.scene.agents, ()
        if self.asked not in agents:
            return decisions
        here, after = agents.index(self.asked), agent._asked
        pair = [here, (here + 1) % len(agents)][: len(agents)]  # the replacement is the next AV's input
        states = States(*(column[pair] for column in inputs.states))
        plain, found = answer(agent, states)[0], []
        past = agent.observation.frames
        for what in replacements(agent.vfn, past):
            for name, how, arguments in questions(agent.vfn, states, past, what):
                row, action = answer(agent, arguments)[0], decisions[self.asked].action
                if (np.argsort(row) != np.argsort(q[here])).any():  # an equal ranking gives an equal choice
                    agent._asked, other = dict(before), q.copy()
                    other[here] = row
                    action = self._choose(other, inputs)[self.asked].action
                found.append((name, how, int(action), float(np.abs(row - plain).mean())))
        agent._asked, self.uses = after, tuple(found)
        return decisions
