"""Which inputs a value network uses: it is asked again with one input replaced (a counterfactual).

Nothing here changes how the agent drives: the plain network is asked on whole maps, without its memory.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch

from cosim.types import Decision, Floats, Floats32, Ints, PolicyContext
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States, svo_tensor, to_numpy

ANGLES = (0, 90)  # degrees that replace phi: the egoist's, and the other end


Arguments = tuple[torch.Tensor | None, torch.Tensor, torch.Tensor, torch.Tensor]  # of VFN.forward
# Over the decisions of single AVs: how many; those whose action changes, carried out (after the prioritizer)
# and best valued; absolute difference of the action values, mean of the five; best value less the second best
SUMS = ("decisions", "choices_changed", "unmasked_changed", "mean_abs_dq", "spread")


def questions(states: States, past: int, kinematics: bool) -> Iterator[tuple[str, str, Arguments]]:
    """Every replacement of every input: (input, replacement, what the network is asked with).

    Args:
        states: what B AVs that decide together see; the first `past` frames of maps and kinematics have been
            perceived, the others are predicted.
        kinematics: whether the network takes kinematics and situation at all.

    Zeroed; as at present: the newest perceived frame in place of every other one; another AV's of the same
    instant: that of the next row, where there are at least two. Without maps the layer that reads the
    convolutions' output is as if its weights were zero (`VFN.forward`).
    """
    spans = {"past ": slice(past), "predicted ": slice(past, None), "all ": slice(None)}
    for field in ("maps", "kinematics", "situation") if kinematics else ("maps",):
        whole: torch.Tensor = getattr(states, field)
        ways = {"zeroed": torch.zeros_like(whole)}
        if field != "situation":
            ways["as at present"] = whole[:, past - 1 : past].expand_as(whole)
        if len(whole) > 1:
            ways["another AV's"] = whole.roll(1, 0)
        predicts = field != "situation" and whole.shape[1] > past
        for span, part in spans.items() if predicts else (("", slice(None)),):
            for how, other in ways.items():
                changed = whole.clone()
                changed[:, part] = other[:, part]
                yield span + field, how, states._replace(**{field: changed})
    yield "map branch", "its last layer zero", (None, *states[1:])
    for angle in ANGLES:
        phi = svo_tensor(math.radians(angle), len(states.phi))
        yield "phi", f"{angle} degrees", states._replace(phi=phi)


def answer(agent: PredictionAware, arguments: Arguments) -> Floats32:
    """The action values [B,A] that the agent's network gives."""
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=agent.config.bf16):
        return to_numpy(agent.vfn(*arguments))


class Questioned(PredictionAware):
    """Drives as the agent does; `answers` holds the episode's SUMS by input and replacement."""

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self.answers: dict[tuple[str, str], Floats] = {}

    def choose(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """As the agent's, after the questions."""
        states, plain = inputs.states, answer(self, inputs.states)
        chosen, ordered = self._actions(plain, inputs), np.sort(plain, 1)
        for name, how, arguments in questions(
            states, self.observation.frames, self.vfn.kinematics is not None
        ):
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
