"""`altruist`: yields as `yield-rule` does, with habits that a search on full roads has found."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import nn

from policy import checkpoint
from policy.agents.yield_rule import HABITS, Habits, YieldRule

NAME = "altruist"


class Altruist(YieldRule):
    """Yields to whoever needs it, on any road; no vehicle is marked.

    Args:
        habits: how it yields.
        files: the weights that hold the habits.
    """

    name = NAME

    def __init__(self, habits: Habits = HABITS, files: tuple[Path, ...] = ()) -> None:
        self.habits, self.files = habits, files


@dataclass(frozen=True, slots=True)
class Layout:
    """The order of the values in the weights."""

    names: tuple[str, ...] = tuple(field.name for field in fields(Habits))


class _Values(nn.Module):
    """The habits as a tensor [10]."""

    def __init__(self, habits: Habits = HABITS) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor(astuple(habits), dtype=torch.float64), requires_grad=False)


def save(weights: Path, habits: Habits, measured: Mapping[str, Any], data: Mapping[str, Any]) -> None:
    """Write the habits and their card; `measured`, `data`: of the card (`policy.checkpoint.save`)."""
    about = {"policy": NAME, **data}
    checkpoint.save(weights, {"habits": _Values(habits)}, {"habits": Layout()}, measured, about)


def read(weights: Path) -> Altruist:
    """The agent with the habits in these weights. Raises BadInput, WeightsMismatch."""
    values = _Values()
    checkpoint.load(weights, {"habits": values}, {"habits": Layout()})
    return Altruist(Habits(*values.values.tolist()), (weights,))
