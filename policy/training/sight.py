"""Pretraining of the frame encoder: it predicts quantities known from the simulation from maps alone.

Labels of a perceived frame are the next vehicles on three lanes, the ends of the lanes, the position of the
mission vehicle, and the time to collision of every action. For every frame, predicted frames included, the
kinematic rows give the vehicles ahead and behind in the AV's own frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from cosim.seeding import generator
from cosim.types import IS_MISSION, Bytes, Floats, Floats32, Ints, MetaAction
from policy import checkpoint
from policy.agents.approaches import shipped
from policy.inputs.situation import COMMAND, PER_LANE
from policy.inputs.tensors import KINEMATIC_SCALE, to_numpy, to_planes
from policy.networks.frame_encoder import EncoderConfig, Sight
from policy.networks.seeded import first_weights
from policy.training.loop import Task, one_cycle

DECISION_STRIDE = 3  # decisions between two samples of an episode: consecutive ones are nearly equal
AVS_PER_DECISION = 4  # sampled AVs at each decision
ERROR_LEVEL = "stress"  # of the human drivers in every second episode
LEARNING_RATE, BATCH_SIZE = 1e-3, 128  # Adam, one cycle; frames an update
LANE_WIDTH, HALF_LANE = 3.2, 1.6  # m between centre lines, and from a centre line to its lane's edge
MAX_GAP = 100.0  # m, cap of gaps
ALONG_SCALE, ACROSS_SCALE, SPEED_SCALE = 125.0, 16.0, 15.0  # m, m, m/s: of the mission vehicle
MAX_TTC = 5.0  # s, cap of the time to collision

SIDES = ("left", "own", "right")
BANDS = tuple(
    f"{what} {where}, {side} band"
    for side in SIDES
    for where in ("ahead", "behind")
    for what in ("gap", "speed")
)
MISSION = tuple(f"mission vehicle, {what}" for what in ("presence", "along", "across", "speed"))
LANES = tuple(
    f"{what}, {side} lane"
    for side in SIDES
    for what in ("existence", "dead end", "end", "gap ahead", "speed ahead", "gap behind", "speed behind")
)
ACTIONS = tuple(f"time to collision, {action.name.lower()}" for action in MetaAction)
READINGS = (*BANDS, *MISSION, *LANES, *ACTIONS)
_OF_LANE = (0, 1, 2, *range(PER_LANE - 4, PER_LANE))  # lane inputs of `policy.inputs.situation` in a map


class Seen(NamedTuple):
    """n frames and the labels of their maps."""

    maps: Bytes  # [n,C,H,W]
    readings: Floats32  # [n,READINGS]; nan without a label
    world: Ints  # [n] index of the scenario

    def at(self, rows: Ints | slice) -> "Seen":
        """A selection of the frames."""
        return Seen(self.maps[rows], self.readings[rows], self.world[rows])


@dataclass(frozen=True, slots=True)
class SightTraining:
    """Options and data of the encoder's training."""

    drives: int = 20  # episodes of every scenario and demand
    validation: int = 4  # episodes of each, on validation seeds
    updates: int = 8000


def bands(kinematics: Floats) -> Floats:
    """[n,R,F+1] scaled rows of n frames, the ego in row 0 -> [n,BANDS + MISSION] in the ego's frame.

    Without a mission vehicle its presence is 0 and its position nan.
    """
    rows = kinematics[..., :-1] * KINEMATIC_SCALE
    there = kinematics[..., -1] > 0.5
    ego, others = rows[:, :1], rows[:, 1:]
    known = there[:, 1:] & there[:, :1]
    dx, dy = others[..., 0] - ego[..., 0], others[..., 1] - ego[..., 1]
    c, s = np.cos(ego[..., 3]), np.sin(ego[..., 3])
    x, y, speed = c * dx + s * dy, c * dy - s * dx, others[..., 2] - ego[..., 2]
    out = []
    for side in (1, 0, -1):
        inside = known & (np.abs(y - side * LANE_WIDTH) < HALF_LANE)
        for direction in (1.0, -1.0):
            gap = np.where(inside & (direction * x > 0.0), direction * x, np.inf)
            near = gap.argmin(1)[:, None]
            gaps = np.take_along_axis(gap, near, 1)[:, 0]
            theirs = np.take_along_axis(speed, near, 1)[:, 0]
            out += [np.minimum(gaps, MAX_GAP) / MAX_GAP, np.where(gaps < MAX_GAP, theirs / SPEED_SCALE, 0.0)]
    mission = known & (others[..., IS_MISSION] > 0.5) & (np.abs(x) < ALONG_SCALE) & (np.abs(y) < ACROSS_SCALE)
    which = np.where(mission, np.hypot(x, y), np.inf).argmin(1)[:, None]
    present = mission.any(1)
    place = [
        np.where(present, np.take_along_axis(value, which, 1)[:, 0] / scale, np.nan)
        for value, scale in ((x, ALONG_SCALE), (y, ACROSS_SCALE), (speed, SPEED_SCALE))
    ]
    return np.stack([*out, present.astype(np.float64), *place], 1)


def lanes(situation: Floats32) -> Floats32:
    """[n,SITUATION_INPUTS] -> [n,LANES]: the part that a map shows."""
    each = situation[:, COMMAND : COMMAND + 3 * PER_LANE].reshape(len(situation), 3, PER_LANE)[..., _OF_LANE]
    return np.asarray(each.reshape(len(situation), -1), np.float32)


def seen(
    maps: Bytes, kinematics: Floats32, situation: Floats32, ttc: Floats32, past: int, later: Ints, world: int
) -> Seen:
    """Two frames of each of B AVs: the newest perceived frame and a predicted one.

    Args:
        maps: [B,T,C,H,W], the first `past` frames perceived.
        kinematics: [B,T,R,F+1] scaled.
        situation: [B,SITUATION_INPUTS].
        ttc: [B,A] s, of every action.
        past: N.
        later: [B] index of the predicted frame.
        world: index of the scenario.
    """
    count = len(maps)
    at, rows = np.concatenate([np.full(count, past - 1), later]), np.tile(np.arange(count), 2)
    known = np.concatenate([lanes(situation), np.minimum(ttc, MAX_TTC) / MAX_TTC], 1)
    known = np.concatenate([known, np.full_like(known, np.nan)])
    readings = np.concatenate([bands(kinematics[rows, at]), known], 1)
    return Seen(maps[rows, at], readings.astype(np.float32), np.full(2 * count, world))


def joined(parts: Sequence[Seen]) -> Seen:
    """Concatenated frames."""
    return Seen(*map(np.concatenate, zip(*parts, strict=True)))


class SightTask(Task):
    """Training of encoder and readings by the squared error of known labels.

    Args:
        config: layout of the encoder.
        updates: total number; the learning rate's cycle ends with the last.
        seed: of initial weights and batches.
        train, validation: frames.
        device: of torch.
    """

    network: Sight

    def __init__(
        self,
        config: EncoderConfig,
        updates: int,
        seed: int,
        train: Seen,
        validation: Seen,
        device: str = "cpu",
    ) -> None:
        self._seed, self._train, self._device = seed, train, device
        self.network = first_weights(lambda: Sight(config, len(READINGS)), seed).to(device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        spread = np.ma.masked_invalid(train.readings).std(0).filled(0.0)
        self._weight = torch.from_numpy(1.0 / np.maximum(spread, 0.05) ** 2).to(device, torch.float32)
        adam = torch.optim.Adam(self.network.parameters(), lr=LEARNING_RATE)
        blocks = [validation.at(slice(k, k + 256)) for k in range(0, len(validation.maps), 256)]
        schedule = partial(one_cycle, updates=updates, rate=LEARNING_RATE)
        super().__init__(self.network, adam, schedule, [(b, len(b.maps)) for b in blocks], 1.0)

    def batch(self, number: int) -> Seen:
        """See `Task.batch`."""
        rows = generator(self._seed, "batch", str(number)).integers(len(self._train.maps), size=BATCH_SIZE)
        return self._train.at(rows)

    def losses(self, batch: Seen) -> dict[str, torch.Tensor]:
        """See `Task.losses`; each reading's error is divided by its variance."""
        wanted = torch.from_numpy(batch.readings).to(self._device)
        known = wanted.isfinite()
        error = (
            (read(self.network, batch.maps, self._device) - wanted.nan_to_num()) ** 2 * known * self._weight
        )
        return {"loss": error.sum() / known.sum().clamp_min(1)}


def read(network: Sight, maps: Bytes, device: str = "cpu") -> torch.Tensor:
    """Readings [n,READINGS] of maps [n,C,H,W]."""
    planes = to_planes(torch.from_numpy(maps).to(device))
    out: torch.Tensor = network(planes.contiguous(memory_format=torch.channels_last))
    return out


def read_all(network: Sight, maps: Bytes, device: str = "cpu") -> Floats32:
    """`read` in chunks, as an array."""
    with torch.inference_mode():
        parts = [read(network, maps[k : k + 256], device) for k in range(0, len(maps), 256)]
        return np.concatenate(list(map(to_numpy, parts)))


def save(path: Path, network: Sight, measured: Mapping[str, Any], data: Mapping[str, Any]) -> None:
    """Weights and card of an encoder with its readings."""
    checkpoint.save(path, {"sight": network}, {"sight": _layout(network.encoder.config)}, measured, data)


def load(path: Path, config: EncoderConfig) -> Sight:
    """The encoder that `save` wrote. Raises BadInput, WeightsMismatch."""
    network = Sight(config, len(READINGS))
    checkpoint.load(path, {"sight": network}, {"sight": _layout(config)})
    return network.eval()


def encoder(name: str, config: EncoderConfig) -> dict[str, torch.Tensor]:
    """The state of a shipped encoder or of a file. Raises BadInput, WeightsMismatch."""
    return load(shipped(name) or Path(name), config).encoder.state_dict()


def _layout(config: EncoderConfig) -> dict[str, Any]:
    return {"layout": asdict(config), "readings": list(READINGS)}


def explained(wanted: Floats32, found: Floats32) -> Mapping[str, float]:
    """R2 of every reading that varies in [n,READINGS]."""
    out = {}
    for name, truth, guess in zip(READINGS, wanted.T, found.T, strict=True):
        known = np.isfinite(truth)
        spread = float(np.square(truth[known] - truth[known].mean()).sum()) if known.sum() > 1 else 0.0
        if spread > 1e-3 * known.sum():
            out[name] = 1.0 - float(np.square(truth[known] - guess[known]).sum()) / spread
    return out
