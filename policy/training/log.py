"""TensorBoard for every trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def tensorboard(folder: Path, begin: int | None = None) -> Any:
    """A writer of scalars into `folder`/tensorboard; what it holds from step `begin` on is superseded."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder / "tensorboard"), purge_step=begin)
