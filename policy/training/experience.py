"""One AV's trajectory of one episode in the replay buffer: every frame is stored once."""

import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch

from cosim.files import whole
from cosim.types import Bools, Bytes, Floats32
from policy.inputs.tensors import States

Ending = Literal["crashed", "left", "cut"]  # cut: the episode ended with the AV on the road
Halves = npt.NDArray[np.float16]


@dataclass(frozen=True)
class Trajectory:
    """D decisions of one AV and the D + 1 states around them.

    The past frames of state t are `frames[t * stride : t * stride + N]`: consecutive histories share all
    but `stride` frames. Only the last state of a `crashed` trajectory is terminal.
    """

    episode: str  # scenario, demand and seed
    av: str
    stride: int  # frames per decision
    # maps [.,C,H,W], pixel * 255; with an encoder their latents [.,L]
    frames: Bytes | Halves  # [N + D * stride, ...]
    ahead: Bytes | Halves  # [D+1, M, ...] of predicted maps
    kinematics: Halves  # [D+1, T,R,F+1] scaled (policy.inputs.tensors)
    situation: Floats32  # [D+1, .]
    unsafe: Bools  # [D+1, A] actions masked by the prioritizer
    action: npt.NDArray[np.int8]  # [D] carried out
    vetoed: npt.NDArray[np.int8]  # [D] preferred action if masked, else -1
    terms: Floats32  # [D,3] reward terms: ego, AVs, HVs (equation 6)
    interacting: Bools  # [D] near a mission vehicle, or vetoed: sampled more often
    phi: float  # rad, the SVO of the episode
    ending: Ending

    def __len__(self) -> int:
        return len(self.action)

    @property
    def past(self) -> int:
        """N, the past frames of a state."""
        return int(self.frames.shape[0] - len(self) * self.stride)

    def maps(self, t: int) -> list[Bytes | Halves]:
        """The map groups of state `t`: past [N,...] and predicted [M,...] frames."""
        start = t * self.stride
        return [self.frames[start : start + self.past], self.ahead[t]]


def states(chosen: list[tuple[Trajectory, int]], phi: Floats32, device: str = "cpu") -> States:
    """Stack states for the network.

    Args:
        chosen: B pairs (trajectory, t).
        phi: [B] rad, the SVO.
        device: of torch.
    """
    first = chosen[0][0]
    past, ahead = first.past, first.ahead.shape[1]
    maps = np.empty((len(chosen), past + ahead, *first.frames.shape[1:]), first.frames.dtype)
    for row, (trajectory, t) in zip(maps, chosen, strict=True):
        row[:past], row[past:] = trajectory.maps(t)
    arrays = (
        maps,
        np.stack([trajectory.kinematics[t] for trajectory, t in chosen]).astype(np.float32),
        np.stack([trajectory.situation[t] for trajectory, t in chosen]),
        np.stack([np.cos(phi), np.sin(phi)], 1).astype(np.float32),
    )
    return States(*(torch.from_numpy(array).to(device) for array in arrays))


def save(path: Path, trajectories: list[Trajectory]) -> None:
    """Write trajectories atomically to one compressed .npz, without pickled objects."""
    arrays = {f"{k}.{name}": value for k, one in enumerate(trajectories) for name, value in vars(one).items()}
    # mostly zeros: level 1 suffices
    deflated = partial(zipfile.ZipFile, compression=zipfile.ZIP_DEFLATED, compresslevel=1)
    with whole(path) as draft, deflated(draft, "w") as file:
        for name, value in {"count": len(trajectories), **arrays}.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as part:
                np.lib.format.write_array(part, np.asarray(value), allow_pickle=False)


def load(path: Path) -> list[Trajectory]:
    """The trajectories that `save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return [
            Trajectory(
                **{
                    name: value if (value := file[f"{k}.{name}"]).ndim else value.item()
                    for name in Trajectory.__dataclass_fields__
                }
            )
            for k in range(int(file["count"]))
        ]
