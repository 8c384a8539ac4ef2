"""Networks with their optimiser: steps, and a state of named tensors (without pickle)."""

from collections.abc import Mapping

import torch
from torch import nn


class Optimized:
    """Networks and their optimiser; `tensors` and `restore` save and load both.

    Args:
        networks: name -> module; the names are prefixes in the saved state.
        optimizer: of the parameters that are trained.
        clip: largest norm of the gradient; None: unlimited.
    """

    def __init__(
        self, networks: dict[str, nn.Module], optimizer: torch.optim.Optimizer, clip: float | None
    ) -> None:
        self._networks, self._optimizer, self._clip = networks, optimizer, clip

    def step(self, loss: torch.Tensor, rate: float | None = None) -> None:
        """One step down `loss` (none when it depends on no parameter), at learning rate `rate` if given."""
        if not loss.requires_grad:
            return
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        for group in self._optimizer.param_groups:
            group["lr"] = group["lr"] if rate is None else rate
            if self._clip is not None:
                nn.utils.clip_grad_norm_(group["params"], self._clip)
        self._optimizer.step()

    def tensors(self) -> dict[str, torch.Tensor]:
        """Copies of every weight and of the optimiser's state, on the host."""
        out = {f"{name}.{k}": v for name, net in self._networks.items() for k, v in net.state_dict().items()}
        for index, slots in self._optimizer.state_dict()["state"].items():
            out |= {f"adam.{index}.{name}": value for name, value in slots.items()}
        return {name: value.detach().to("cpu").contiguous().clone() for name, value in out.items()}

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Restore the state returned by `tensors`."""
        for name, network in self._networks.items():
            network.load_state_dict(
                {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
            )
        slots: dict[int, dict[str, torch.Tensor]] = {}
        for key in (key for key in tensors if key.startswith("adam.")):
            _, index, slot = key.split(".")
            slots.setdefault(int(index), {})[slot] = tensors[key]
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": slots})


def usable(device: str) -> bool:
    """Whether torch can allocate a tensor on `device`."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError):  # AssertionError: torch built without CUDA
        return False
    return True


def use_threads(count: int) -> None:
    """Set torch's threads in this process: a learner beside actors should use one each."""
    torch.set_num_threads(count)
