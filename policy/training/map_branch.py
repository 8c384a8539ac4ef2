"""Training of the HPN's map branch after P: from true histories to the next block of maps and kinematics."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from policy.inputs.tensors import kinematic_tensor, unit
from policy.networks.map_branch import MapBranch, MapBranchConfig
from policy.networks.seeded import first_weights
from policy.training.loop import Task, drawn, one_cycle
from policy.training.moments import MapSample


@dataclass(frozen=True, slots=True)
class MapTraining:
    """Options of the training."""

    batch: int = 16  # AVs
    rate: float = 5e-4  # P, Table I
    weight: float = 1.0  # of an occupied pixel against an empty one; P: 1, the plain mean squared error
    kinematics: float = 0.1  # weight of the K branch's own error
    seed: int = 0


class MapTask(Task):
    """Training of the plain map branch.

    Args:
        config: layout of the branch.
        training: batch size, learning rate, weights of the losses, seed.
        updates: total number; the learning rate's cycle ends with the last.
        train, validation: examples (`policy.training.moments.map_sample`).
        device: of torch.
    """

    def __init__(
        self,
        config: MapBranchConfig,
        training: MapTraining,
        updates: int,
        train: Sequence[MapSample],
        validation: Sequence[MapSample],
        device: str = "cpu",
    ) -> None:
        self._training, self._train, self._device = training, train, device
        self.network = first_weights(lambda: MapBranch(config), training.seed).to(device)
        adam = torch.optim.Adam(self.network.parameters(), lr=training.rate)
        blocks = [validation[k : k + 32] for k in range(0, len(validation), 32)]
        schedule = partial(one_cycle, updates=updates, rate=training.rate)
        super().__init__(self.network, adam, schedule, [(block, len(block)) for block in blocks], 1.0)

    def batch(self, number: int) -> Sequence[MapSample]:
        """See `Task.batch`."""
        t = self._training
        return drawn(self._train, t.batch, t.seed, number)

    def losses(self, batch: Sequence[MapSample]) -> dict[str, torch.Tensor]:
        """See `Task.losses`."""
        c, t = self.network.config, self._training
        seen = np.stack([s.unpacked()[: c.frames + c.block] for s in batch])
        maps = unit(torch.from_numpy(seen).to(self._device))
        past = (
            maps[:, c.frames - c.seen : c.frames].flatten(1, 2).contiguous(memory_format=torch.channels_last)
        )
        wanted = maps[:, c.frames :].flatten(1, 2)
        moved = kinematic_tensor(
            np.stack([s.kinematics for s in batch]), np.stack([s.valid for s in batch]), self._device
        )[:, -c.seen :]
        after = kinematic_tensor(
            np.stack([s.next_kinematics[: c.block] for s in batch]),
            np.stack([s.next_valid[: c.block] for s in batch]),
            self._device,
        )
        guess, rows = self.network(past, moved)
        square = (guess - wanted) ** 2
        weight = 1.0 + (t.weight - 1.0) * (wanted > 0.05)
        known = after[..., -1:]
        kinematics = ((rows - after[..., :4]) ** 2 * known).sum() / (4 * known.sum()).clamp_min(1)
        error = (square * weight).mean()
        return {"loss": error + t.kinematics * kinematics, "maps": square.mean(), "kinematics": kinematics}
