"""Recordings as the predictor's data: decisions with the true future maps and states."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.errors import CosimError
from cosim.recording.file import Recording, read
from cosim.recording.folder import Folder
from cosim.recording.views import histories
from cosim.road import RoadMap
from cosim.types import COMPACT, Bytes, History, ObservationConfig, Snapshot
from cosim.workers.engines import Engine
from cosim.workers.progress import shown
from cosim.workers.tasks import Task

HORIZON = 20  # frames, 4 s
MAPLESS = replace(COMPACT, maps=False)


class Followed(NamedTuple):
    """One decision of a recorded episode and its true future."""

    frame: int
    histories: dict[str, History]
    future: list[Snapshot]  # the next HORIZON frames
    maps: dict[str, Bytes]  # [HORIZON,C,H,W] uint8 of every AV that stays on the road; empty without maps


def followed(
    recording: Recording, road: RoadMap, observation: ObservationConfig, stride: int, first: int = 0
) -> Iterator[Followed]:
    """Every `stride`th decision, from number `first` on, with a recorded future over the whole horizon.

    Decisions without an observing AV are left out. Histories are copies and may be kept.
    """
    snapshots = recording.snapshots()
    waiting: list[tuple[int, dict[str, History]]] = []
    pictures: dict[int, dict[str, Bytes]] = {}
    for number, (frame, seen) in enumerate(histories(recording, road, observation)):
        if observation.maps:
            # decisions are every other frame; the history has the map of the frame in between
            for back in (1, 0):
                pictures[frame - back] = {a: h.velocity_map[-1 - back].copy() for a, h in seen.items()}
        if number % stride == first % stride and frame + HORIZON < len(snapshots) and seen:
            kept = {a: h._replace(velocity_map=h.velocity_map.copy()) for a, h in seen.items()}
            waiting.append((frame, kept))
        while waiting and waiting[0][0] + HORIZON <= frame:
            then, known = waiting.pop(0)
            frames = range(then + 1, then + 1 + HORIZON)
            maps = {
                a: np.stack([pictures[k][a] for k in frames])
                for a in known
                if observation.maps and all(a in pictures.get(k, {}) for k in frames)
            }
            for k in [k for k in pictures if k <= then]:
                del pictures[k]
            yield Followed(then, known, snapshots[then + 1 : then + 1 + HORIZON], maps)


def episodes(folders: list[Path]) -> list[tuple[Path, str]]:
    """(folder, key) of every recorded episode. Raises BadInput for a folder that holds none."""
    return [(path, key) for path in folders if Folder(path).manifest() for key in Folder(path).episodes()]


def recorded_by(manifest: Mapping[str, Any]) -> list[str]:
    """The commands that recorded a folder's episodes, without their output folders."""
    commands = set()
    for command in manifest["commands"]:
        words = [w for k, w in enumerate(command) if "--out" not in (w, *command[max(k - 1, 0) : k])]
        commands.add("cosim record " + shlex.join(w for w in words if w != "--resume"))
    return sorted(commands)


class EpisodeReader:
    """Runs in a worker and reads recorded episodes."""

    def __init__(self) -> None:
        self._folders: dict[str, Folder] = {}

    def read(self, path: str, key: str) -> tuple[Recording, RoadMap]:
        """The episode `key` of the folder `path`, and its road."""
        folder = self._folders.setdefault(path, Folder(Path(path)))
        recording = read(folder.episode_file(key))
        return recording, folder.road(recording)

    def close(self) -> None:
        """Nothing to close."""


def spread(engine: Engine, tasks: Sequence[Task], title: str) -> list[Any]:
    """The result of each task, in the order of the tasks. Raises CosimError for the first failure."""
    found: dict[str, Any] = {}
    for outcome in shown(engine.run(tasks), len(tasks), title, "episodes"):
        if not outcome.ok:
            raise CosimError(f"{outcome.key}: {outcome.error}")
        found[outcome.key] = outcome.value
    return [found[task.key] for task in tasks]
