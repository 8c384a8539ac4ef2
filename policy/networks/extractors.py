"""Feature extractors of map stacks: T's Conv3D (Table 1), an encoder per frame, or Conv2D over all frames."""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from cosim.types import Bytes, Floats32
from policy.inputs.tensors import PLANES, to_numpy, to_planes, unit
from policy.networks.frame_encoder import EncoderConfig, FrameEncoder

Strides = Literal["literal", "temporal"]
Read = Callable[[torch.Tensor], torch.Tensor]  # maps [B,C,H,W] -> input channels of the convolution, float32

# T gives no strides: two readings. `literal` has no padding, `temporal` halves time too.
STRIDES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "literal": ((1, 4, 4), (1, 2, 2), (1, 1, 1)),
    "temporal": ((1, 4, 4), (2, 2, 2), (2, 2, 2)),
}
KERNELS = ((1, 8, 8), (3, 4, 4), (3, 3, 3))  # T, Table 1


class Conv3dMaps(nn.Module):
    """Conv3D 32@(1,8,8), 64@(3,4,4), 64@(3,3,3): maps [B,T,C,H,W] as `read` takes them -> [B,flat]."""

    def __init__(
        self,
        frames: int,
        channels: int,
        height: int,
        width: int,
        features: tuple[int, int, int],
        strides: Strides,
        read: Read = unit,
    ) -> None:
        super().__init__()
        self.read = read
        shape: tuple[int, ...] = (frames, height, width)
        widths = (channels, *features)
        layers: list[nn.Conv3d] = []
        for k, (stride, wanted) in enumerate(zip(STRIDES[strides], KERNELS, strict=True)):
            padding = tuple((n - 1) // 2 if strides == "temporal" else 0 for n in wanted)
            # at small map sizes a kernel must not exceed its (padded) input
            kernel = tuple(min(n, s + 2 * p) for n, s, p in zip(wanted, shape, padding, strict=True))
            layers.append(nn.Conv3d(widths[k], widths[k + 1], kernel, stride, padding))  # type: ignore[arg-type]
            shape = tuple(
                (s + 2 * p - n) // d + 1 for s, p, n, d in zip(shape, padding, kernel, stride, strict=True)
            )
        self.per_frame, self.second, self.third = layers
        self.flat = features[2] * shape[0] * shape[1] * shape[2]

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Features [B,flat]. Fastest with the weights in channels_last_3d."""
        b, t = maps.shape[:2]
        z = self.frames(maps.flatten(0, 1))
        return self.stacked(z.view(b, t, *z.shape[1:]))

    def frames(self, maps: torch.Tensor) -> torch.Tensor:
        """Features of single frames: [n,C,H,W] -> [n,F,h,w], channels last."""
        # a (1,8,8) kernel is a 2D convolution of every frame; on a CPU the forward pass is faster with
        # contiguous planes, the gradient of the kernel with channels last
        first = self.per_frame
        inner = torch.channels_last if torch.is_grad_enabled() else torch.contiguous_format
        kernel = first.weight[:, :, 0].contiguous(memory_format=inner)
        planes = self.read(maps).contiguous(memory_format=inner)
        z = functional.conv2d(planes, kernel, first.bias, first.stride[1:], first.padding[1:])
        return functional.relu_(z).contiguous(memory_format=torch.channels_last)

    def stacked(self, frames: torch.Tensor) -> torch.Tensor:
        """The later layers: features of frames [B,T,F,h,w] -> [B,flat]."""
        # frames in channels last are channels_last_3d in memory: no copy
        z = frames.transpose(1, 2).contiguous(memory_format=torch.channels_last_3d)  # [B,F,T,h,w]
        z = functional.relu_(self.second(z))
        z = functional.relu_(self.third(z))
        return z.flatten(1)


class EncodedMaps(nn.Module):
    """The last `frames` frames, each through a frozen, pretrained encoder: maps -> latents.

    `maps` may be latents [B,T,L] from an earlier decision, so frames are encoded once.
    """

    def __init__(self, frames: int, config: EncoderConfig) -> None:
        super().__init__()
        self.encoder = FrameEncoder(config).requires_grad_(False)
        self.count, self.flat = frames, frames * config.latent

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Maps [B,T,C,H,W] as bytes, or latents [B,T,L], -> [B,flat]."""
        seen = maps[:, -self.count :]
        if maps.dim() == 3:
            return seen.flatten(1).to(torch.float32)
        return self.frames(seen.flatten(0, 1)).view(len(maps), -1)

    @property
    def blank(self) -> torch.Tensor:
        """The latent [L] of an empty map."""
        c = self.encoder.config
        latent: torch.Tensor = self.encoder(torch.zeros(1, PLANES, c.height, c.width))[0]
        return latent

    def frames(self, maps: torch.Tensor) -> torch.Tensor:
        """Latents of single frames: [n,C,H,W] -> [n,L,1,1]."""
        latents: torch.Tensor = self.encoder(to_planes(maps).contiguous(memory_format=torch.channels_last))
        return latents[..., None, None]

    def stacked(self, frames: torch.Tensor) -> torch.Tensor:
        """[B,T,L,1,1] -> [B,flat]."""
        return frames[:, -self.count :].flatten(1)


FRAMES_PER_BATCH = 256  # limits memory: all AVs of a city at once take a gigabyte


class FrameMemory:
    """A cache of map features: every frame is convolved once, bit-identical to convolving all each time.

    A past map is drawn in the ego's frame at its own time, so it never changes. `fresh` frames later it
    has moved `fresh` places to the front of the `past` frames.
    """

    def __init__(self, extractor: Conv3dMaps | EncodedMaps, past: int, fresh: int) -> None:
        self._extractor, self._past, self._aged = extractor, past, max(past - fresh, 0)
        self._row: dict[str, int] = {}  # AV -> its row in:
        self._maps: Bytes = np.empty((0, past, 0), np.uint8)  # [B,T,C,H,W]
        self._features: Floats32 = np.empty((0, past, 0), np.float32)  # [B,T,h,w,F]

    def frames(self, names: Sequence[str], maps: torch.Tensor) -> torch.Tensor:
        """maps [B,T,C,H,W] uint8 of the AVs `names`, past frames first -> their features [B,T,F,h,w]."""
        old, n = self._aged, self._past
        pictures = maps.numpy()  # numpy compares and joins bytes ten times faster
        count, frames = pictures.shape[:2]
        kept = np.zeros((count, frames), np.bool_)  # frames present at the last decision
        for mine, name, known in zip(pictures, names, kept, strict=True):
            row = self._row.get(name)
            known[:old] = row is not None and np.array_equal(self._maps[row, n - old : n], mine[:old])
        new = ~kept
        many = int(new.sum()) // FRAMES_PER_BATCH + 1  # equal parts: very small parts change bits
        parts = torch.from_numpy(pictures[new]).tensor_split(many)
        made = to_numpy(torch.cat([self._extractor.frames(part) for part in parts]).permute(0, 2, 3, 1))
        features: Floats32 = np.empty((count, frames, *made.shape[1:]), np.float32)
        features[new] = made
        before = [self._row[name] for name, known in zip(names, kept[:, 0], strict=True) if known]
        features[kept] = self._features[before, n - old : n].reshape(-1, *made.shape[1:])
        self._row = {name: b for b, name in enumerate(names)}
        self._maps, self._features = pictures, features
        return torch.from_numpy(features).permute(0, 1, 4, 2, 3)  # channels last


class Conv2dMaps(nn.Module):
    """The frames as channels of one picture: T's kernels without time (paper_map.md, Approaches)."""

    def __init__(
        self,
        frames: int,
        channels: int,
        height: int,
        width: int,
        features: tuple[int, int, int],
        read: Read = unit,
    ) -> None:
        super().__init__()
        self.read = read
        widths, size = (frames * channels, *features), (height, width)
        layers: list[nn.Module] = []
        for k, (kernel, stride) in enumerate(((8, 4), (4, 2), (3, 2))):
            layers += [nn.Conv2d(widths[k], widths[k + 1], kernel, stride, (kernel - 1) // 2), nn.ReLU()]
            size = tuple((n + 2 * ((kernel - 1) // 2) - kernel) // stride + 1 for n in size)  # type: ignore[assignment]
        self.layers = nn.Sequential(*layers)
        self.flat = features[2] * size[0] * size[1]

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """[B,T,C,H,W] -> [B,flat]."""
        b, t = maps.shape[:2]
        seen = self.read(maps.flatten(0, 1))
        picture = seen.reshape(b, t * seen.shape[1], *seen.shape[2:])
        out: torch.Tensor = self.layers(picture).flatten(1)
        return out
