"""A `vfn` from the drives of a `vfn-p`: the same updates and teachers, but it never sees a predicted map.

    python -m benchmarks.without_prediction RUN [--first FILE] [--out RUN/without_prediction]

RUN is the folder of `cosim train vfn --policy vfn-p` whose configuration has an ensemble. Its networks and
the one that is taught learn once more from the same drives, with the same seeds; wherever they are shown
predicted maps, they are shown the present instead. What teaches them sees the predictions, so that all that a
present tells of them can be learned. A first layer whose predicted frames all show the present is one without
predicted frames and another weight for the present: so it is written, with the layout of `vfn`. It begins
with the weights that RUN began with, or with FILE, a `vfn`.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import nn

from cosim.learning.configuration import configuration
from cosim.workers.progress import Progress
from policy import checkpoint
from policy.networks.vfn import VFN, VfnConfig
from policy.training import experience
from policy.training.config import agent_config
from policy.training.curriculum import VfnTraining
from policy.training.ddqn import DdqnLearner
from policy.training.ensemble import RESULT as TAUGHT
from policy.training.ensemble import Ensemble
from policy.training.networks import use_threads
from policy.training.replay_buffer import ReplayBuffer

RESULT = "vfn.safetensors"


class Unforeseen(Ensemble):
    """Whoever learns is shown the present in place of what is predicted."""

    first: VFN | None = None  # whose weights all begin with, in place of the configuration's

    def _network(self, k: int, shown: Callable[[int], None]) -> VFN:
        return shown_the_present(super()._network(k, shown), self._past)

    def _learner(self, name: str) -> DdqnLearner:
        learner = super()._learner(name)
        for network in (learner.online, learner.target):
            if self.first is not None:
                network.load_state_dict(self.first.state_dict())
            shown_the_present(network, self._past)
        return learner

    @property
    def _past(self) -> int:
        return self.replay.trajectories[0].past


def shown_the_present(network: VFN, past: int) -> VFN:
    """The same network; of latents [B,T,L] all after the `past` ones become the last of these."""

    def present(_: nn.Module, inputs: tuple[torch.Tensor]) -> tuple[torch.Tensor]:
        latents = inputs[0].clone()
        latents[:, past:] = latents[:, past - 1 : past]
        return (latents,)

    network.maps.register_forward_pre_hook(present)
    return network


def without_predicted_frames(network: VFN, past: int) -> tuple[VFN, VfnConfig]:
    """The network of `past` frames that values every state as `network` does when it is shown the present."""
    config = replace(network.config, frames=past)
    tensors = network.state_dict()
    for name in (name for name in tensors if name.endswith("hidden.weight")):
        weight = tensors[name].unflatten(1, (network.config.frames, config.latent))
        kept = weight[:, :past].clone()
        kept[:, -1] += weight[:, past:].sum(1)
        tensors[name] = kept.flatten(1)
    own = VFN(config)
    own.load_state_dict(tensors)
    return own, config


def with_predicted_frames(network: VFN, config: VfnConfig) -> VFN:
    """The network of layout `config` that values every state as `network` does, whatever is predicted."""
    tensors = network.state_dict()
    for name in (name for name in tensors if name.endswith("hidden.weight")):
        more = (config.frames - network.config.frames) * config.latent
        tensors[name] = nn.functional.pad(tensors[name], (0, more))
    made = VFN(config)
    made.load_state_dict(tensors)
    return made


def driven(run: Path, training: VfnTraining) -> ReplayBuffer:
    """What the training drove, and holds."""
    replay = ReplayBuffer(training.replay)
    replay.add(experience.drives(run))
    return replay


def learn(run: Path, out: Path, first: Path | None = None) -> Path:
    """The file of the `vfn`. Raises BadInput as `Ensemble.run` does, WeightsMismatch for another layout."""
    file = configuration(str(run / "config.yaml")).file
    agent, own = agent_config("vfn-p", file), agent_config("vfn", file)
    card = checkpoint.read_card(run / "ensemble" / TAUGHT)
    training = replace(file.training, seed=card["data"]["training"]["seed"])
    about = {**card["data"], "policy": "vfn", "learned_from": "drives of vfn-p"}
    out.mkdir(parents=True, exist_ok=True)
    replay = driven(run, training)
    ensemble = Unforeseen(training, agent.vfn, replay, out, about)
    if first is not None:
        ensemble.first = with_predicted_frames(VFN(own.vfn).like(first), agent.vfn)
        about["training"] = {**about["training"], "first": str(first)}
    with Progress("vfn", "updates") as progress:
        taught = ensemble.run(progress)
    pupil = VFN(agent.vfn)
    measured = checkpoint.load(taught, {"vfn": pupil}, {"vfn": agent.vfn})["measured"]
    network, config = without_predicted_frames(pupil, replay.trajectories[0].past)
    assert config == own.vfn
    checkpoint.save(out / RESULT, {"vfn": network}, {"vfn": config}, measured, about)
    return out / RESULT


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a training of vfn-p")
    parser.add_argument("--first", type=Path, metavar="FILE", help="a vfn to begin with")
    parser.add_argument("--out", type=Path, help="default: RUN/without_prediction")
    args = parser.parse_args()
    if not (args.run / "ensemble" / TAUGHT).is_file():
        parser.error(
            f"argument run: {args.run} holds no training with a finished ensemble (ensemble/{TAUGHT})"
        )
    use_threads(1)
    print(learn(args.run, args.out or args.run / "without_prediction", args.first))


if __name__ == "__main__":
    main()
