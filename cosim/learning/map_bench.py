"""The map half of `cosim bench predict`: PRE and IoU of every map predictor on recorded episodes."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.errors import BadInput
from cosim.learning.prediction_data import EpisodeReader, followed, spread
from cosim.recording.file import read
from cosim.recording.folder import Folder, fits
from cosim.report import statistics
from cosim.types import COMPACT, Floats
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Task
from policy.chain.map_error import HORIZONS, MapPredictors, frame_of, picture_error, vehicle_channels
from policy.checkpoint import SHIPPED
from policy.networks.hpn import HPN
from policy.prediction.predictors import make_predictor
from policy.training import hpn as trained
from policy.training.networks import use_threads

FORECAST = "gp-raster"  # maps of the uncorrected kinematic forecast
STRIDE = 10  # decisions, 4 s: closer ones show nearly the same traffic


class EpisodeErrors(NamedTuple):
    """Means over one episode's samples (an AV at a decision each)."""

    scenario: str
    behavior: str
    samples: int
    pre: dict[str, Floats]  # predictor -> [H] at HORIZONS
    iou: dict[str, Floats]


def hpn_weights() -> dict[str, Path]:
    """The shipped HPNs by name, without missing files."""
    found = {name: SHIPPED / f"{name}.safetensors" for name in trained.VARIANTS}
    return {name: path for name, path in found.items() if path.is_file()}


class MapMeter(EpisodeReader):
    """Runs in a worker: predicts maps on recorded episodes and compares them with the true maps."""

    def __init__(self, weights: Mapping[str, str], stride: int) -> None:
        super().__init__()
        use_threads(1)
        self._hpns = load_hpns({name: Path(path) for name, path in weights.items()})
        self._stride = stride
        self._predictor = make_predictor("gp-indirect", 20, 0.2)
        self._predictors: dict[str, MapPredictors] = {}  # by road

    def run(self, path: str, key: str, progress: Any = None) -> EpisodeErrors | None:
        """One episode; None when it is too short."""
        recording, road = self.read(path, key)
        case, name = recording.case, str(recording.case["road"])
        if name not in self._predictors:
            self._predictors[name] = MapPredictors(self._hpns, self._predictor, COMPACT, road)
        channels, at = vehicle_channels(COMPACT), [frame_of(h) for h in HORIZONS]
        errors: dict[str, list[tuple[Floats, Floats]]] = defaultdict(list)
        for now in followed(recording, road, COMPACT, self._stride, int(case["seed"])):
            if not now.maps:
                continue
            guess = self._predictors[name].predict(now.histories)
            if progress is not None:
                progress(now.frame, len(recording.times))
            for b, av in ((b, av) for b, av in enumerate(guess.agents) if av in now.maps):
                for predictor, maps in guess.maps.items():
                    errors[predictor].append(picture_error(maps[b, at], now.maps[av][at], channels))
        if not errors:
            return None
        means = {predictor: np.mean(each, 0) for predictor, each in errors.items()}  # [2,H]
        return EpisodeErrors(
            str(case["scenario"]),
            str(case["behavior"]),
            len(next(iter(errors.values()))),
            {predictor: pre for predictor, (pre, _) in means.items()},
            {predictor: iou for predictor, (_, iou) in means.items()},
        )


def load_hpns(weights: Mapping[str, Path]) -> dict[str, HPN]:
    """Trained HPNs. Raises BadInput, WeightsMismatch."""
    return {name: trained.load(path)[1] for name, path in weights.items()}


def measure(
    folder: Path,
    *,
    weights: Mapping[str, Path] | None = None,
    scenarios: Sequence[str] = (),
    behaviors: Sequence[str] = (),
    seeds: range | None = None,
    stride: int = STRIDE,
    workers: int = 1,
) -> list[EpisodeErrors]:
    """Measure every episode of a folder of recordings. Raises BadInput without usable episodes."""
    source = Folder(folder)
    keys = [
        key
        for key in source.episodes(seeds)
        if fits(read(source.episode_file(key)).case, scenarios, behaviors)
    ]
    chosen = hpn_weights() if weights is None else weights
    engine = LocalEngine(MapMeter, ({k: str(p) for k, p in chosen.items()}, stride), workers=workers)
    tasks = [Task(k, "", (str(folder), k)) for k in keys]
    measured = [episode for episode in (spread(engine, tasks, "maps") if keys else []) if episode is not None]
    if not measured:
        raise BadInput("no recorded episode is long enough to measure maps on", file=folder)
    return measured


def rows(episodes: Sequence[EpisodeErrors]) -> list[dict[str, Any]]:
    """The table: a row per predictor, scenario (and `all`) and horizon; intervals over episodes."""
    pixels = len(vehicle_channels(COMPACT)) * COMPACT.height * COMPACT.width
    out = []
    for world, here in _by_world(episodes):
        for predictor in here[0].pre:
            for k, horizon in enumerate(HORIZONS):
                pre = statistics.mean([float(e.pre[predictor][k]) for e in here])
                iou = statistics.mean([float(e.iou[predictor][k]) for e in here])
                out.append(
                    {
                        "predictor": predictor,
                        "scenario": world,
                        "horizon_s": horizon,
                        "pre": pre.value,
                        "pre_low": pre.low,
                        "pre_high": pre.high,
                        "pre_sum": pre.value * pixels,
                        "iou": iou.value,
                        "iou_low": iou.low,
                        "iou_high": iou.high,
                        "n": sum(e.samples for e in here),
                        "episodes": len(here),
                    }
                )
    return out


def _by_world(episodes: Sequence[EpisodeErrors]) -> Iterator[tuple[str, list[EpisodeErrors]]]:
    """The episodes of each scenario, then all."""
    for world in (*sorted({e.scenario for e in episodes}), "all"):
        yield world, [e for e in episodes if world in ("all", e.scenario)]


def against(episodes: Sequence[EpisodeErrors], ours: str = "hpn") -> list[dict[str, Any]]:
    """Relative difference of `ours` to every other predictor, on the same episodes and over HORIZONS.

    With PRE below 0 and IoU above 0 `ours` is better; `everywhere`: at every horizon in the mean.
    """
    out: list[dict[str, Any]] = []
    for world, here in _by_world(episodes):
        for other in (name for name in here[0].pre if name != ours and ours in here[0].pre):
            row: dict[str, Any] = {"scenario": world, "against": other, "everywhere": True}
            for name, sign in (("pre", -1.0), ("iou", 1.0)):
                mine, theirs = (
                    np.stack([getattr(e, name)[predictor] for e in here]) for predictor in (ours, other)
                )  # [E,H]
                figure = statistics.paired_change(theirs.mean(1), mine.mean(1))
                row |= {
                    f"{name}_change": figure.value,
                    f"{name}_low": figure.low,
                    f"{name}_high": figure.high,
                }
                row["everywhere"] &= bool((sign * (mine - theirs).mean(0) > 0.0).all())
            out.append(row)
    return out


def markdown(table: Sequence[Mapping[str, Any]], compared: Sequence[Mapping[str, Any]] = ()) -> str:
    """The tables in Markdown: the HPN's gain over the others, and PRE and IoU over all scenarios."""
    total = [row for row in table if row["scenario"] == "all"]
    lines = ["# Predicted maps", ""]
    if compared:
        lines += [*_verdict(compared), ""]
        lines += ["| scenario | against | PRE | IoU | better at every horizon |", "|---|---|---|---|---|"]
        lines += [_gain(row) for row in compared if row["scenario"] == "all" or row["against"] == FORECAST]
    head = " | ".join(f"{h:g} s" for h in HORIZONS)
    for name, title, scale, digits in (("pre", "PRE, 1e-5 per pixel", 1e5, 1), ("iou", "IoU", 1.0, 3)):
        lines += ["", f"## {title}, all scenarios", "", f"| predictor | {head} |"]
        lines += ["|" + "---|" * (1 + len(HORIZONS))]
        for predictor in dict.fromkeys(row["predictor"] for row in total):
            cells = [f"{scale * r[name]:.{digits}f}" for r in total if r["predictor"] == predictor]
            lines.append(f"| {predictor} | {' | '.join(cells)} |")
    lines += [
        "",
        "## Conditions",
        "",
        f"{total[0]['episodes']} episodes, {total[0]['n']:,} samples (an AV at a decision, one in {STRIDE}).",
        "PRE is the mean squared error per pixel of the vehicle channels, IoU the overlap of occupied",
        "pixels. Intervals are 95 % over episodes.",
    ]
    return "\n".join(lines) + "\n"


def _verdict(compared: Sequence[Mapping[str, Any]]) -> list[str]:
    """Whether the HPN's maps are better than the maps of the kinematic forecast."""
    overall = {row["against"]: row for row in compared if row["scenario"] == "all"}
    row = overall.get(FORECAST)
    if row is None:
        return ["Change by the HPN, mean over the horizons:"]
    better = row["pre_high"] < 0.0 < row["iou_low"]
    change = statistics.Figure(row["pre_change"], row["pre_low"], row["pre_high"]).text(1, 100.0)
    answer = "**Yes.**" if better else "**Unresolved.**"
    return [
        f"Are the maps of the HPN better than maps drawn from the kinematic forecast (`{FORECAST}`)?",
        f"{answer} The squared error changes by {change} %.",
    ]


def _gain(row: Mapping[str, Any]) -> str:
    pre, iou = (
        statistics.Figure(row[f"{name}_change"], row[f"{name}_low"], row[f"{name}_high"]).text(1, 100.0)
        for name in ("pre", "iou")
    )
    better = "yes" if row["everywhere"] else "no"
    return f"| {row['scenario']} | {row['against']} | {pre} % | {iou} % | {better} |"
