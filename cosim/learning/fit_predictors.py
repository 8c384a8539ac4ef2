"""Fits of the kinematic predictors on recordings, written with their cards."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.learning.bench_predict import forecast
from cosim.learning.prediction_data import recorded_by
from cosim.learning.prediction_scores import Scores, interval_errors
from cosim.recording.folder import Folder
from cosim.recording.views import windows
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS
from cosim.workers.memory import keep_freed_memory
from cosim.workers.progress import Progress
from policy.checkpoint import save
from policy.prediction.gp import GaussianProcessDirect, GaussianProcessIndirect
from policy.prediction.learned import Learned, NetConfig
from policy.prediction.predictors import Predictor
from policy.training.networks import use_threads
from policy.training.predictors import (
    FitConfig,
    GaussianProcess,
    PriorFit,
    Windows,
    examples_for_net,
    factors_for,
    fit,
    fresh_net,
    in_own_frame,
    net_loss,
)

FRAME_STRIDE = 5  # frames between two samples of an episode: 1 s, closer ones are nearly equal
VALIDATION_STRIDE = 10  # frames, on validation episodes
NETWORKS = {
    "lstm-direct": NetConfig("lstm", "direct"),
    "lstm-indirect": NetConfig("lstm", "indirect"),
    "ae-direct": NetConfig("ae", "direct"),
    "ae-indirect": NetConfig("ae", "indirect"),
}
PRIORS: dict[str, GaussianProcess] = {
    "gp-direct": GaussianProcessDirect,
    "gp-indirect": GaussianProcessIndirect,
}
FITTED = (*NETWORKS, *PRIORS)
STEPS = 6000  # of 1024 windows each, for every predictor alike
# the predictor, its networks and their configurations by name, how it was fitted
Fitted = tuple[Predictor, tuple[dict[str, Any], dict[str, Any]], FitConfig]


def fit_predictors(
    training: Path,
    validation: Path,
    out: Path,
    names: Sequence[str] = FITTED,
    steps: int = STEPS,
    state: Path | None = None,
) -> dict[str, dict[str, float]]:
    """Fit `names` on training seeds, calibrate and measure on validation seeds, write into `out`.

    `state`: folder of every fit's log and resumable state. Returns the measured errors.
    Raises BadInput for recordings of other seeds: test seeds are never used for fits.
    """
    keep_freed_memory()
    use_threads(1)
    data = {
        "training": _about(Folder(training), TRAINING_SEEDS),
        "validation": _about(Folder(validation), TUNING_SEEDS),
    }
    learned = _windows(Folder(training))
    checked = _windows(Folder(validation))
    out.mkdir(parents=True, exist_ok=True)
    measured = {}
    for name in names:
        kept = None if state is None else state / name
        fitted = _fit_net if name in NETWORKS else _fit_prior
        with Progress(f"fit {name}", "steps") as progress:
            predictor, parts, config = fitted(name, learned, checked, steps, kept, progress)
        measured[name] = score(predictor, Folder(validation))
        about = {**data, "fit": asdict(config)}
        save(out / f"{name}.safetensors", *parts, measured=measured[name], data=about)
    return measured


def _fit_net(
    name: str, learned: Windows, checked: Windows, steps: int, kept: Path | None, progress: Progress
) -> Fitted:
    config = FitConfig(steps=steps, learning_rate=2e-3)
    network = fresh_net(NETWORKS[name], config.seed)
    examples, checks = examples_for_net(learned), examples_for_net(checked)
    fit(network, partial(net_loss, network), config, examples, checks, folder=kept, progress=progress)
    predictor = Learned(NETWORKS[name], weights=network)
    return predictor, ({"network": network}, {"network": NETWORKS[name]}), config


def _fit_prior(
    name: str, learned: Windows, checked: Windows, steps: int, kept: Path | None, progress: Progress
) -> Fitted:
    config = FitConfig(steps=steps, learning_rate=1e-2)
    prior = PriorFit(PRIORS[name], config.seed)
    examples, checks = prior.examples(learned), prior.examples(checked)
    fit(prior.network, prior.loss, config, examples, checks, folder=kept, progress=progress)
    _calibrate(prior, checked)
    return prior.fitted(), ({"prior": prior.network}, {"prior": prior.network.config}), config


def score(predictor: Predictor, folder: Folder) -> dict[str, float]:
    """Position error in m on a folder of recordings, with equal weight of all scenarios."""
    scores = Scores(predictor.horizon, predictor.dt)
    for recording in folder.recordings():
        w = windows(recording, every=VALIDATION_STRIDE)
        scores.add(recording.case, w.future, {predictor.name: forecast(predictor, w.past)})
    rows = [r for r in scores.position_table() if r["scenario"] == "all" and r["behavior"] == "all"]
    return {f"position_error_{r['horizon_s']}": round(r["mean_m"], 4) for r in rows}


def _calibrate(prior: PriorFit, checked: Windows) -> None:
    """Set the prior's calibration: factors with which its intervals cover 90 % of the validation episodes.

    One calibration per number of known frames, on the same moments with earlier frames hidden.
    """
    predictor, factors = prior.fitted(), []
    for known in range(1, checked.past.shape[1] + 1):
        past = checked.past.copy()
        past[:, :-known] = np.nan
        predicted = forecast(predictor, past)
        errors = interval_errors(predicted, checked.future)
        used = [q for q, std in enumerate(predicted.std) if std.any()]
        stds = tuple(predicted.std[q] for q in used)
        factors.append(factors_for(stds, tuple(errors[q] for q in used), checked.weight))
    prior.calibrate(np.stack(factors))


def _windows(folder: Folder) -> Windows:
    """The moments of all recordings, with equal total weight of all scenarios."""
    parts = [(r.case["scenario"], windows(r, every=FRAME_STRIDE)) for r in folder.recordings()]
    scenario = np.concatenate([np.full(len(w.lane), name) for name, w in parts])
    _, group, count = np.unique(scenario, return_inverse=True, return_counts=True)
    return in_own_frame(
        np.concatenate([w.past for _, w in parts]),
        np.concatenate([w.future for _, w in parts]),
        1.0 / count[group],
    )


def _about(folder: Folder, allowed: range) -> dict[str, Any]:
    """The description of the data for the card. Raises BadInput for a seed outside of `allowed`."""
    found = folder.manifest()
    seeds = found["seeds"]
    if not all(seed in allowed for seed in seeds):
        raise BadInput(
            f"seeds must lie in {allowed.start}..{allowed.stop - 1}",
            file=folder.manifest_file,
            field="seeds",
            value=seeds,
        )
    episodes = found.get("episodes", {})
    digest = hashlib.sha256(json.dumps(episodes, sort_keys=True).encode()).hexdigest()
    return {
        "seeds": [min(seeds), max(seeds)],
        "episodes": len(episodes),
        "sha256": digest,
        "commands": recorded_by(found),
    }
