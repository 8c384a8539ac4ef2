"""Trains the HPN's map branch as P does: from true histories, the next block of maps and kinematics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from cosim.seeding import generator, subseed
from policy.map_branch import MapBranch, MapBranchConfig
from policy.seeded import seeded
from policy.tensors import kinematic_tensor, unit
from policy.training.loop import one_cycle
from policy.training.moments import MapSample
from policy.training.networks import adam_tensors, restore_adam


@dataclass(frozen=True, slots=True)
class MapTraining:
    """How it is trained."""

    batch: int = 16  # AVs
    rate: float = 5e-4  # P, Table I
    weight: float = 1.0  # of an occupied pixel against an empty one; P: 1, the plain mean squared error
    kinematics: float = 0.1  # weight of the K branch's own error
    seed: int = 0


class MapTask:
    """`policy.training.loop.Task` of the plain map branch."""

    def __init__(
        self,
        config: MapBranchConfig,
        training: MapTraining,
        updates: int,
        train: Sequence[MapSample],
        validation: Sequence[MapSample],
        device: str = "cpu",
    ) -> None:
        self._training, self._train, self._validation, self._device = training, train, validation, device
        self.updates = updates
        seed = subseed(training.seed, "network") % 2**31
        self.network = seeded(lambda: MapBranch(config), seed).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=training.rate)

    def update(self, number: int) -> dict[str, float]:
        """See `Task.update`."""
        t = self._training
        chosen = generator(t.seed, "batch", str(number)).integers(len(self._train), size=t.batch)
        found = self._losses([self._train[k] for k in chosen])
        self._optimizer.zero_grad(set_to_none=True)
        found["loss"].backward()  # type: ignore[no-untyped-call]
        for group in self._optimizer.param_groups:
            group["lr"] = one_cycle(number, self.updates, t.rate)
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        return {name: float(value.detach()) for name, value in found.items()}

    def validate(self) -> dict[str, float]:
        """See `Task.validate`."""
        sums: dict[str, float] = {}
        size = 32
        blocks = [self._validation[k : k + size] for k in range(0, len(self._validation), size)]
        with torch.no_grad():
            for block in blocks:
                for name, value in self._losses(block).items():
                    sums[name] = sums.get(name, 0.0) + float(value) * len(block) / len(self._validation)
        return sums

    def tensors(self) -> dict[str, torch.Tensor]:
        """See `Task.tensors`."""
        return adam_tensors({"network": self.network}, self._optimizer)

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """See `Task.restore`."""
        restore_adam(tensors, {"network": self.network}, self._optimizer)

    def _losses(self, samples: Sequence[MapSample]) -> dict[str, torch.Tensor]:
        c, t = self.network.config, self._training
        seen = np.stack([s.unpacked()[: c.frames + c.block] for s in samples])
        maps = unit(torch.from_numpy(seen).to(self._device))
        past = (
            maps[:, c.frames - c.seen : c.frames].flatten(1, 2).contiguous(memory_format=torch.channels_last)
        )
        wanted = maps[:, c.frames :].flatten(1, 2)
        moved = kinematic_tensor(
            np.stack([s.kinematics for s in samples]), np.stack([s.valid for s in samples]), self._device
        )[:, -c.seen :]
        after = kinematic_tensor(
            np.stack([s.next_kinematics[: c.block] for s in samples]),
            np.stack([s.next_valid[: c.block] for s in samples]),
            self._device,
        )
        guess, rows = self.network([past], moved)
        square = (guess - wanted) ** 2
        weight = 1.0 + (t.weight - 1.0) * (wanted > 0.05)
        known = after[..., -1:]
        kinematics = ((rows - after[..., :4]) ** 2 * known).sum() / (4 * known.sum()).clamp_min(1)
        error = (square * weight).mean()
        return {"loss": error + t.kinematics * kinematics, "maps": square.mean(), "kinematics": kinematics}
