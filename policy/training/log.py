"""TensorBoard for every trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def tensorboard(folder: Path) -> Any:
    """A writer of scalars into `folder`/tensorboard."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder / "tensorboard"))
