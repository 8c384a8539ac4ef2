"""Networks with their optimiser as named tensors: nothing is ever pickled."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn


def adam_tensors(
    networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer
) -> dict[str, torch.Tensor]:
    """Copies of every weight and of the optimiser's state, on the host."""
    out = {f"{name}.{k}": v for name, network in networks.items() for k, v in network.state_dict().items()}
    for index, slots in optimizer.state_dict()["state"].items():
        out |= {f"adam.{index}.{name}": value for name, value in slots.items()}
    return {name: value.detach().to("cpu").contiguous().clone() for name, value in out.items()}


def restore_adam(
    tensors: Mapping[str, torch.Tensor], networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer
) -> None:
    """The other way round."""
    for name, network in networks.items():
        network.load_state_dict(
            {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
        )
    slots: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("adam."):
            _, index, slot = key.split(".")
            slots.setdefault(int(index), {})[slot] = value
    whole = optimizer.state_dict()
    whole["state"] = slots
    optimizer.load_state_dict(whole)


def usable(device: str) -> bool:
    """Whether torch can put a tensor on `device`."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError):  # AssertionError: torch built without CUDA
        return False
    return True


def use_threads(count: int) -> None:
    """Threads of this process for torch: a learner beside actors wants one each."""
    torch.set_num_threads(count)
