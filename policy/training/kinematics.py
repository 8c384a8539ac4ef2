"""Training of the HPN's kinematic branch on recorded episodes: position in the picture, and confidence.

Maps are drawn from the corrected kinematics, so the relevant error is a vehicle's position in the picture of
a moving AV. The loss is taken over pairs (AV, vehicle), in the AV's own predicted frame, for all frames of
the horizon at once. It saturates without overlap of the boxes: an error of ten metres is as wrong as twenty.
An error of half a car's length is already worse than no drawing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from cosim.types import Bools, Floats32
from policy.networks.kinematic_branch import KinematicBranch, KinematicConfig, confidence, correct
from policy.networks.seeded import first_weights
from policy.training.loop import Task, drawn, one_cycle
from policy.training.moments import Moment

HALF_LENGTH, HALF_WIDTH = 2.5, 1.0  # m, half a car: an error of that size loses half of the box
PICTURE_WINDOW = (128.0, 16.0)  # m, vehicles outside of both pictures have weight 0
PAIR_REACH = (160.0, 30.0)  # m, present; beyond it one vehicle in 150 enters the window within the horizon


@dataclass(frozen=True, slots=True)
class KinematicTraining:
    """Options of the training, chosen on validation seeds."""

    batch: int = 16  # moments per update: about 600 vehicles
    rate: float = 2e-3  # AdamW, one cycle
    decay: float = 1e-3
    clip: float = 1.0  # norm of the gradient
    far: float = 0.3  # weight of the unsaturated part, for a gradient far from the truth
    alone: float = 0.3  # weight of each vehicle's own position error, beside that in the pictures
    speed: float = 0.1  # per 3 m/s
    heading: float = 0.2  # per rad
    early: float = 0.15  # share of the horizon: frames weigh 1 / (early + t), so that early frames count
    seed: int = 0


class Batch(NamedTuple):
    """Concatenated moments, and the pairs among them."""

    own: torch.Tensor
    near: torch.Tensor
    lane: torch.Tensor
    gp: torch.Tensor
    truth: torch.Tensor
    looking: torch.Tensor  # [P] the AV of each pair
    seen: torch.Tensor  # [P] the vehicle


def collate(moments: Sequence[Moment], device: str = "cpu") -> Batch:
    """One batch; unknown vehicles are left out."""
    first = 0
    looking, seen = [], []
    for m in moments:
        place = first + np.cumsum(m.known) - 1
        egos, all_ = m.ego[m.known[m.ego]], np.flatnonzero(m.known)
        near = _near(m.lane[egos, 0], m.lane[all_, 0]) & (egos[:, None] != all_)
        ego, other = np.nonzero(near)
        looking.append(place[egos[ego]])
        seen.append(place[all_[other]])
        first += int(m.known.sum())

    names = ("own", "near", "lane", "gp", "truth")
    vehicles = [np.concatenate([getattr(m, name)[m.known] for m in moments]) for name in names]
    pairs = [np.concatenate(looking), np.concatenate(seen)]
    return Batch(*(torch.from_numpy(array).to(device) for array in vehicles + pairs))


def _near(egos: Floats32, others: Floats32) -> Bools:
    """[E,V] whether vehicle V is within PAIR_REACH of AV E; states [.,4] x y speed heading."""
    dx, dy = (others[None, :, k] - egos[:, None, k] for k in (0, 1))
    c, s = np.cos(egos[:, 3:4]), np.sin(egos[:, 3:4])
    found: Bools = (np.abs(c * dx + s * dy) < PAIR_REACH[0]) & (np.abs(c * dy - s * dx) < PAIR_REACH[1])
    return found


def losses(raw: torch.Tensor, batch: Batch, c: KinematicTraining) -> dict[str, torch.Tensor]:
    """The loss and its parts; raw [V,M,OUTPUTS] as the branch gives it."""
    guess = correct(raw, batch.lane, batch.gp)
    t = torch.linspace(0.0, 1.0, raw.shape[1] + 1, device=raw.device)[1:]
    frames = 1.0 / (c.early + t)  # [M]
    there = torch.isfinite(batch.truth).all(-1)  # [V,M]
    truth = torch.where(there[..., None], batch.truth, guess.detach())
    along, across = _turned(guess[..., :2] - truth[..., :2], truth[..., 3])
    alone = _mean(_misplaced(along, across, c.far), there * frames)
    speed = _mean((guess[..., 2] - truth[..., 2]).abs() / 3.0, there * frames)
    heading = _mean((guess[..., 3] - truth[..., 3]).abs().clamp_max(1.0), there * frames)
    e, v = batch.looking, batch.seen
    mine = _seen_from(guess[v], guess[e])  # [P,M,2] ahead, left
    real = _seen_from(truth[v], truth[e])
    shown = _inside(mine.detach()) | _inside(real)
    along, across = _turned(mine - real, truth[v][..., 3] - truth[e][..., 3])
    both = (shown & there[v] & there[e]) * frames
    picture = _mean(_misplaced(along, across, c.far), both)
    share = (1 - along.abs() / (2 * HALF_LENGTH)).clamp_min(0) * (
        1 - across.abs() / (2 * HALF_WIDTH)
    ).clamp_min(0)
    share = torch.where(there[v], share.detach(), 0.0)
    sure = confidence(raw[v][..., 5], raw[e][..., 6])
    doubt = _mean((sure - share) ** 2, (shown & there[e]) * frames)
    total = picture + c.alone * alone + c.speed * speed + c.heading * heading + doubt
    missed = _mean(1.0 - share, both)
    return {"loss": total, "picture": picture, "alone": alone, "sureness": doubt, "missed": missed}


def _turned(d: torch.Tensor, heading: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    c, s = torch.cos(heading), torch.sin(heading)
    return c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]


def _seen_from(states: torch.Tensor, ego: torch.Tensor) -> torch.Tensor:
    return torch.stack(_turned(states[..., :2] - ego[..., :2], ego[..., 3]), -1)


def _inside(place: torch.Tensor) -> torch.Tensor:
    return (place[..., 0].abs() < PICTURE_WINDOW[0]) & (place[..., 1].abs() < PICTURE_WINDOW[1])


def _misplaced(along: torch.Tensor, across: torch.Tensor, far: float) -> torch.Tensor:
    square = (along / HALF_LENGTH) ** 2 + (across / HALF_WIDTH) ** 2
    return 1.0 - torch.exp(-0.5 * square) + far * (torch.sqrt(1.0 + square) - 1.0)


def _mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1e-9)


class KinematicTask(Task):
    """Training of the kinematic branch.

    Args:
        config: layout of the branch.
        training: batch size, learning rate, weights of the losses, seed.
        updates: total number; the learning rate's cycle ends with the last.
        train, validation: examples (`policy.training.moments.moment`).
        device: of torch.
    """

    def __init__(
        self,
        config: KinematicConfig,
        training: KinematicTraining,
        updates: int,
        train: Sequence[Moment],
        validation: Sequence[Moment],
        device: str = "cpu",
    ) -> None:
        self._training, self._train, self._device = training, train, device
        self.network = first_weights(lambda: KinematicBranch(config), training.seed).to(device)
        adam = torch.optim.AdamW(self.network.parameters(), lr=training.rate, weight_decay=training.decay)
        blocks = [(collate(validation[k : k + 64], device), 1) for k in range(0, len(validation), 64)]
        schedule = partial(one_cycle, updates=updates, rate=training.rate)
        super().__init__(self.network, adam, schedule, blocks, training.clip)

    def batch(self, number: int) -> Batch:
        """See `Task.batch`."""
        t = self._training
        return collate(drawn(self._train, t.batch, t.seed, number), self._device)

    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        """See `Task.losses`."""
        return losses(self.network(batch.own, batch.near), batch, self._training)
