"""Several networks learn from one replay buffer; one is taught their mean.

Networks that begin with the same weights and learn from the same drives err in different places: the mean of
their values drives better than each (docs/training.md). Deciding with all of them costs as often as much; so
a network that begins as they did is taught the mean (distillation of an ensemble).
"""

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from cosim.errors import BadInput
from cosim.seeding import generator, subseed
from policy import checkpoint
from policy.inputs.situation import MEETS
from policy.networks.vfn import PICKED_BY, SETS, VFN, VfnConfig, at_most
from policy.training import experience
from policy.training.curriculum import Specialist, VfnTraining
from policy.training.ddqn import DdqnLearner
from policy.training.experience import Trajectory
from policy.training.learner import Metrics, mean_metrics
from policy.training.replay_buffer import Advised, ReplayBuffer
from policy.training.trainers import make_trainer, rate

RESULT = "distilled.safetensors"
PUPIL = "pupil"
LEAST = 1e-3  # of a cosine or sine that is divided by
DIFFERENCES = 10.0  # what an error in the difference of two actions counts more than one in the state's value


def drives(part: str, trajectory: Trajectory) -> bool:
    """Whether the layers `part` of a network (`SETS`) drive this AV at some time."""
    return bool((trajectory.situation[:, PICKED_BY[part]] > 0.5).any())


def meets_mission(batch: Advised) -> torch.Tensor:
    """[B] bool: the AV's way meets a mission vehicle's (`policy.inputs.situation`)."""
    return batch.now[2][:, MEETS] > 0.5


class Teachers(NamedTuple):
    """Whose values are taught."""

    everywhere: list[VFN]  # their mean
    specialists: list[tuple[Specialist, VFN]]
    most: float = 90.0  # deg (`EnsembleConfig.most`)

    @torch.no_grad()
    def values(self, batch: Advised) -> torch.Tensor:
        """[B,parts,A] for these states."""
        worlds = [label.rpartition("/")[0] for label in batch.episodes]
        phi = batch.now[3]
        asked = at_most(phi, self.most)
        values = torch.stack([network.apart(*batch.now[:3], asked) for network in self.everywhere]).mean(0)
        if values.shape[1] > 1:  # so that they weigh by phi what they are worth by the angle asked with
            own, others = values[:, :1], (values * asked[..., None]).sum(1, keepdim=True)
            same = (asked == phi).all(1)[:, None, None]
            rest = (others - own * phi[:, :1, None]) / phi[:, 1:, None].clamp(min=LEAST)
            values = torch.where(same, values, torch.cat([own, rest], 1))
        for one, network in self.specialists:
            here = torch.tensor([name == one.world for name in worlds], device=values.device)
            if one.met:
                here &= meets_mission(batch)
            if here.any():
                maps, kinematics, situation, phi = batch.now
                maps, phi = None if maps is None else maps[here], phi[here]
                asked = turned(phi, one.turn)
                parts = network.apart(maps, kinematics[here], situation[here], asked)
                if parts.shape[1] > 1:  # so that they weigh by phi what the file's weigh by the other angle
                    parts = parts * (asked.clamp(min=LEAST) / phi.clamp(min=LEAST))[..., None]
                own = values[here] if one.others else parts
                values[here] = torch.cat([own[:, :1], one.weight * parts[:, 1:]], 1)
        return values


def turned(phi: torch.Tensor, turn: tuple[float, float]) -> torch.Tensor:
    """[B,2] cosine and sine of the angle that a specialist is asked with where its pupil drives by `phi`
    [B,2]: 0 for 0, `Specialist.turn`'s second for its first, 90 degrees for 90, linear between."""
    if turn[0] == turn[1]:
        return phi
    wanted, turns = (math.radians(angle) for angle in turn)
    angle, right = torch.atan2(phi[:, 1], phi[:, 0]), 0.5 * math.pi
    beyond = turns + (angle - wanted) * (right - turns) / (right - wanted)
    found = torch.where(angle < wanted, angle * turns / wanted, beyond)
    return torch.stack([found.cos(), found.sin()], 1)


class Ensemble:
    """Learns in `folder`, one network after the other; those that are finished are read again.

    Raises BadInput for drives of other trainings (`EnsembleConfig.runs`) that are missing or of other inputs,
    and where `EnsembleConfig.alone` finds no layers or no drives to learn in and from.

    Args:
        config: the schedule of the training; its part `ensemble` is what is done here.
        vfn: layout of the networks.
        replay: what the training drove.
        folder: of the networks' weights, and of the one that was taught (`RESULT`).
        about: what the cards of the weights say besides.
        device: of torch.
    """

    def __init__(
        self,
        config: VfnTraining,
        vfn: VfnConfig,
        replay: ReplayBuffer,
        folder: Path,
        about: dict[str, Any],
        device: str = "cpu",
    ) -> None:
        c = config.ensemble
        self.config, self.vfn, self.folder = config, vfn, folder
        driven = [one for run in c.runs for one in experience.drives(Path(run))] + list(replay.trajectories)
        if len(shapes := {one.shapes for one in driven}) > 1:
            problem = f"was driven with other inputs: {' and '.join(map(str, shapes))}"
            raise BadInput(problem, field="training.ensemble.runs", value=", ".join(c.runs))
        more = [one for name in c.drives for one in driven if one.episode.rpartition("/")[0] == name]
        if c.alone:
            if not getattr(vfn, SETS[c.alone]):
                problem = f"needs layers of their own for these AVs (vfn.{SETS[c.alone]})"
                raise BadInput(problem, field="training.ensemble.alone", value=c.alone)
            driven, more = ([one for one in some if drives(c.alone, one)] for some in (driven, more))
            if not driven:
                problem = "in no drive is there an AV that these layers drive"
                raise BadInput(problem, field="training.ensemble.alone", value=c.alone)
        for one in c.specialists:
            if vfn.parts == 1 and (one.others or one.weight != 1.0):
                problem = "teaches the others' part, which a network of one part has not (vfn.parts)"
                raise BadInput(problem, field="training.ensemble.specialists", value=one.world)
        kept = [*driven, *more]
        capacity = max(config.replay.capacity, sum(map(len, kept)))  # nothing that was asked for is dropped
        self.replay = ReplayBuffer(replace(config.replay, n_step=c.n_step, capacity=capacity))
        self.replay.add(kept)
        ddqn = replace(config.ddqn, refused=c.refused)
        alone = replace(ddqn, by_copies=True, forked=c.copies, shrink=c.shrink)
        pupil = replace(ddqn, weight_decay=0.0)  # what it is taught is no noise
        learners = [ddqn] * c.networks + [alone] * c.by_copies
        self._ddqn = {PUPIL: pupil, **{str(k): kind for k, kind in enumerate(learners)}}
        self._about, self._device = {**about, "training": asdict(config)}, device

    def run(self, progress: Callable[[float, float], None] | None = None) -> Path:
        """All of it; the file of the network that was taught.

        Raises BadInput when the folder holds an ensemble of another configuration; WeightsMismatch for a
        teacher of another layout.
        """
        c, path = self.config.ensemble, self.folder / RESULT
        networks = c.networks + c.by_copies
        total = networks * c.updates + c.distillation

        def shown(done: int) -> None:
            if progress is not None:
                progress(done, total)

        teachers = [self._read(Path(file)) for file in c.teachers]
        teachers += [self._network(k, shown) for k in range(networks)]
        if not finished(path, self.config):
            pupil = self._learner(PUPIL)
            specialists = [(one, self._read(Path(one.file))) for one in c.specialists]
            taught = Teachers(teachers, specialists, c.most)
            measured = self._taught(pupil, taught, lambda k: shown(networks * c.updates + k))
            checkpoint.save(path, {"vfn": pupil.online}, {"vfn": self.vfn}, measured, self._about)
        shown(total)
        return path

    def _network(self, k: int, shown: Callable[[int], None]) -> VFN:
        """The `k`-th network, learned from the replay buffer or read."""
        c, path = self.config.ensemble, self.folder / f"network-{k}.safetensors"
        if finished(path, self.config):
            return self._read(path)
        learner = self._learner(str(k))
        learner.update_target()
        rng, losses = generator(self.config.seed, "ensemble", str(k)), []
        for update in range(c.updates):
            learner.rate = self._rate(update, c.updates)
            batch = self.replay.sample(rng, self._device)
            losses.append(learner.update(batch, self.replay.compared(rng, self._device)))
            shown(k * c.updates + update)
        measured = mean_metrics(losses[-max(c.updates // 10, 1) :])
        checkpoint.save(path, {"vfn": learner.online}, {"vfn": self.vfn}, measured, self._about)
        return learner.online

    def _taught(self, pupil: DdqnLearner, teachers: Teachers, shown: Callable[[int], None]) -> Metrics:
        """Teach it what their mean says of actions; how well it knows that, over the last tenth of updates.

        What a state is worth stays what the pupil's first weights say: rewards that teachers learned from may
        have been of other sizes, and no choice depends on it.
        """
        c, first = self.config.ensemble, deepcopy(pupil.online)
        rng, known = generator(self.config.seed, "distillation"), []
        for update in range(c.distillation):
            batch = self.replay.advised(rng, True, self._device)
            with torch.no_grad():
                mean = levelled(teachers.values(batch), first.apart(*batch.now), batch.possible)
            mine = pupil.online.apart(*batch.now)
            q = pupil.online.weighed(mine, batch.now[3])
            refused = pupil.refused(q - q.mean(1, keepdim=True), batch.possible)
            pupil.step(lesson(mine, mean, batch.possible) + refused, self._rate(update, c.distillation))
            wanted = pupil.online.weighed(mean, batch.now[3])
            known.append({"refused": float(refused.detach()), **knows(q.detach(), wanted, batch.possible)})
            shown(update)
        return mean_metrics(known[-max(c.distillation // 10, 1) :])

    def _learner(self, name: str) -> DdqnLearner:
        """As the training began, but for the seed of what is drawn; `name`: its number, or `PUPIL`."""
        seed = subseed(self.config.seed, f"ensemble/{name}") % 2**31
        config = replace(self.config, ddqn=self._ddqn[name], seed=seed)
        learner = make_trainer(config, self.vfn, self._device).learner
        assert isinstance(learner, DdqnLearner)
        alone = self.config.ensemble.alone
        if name == PUPIL and alone:
            for part, parameter in learner.online.named_parameters():
                parameter.requires_grad_(parameter.requires_grad and f"{alone}." in part)
        return learner

    def _read(self, path: Path) -> VFN:
        return VFN(self.vfn).like(path).to(self._device)

    def _rate(self, update: int, updates: int) -> float:
        return rate(replace(self.config, iterations=updates), update)


def finished(path: Path, config: VfnTraining) -> bool:
    """Whether these weights of an ensemble are there. Raises BadInput for those of another configuration."""
    if not path.is_file():
        return False
    if checkpoint.read_card(path)["data"]["training"] != checkpoint.plain(config):
        raise BadInput("holds an ensemble of another configuration", file=path)
    return True


def levelled(values: torch.Tensor, like: torch.Tensor, possible: torch.Tensor) -> torch.Tensor:
    """[B,parts,A] `values`, moved to the level of `like` [B,parts,A]; `possible` [B,A] as in `lesson`."""
    return values + _level(like - values, possible)


def lesson(mine: torch.Tensor, mean: torch.Tensor, possible: torch.Tensor) -> torch.Tensor:
    """Loss of a pupil that is to value as its teachers do on average; what is refused it learns elsewhere.

    Args:
        mine: [B,parts,A] its values.
        mean: [B,parts,A] those of its teachers.
        possible: [B,A] bool, actions that are safe.

    Returns:
        The mean squared error of the state values plus `DIFFERENCES` times that of what one action is worth
        more than another, which is what is driven by and much smaller.
    """
    error, level = mine - mean, _level(mine - mean, possible)
    apart = (error - level) * _allowed(possible)[:, None]
    return level.square().mean() + DIFFERENCES * apart.square().mean()


def knows(q: torch.Tensor, wanted: torch.Tensor, possible: torch.Tensor) -> Metrics:
    """How well values [B,A] choose by the values `wanted` [B,A], among what is `possible` [B,A].

    Returns `agrees`, the share of states in which both choose the same, and `lost`, what the choice is worth
    less on average.
    """
    best, choice = (v.masked_fill(~_allowed(possible), -torch.inf).max(1) for v in (wanted, q))
    found = wanted.gather(1, choice.indices[:, None])[:, 0]
    agrees = (choice.indices == best.indices).float().mean()
    return {"agrees": float(agrees), "lost": float((best.values - found).mean())}


def _level(values: torch.Tensor, possible: torch.Tensor) -> torch.Tensor:
    """[B,parts,1] mean of `values` [B,parts,A] over what is `possible` [B,A]."""
    counted = _allowed(possible)[:, None].float()  # [B,1,A]
    return (values * counted).sum(2, keepdim=True) / counted.sum(2, keepdim=True)


def _allowed(possible: torch.Tensor) -> torch.Tensor:
    """Everything, where nothing is safe."""
    return possible | ~possible.any(1, keepdim=True)
