"""Which inputs a value network uses: it is asked again with one input replaced (a counterfactual).

Nothing here changes how the agent drives. Where an encoder makes latents of maps, latents are replaced: each
is of one frame, so that another frame's latent is what another frame's map becomes.
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
BLIND = "map branch", "its last layer zero"
ORACLE = "prediction", "the fair oracle's"  # in closed loop alone: an agent of its own
ANGLES = (0, 90)  # degrees that replace phi: the egoist's, and the other end


Arguments = tuple[torch.Tensor | None, torch.Tensor, torch.Tensor, torch.Tensor]  # of VFN.forward
# Over the decisions of single AVs: how many; those whose action changes, carried out (after the prioritizer)
# and best valued; absolute difference of the action values, mean of the five; best value less the second best
SUMS = ("decisions", "choices_changed", "unmasked_changed", "mean_abs_dq", "spread")


def questions(
    network: VFN, states: States, past: int, only: tuple[str, str] | None = None
) -> Iterator[tuple[str, str, Arguments]]:
    """Every replacement of every input, or `only` one: (input, replacement, what the network is asked with).

    Args:
        network: who is asked.
        states: what B AVs that decide together see; the first `past` frames of maps and kinematics have been
            perceived, the others are predicted.

    Zeroed; as at present: the newest perceived frame in place of every other one; another AV's of the same
    instant: that of the next row, where there are at least two. Without maps the layer that reads the
    convolutions' output is as if its weights were zero (`VFN.forward`).
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
    if only in (None, BLIND):
        yield *BLIND, (None, *states[1:])
    for angle in ANGLES:
        if only not in (None, ("phi", f"{angle} degrees")):
            continue
        phi = svo_tensor(math.radians(angle), len(states.phi))
        yield "phi", f"{angle} degrees", states._replace(phi=phi)


def network_inputs(network: VFN) -> tuple[str, ...]:
    """Which of `States` it takes, phi apart."""
    kinematics = ("kinematics",) if network.kinematics is not None else ()
    return ("maps", *kinematics, *(("situation",) if network.config.kinematic else ()))


def answer(agent: PredictionAware, arguments: Arguments) -> Floats32:
    """The action values [B,A] that the agent's network gives."""
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=agent.config.bf16):
        return to_numpy(agent.vfn(*arguments))


def replacements(network: VFN, past: int) -> list[tuple[str, str]]:
    """The (input, replacement) with which episodes are driven: what is left when an input tells nothing.

    Another AV's of the same instant is an input as the network knows them; zeros are none. Predictions are
    also replaced by the present.
    """
    found, predicts = [], network.config.frames > past
    for field in network_inputs(network):
        whole = field if field == "situation" or not predicts else f"all {field}"
        found.append((whole, OTHERS))
        if whole != field:
            found += [(f"predicted {field}", how) for how in (OTHERS, PRESENT)]
    return [*found, BLIND, ("phi", f"{ANGLES[0]} degrees")]


class _Encoding(PredictionAware):
    """Perceives latents in place of maps where its network has an encoder."""

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """As the agent's."""
        return self.encoded(super().perceive(histories))


class Replaced(_Encoding):
    """Drives by what its network answers with one input replaced; `what` None: by the network as it is."""

    def __init__(self, name: str, config: AgentConfig, what: tuple[str, str] | None) -> None:
        super().__init__(name, config)
        self._what = what

    def values(self, inputs: Inputs) -> Floats32:
        """The action values [B,A]; an AV that decides alone has no other's input and keeps its own."""
        if self._what is not None:
            for _, _, arguments in questions(self.vfn, inputs.states, self.observation.frames, self._what):
                return answer(self, arguments)
        return super().values(inputs)


class Questioned(_Encoding):
    """Drives as the agent does; `answers` holds the episode's SUMS by input and replacement."""

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self.answers: dict[tuple[str, str], Floats] = {}

    def choose(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """As the agent's, after the questions."""
        states, plain = inputs.states, answer(self, inputs.states)
        chosen, ordered = self._actions(plain, inputs), np.sort(plain, 1)
        for name, how, arguments in questions(self.vfn, states, self.observation.frames):
            other = answer(self, arguments)
            same = np.array_equal(other, plain)  # spares the prioritizer
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
        """[B] what these values lead to; the lane changes that were commanded stay as they are."""
        kept, self._asked = self._asked, dict(self._asked)
        decisions = super().choose(q, inputs)
        self._asked = kept
        return np.array([decision.action for decision in decisions.values()], np.int64)


class Explainer:
    """Asks an agent, of one AV at each of its decisions, which inputs the choice hangs on.

    The agent drives as before. `uses`: [input, replacement, the action that it leads to, mean absolute
    difference of the five action values] of every question of `replacements`, () where nothing was asked.
    """

    def __init__(self, agent: PredictionAware) -> None:
        self.asked: str | None = None  # the AV
        self.uses: tuple[tuple[str, str, int, float], ...] = ()
        self._agent, self._choose = agent, agent.choose
        setattr(agent, "choose", self._explained)  # noqa: B010 - of this one agent

    def _explained(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """The agent's choice, and `uses`."""
        agent, asked = self._agent, self._agent._asked
        before = dict(asked)
        decisions = self._choose(q, inputs)
        agents, self.uses = inputs.scene.agents, ()
        if self.asked not in agents:
            return decisions
        here, after = agents.index(self.asked), agent._asked
        pair = [here, (here + 1) % len(agents)][: len(agents)]  # another AV's inputs are the next one's
        states = States(*(column[pair] for column in inputs.states))
        plain, found = answer(agent, states)[0], []
        past = agent.observation.frames
        for what in replacements(agent.vfn, past):
            for name, how, arguments in questions(agent.vfn, states, past, what):
                row, action = answer(agent, arguments)[0], decisions[self.asked].action
                if (np.argsort(row) != np.argsort(q[here])).any():  # else the prioritizer says the same
                    agent._asked, other = dict(before), q.copy()
                    other[here] = row
                    action = self._choose(other, inputs)[self.asked].action
                found.append((name, how, int(action), float(np.abs(row - plain).mean())))
        agent._asked, self.uses = after, tuple(found)
        return decisions
