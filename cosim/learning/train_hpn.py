"""Training of the hybrid predictive network from recordings: `cosim train hpn`."""

import argparse
import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from cosim.files import working_in
from cosim.learning.announcement import announce, curves
from cosim.learning.configuration import configuration
from cosim.learning.prediction_data import MAPLESS, EpisodeReader, episodes, followed, recorded_by, spread
from cosim.recording.folder import Folder, seed_of
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS
from cosim.types import COMPACT
from cosim.workers.engines import LocalEngine
from cosim.workers.memory import keep_freed_memory
from cosim.workers.progress import Progress
from cosim.workers.tasks import Task
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig
from policy.training import hpn
from policy.training import loop as supervised
from policy.training.moments import MapSample, Moment, map_sample, moment
from policy.training.networks import use_threads


def train(args: argparse.Namespace) -> int:
    """`cosim train hpn`. Raises BadInput for invalid input before any computation."""
    file = configuration(args.config).file
    name, training, seed = args.variant, file.prediction, args.seed or 0
    if not args.recordings or not args.validation:
        raise BadInput(
            "recordings to train and to validate on are needed", field="--recordings, --validation"
        )
    found = {
        "train": _checked(args.recordings, TRAINING_SEEDS, "--recordings"),
        "validation": _checked(args.validation, TUNING_SEEDS, "--validation"),
    }
    variant = hpn.VARIANTS[name]
    loop = training.loop(variant)
    announce(
        f"train {name}: {loop.updates:,} updates on {len(found['train']):,} recorded episodes",
        {
            "learning begins": "when the recordings are read",
            "curves": curves(shlex.quote(args.out), "log.csv"),
            "validation": f"every {loop.validate_every:,} updates on {len(found['validation']):,} episodes",
        },
    )
    with working_in(args.out) as folder:
        keep_freed_memory()
        use_threads(args.threads)
        data = {part: _manifest(keys) for part, keys in found.items()}
        examples = {part: _gather(keys, name, training, args.workers, part) for part, keys in found.items()}
        task = hpn.make_task(variant, training, seed, examples["train"], examples["validation"], args.device)
        layout = {"hpn": asdict(variant), "training": asdict(training), "seed": seed, "data": data}
        with Progress(f"train {name}", "updates") as progress:
            log = supervised.train(task, loop, folder, layout=layout, resume=args.resume, progress=progress)
        file_name = folder / f"{name}.safetensors"
        supervised.write_log(file_name.with_suffix(".csv"), log)
        hpn.save(
            file_name, name, hpn.assemble(name, task), log[-1], {**data, "commands": _commands(args, found)}
        )
        print(f"{name}: {loop.updates} updates, validation loss {log[-1]['validation_loss']:.4f}")
        print(f"  {file_name}")
        return 0


def _commands(args: argparse.Namespace, found: Mapping[str, Sequence[tuple[Path, str]]]) -> dict[str, Any]:
    """The commands that reproduce the training, for the card: of the training and its recordings."""
    seed = "" if args.seed is None else f" --seed {args.seed}"
    recorders = {
        f"{part} recordings": [
            command
            for path in sorted({path for path, _ in keys})
            for command in recorded_by(Folder(path).manifest())
        ]
        for part, keys in found.items()
    }
    return {
        "train": f"cosim train hpn --variant {args.variant} --config {Path(args.config).name}{seed}",
        **recorders,
    }


class Gatherer(EpisodeReader):
    """Runs in a worker: turns recorded episodes into examples."""

    def __init__(self, variant: str, training: hpn.HpnTraining) -> None:
        super().__init__()
        self._variant, self._training = hpn.VARIANTS[variant], training
        self._predictor = make_predictor("gp-indirect", 20, 0.2)

    def run(self, path: str, key: str, progress: object = None) -> list[Moment] | list[MapSample]:
        """All examples of one episode."""
        recording, road = self.read(path, key)
        seed, t = int(recording.case["seed"]), self._training
        if self._variant.maps == "plain":
            return [
                map_sample(at.histories[name], at.maps[name], at.future)
                for at in followed(recording, road, COMPACT, t.map_stride, seed)
                for name in sorted(at.maps)[seed % 2 :: 4]  # every fourth AV: AVs share most vehicles
            ]
        seen = self._variant.kinematic.history
        return [
            moment(at.histories, at.future, road, self._predictor, TrafficConfig(), seen)
            for at in followed(recording, road, MAPLESS, t.stride, seed)
        ]


def _gather(
    keys: Sequence[tuple[Path, str]], variant: str, training: hpn.HpnTraining, workers: int, part: str
) -> list[Any]:
    """Examples of every episode, in the order of the keys."""
    tasks = [Task(f"{path} {key}", str(path), (str(path), key)) for path, key in keys]
    found = spread(LocalEngine(Gatherer, (variant, training), workers=workers), tasks, f"read {part}")
    flat = [example for examples in found for example in examples]
    if not flat:
        raise BadInput("no episode is long enough to learn from", field="--recordings")
    return flat


def _checked(paths: Sequence[str], seeds: range, field: str) -> list[tuple[Path, str]]:
    found = episodes([Path(p) for p in paths])
    if not found:
        raise BadInput("holds no episodes", field=field, value=", ".join(paths))
    wrong = sorted({s for _, key in found if (s := seed_of(key)) not in seeds})
    if wrong:
        raise BadInput(
            f"seeds {seeds.start} to {seeds.stop - 1} are needed, not {wrong[0]} (cosim record --seeds)",
            field=field,
            value=", ".join(paths),
        )
    return found


def _manifest(keys: Sequence[tuple[Path, str]]) -> dict[str, Any]:
    """A short description of the data for a card: recording commands, amount and hash."""
    names = sorted(key for _, key in keys)
    seeds = [seed_of(name) for name in names]
    folders = [Folder(path).manifest() for path in sorted({path for path, _ in keys})]
    return {
        "episodes": len(names),
        "seeds": [min(seeds), max(seeds)],
        "keys_sha256": hashlib.sha256(json.dumps(names).encode()).hexdigest(),
        "cells": sum(len(found.get("cells", {})) for found in folders),
    }
