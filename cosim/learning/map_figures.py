"""Figures of the map predictors: training curves, error over the horizon, chains and inner features."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from cosim.errors import BadInput
from cosim.learning.map_bench import load_hpns
from cosim.learning.picture import save
from cosim.learning.prediction_data import Followed, followed
from cosim.recording.file import read
from cosim.recording.folder import Folder
from cosim.road import RoadMap
from cosim.types import COMPACT, Bytes, Floats32
from policy.chain.inner_features import feature_pictures
from policy.chain.map_error import MapPredictors, frame_of, unit_maps, vehicle_channels
from policy.prediction.predictors import make_predictor

SHOWN_HORIZONS = (0.2, 1.0, 2.0, 3.0, 4.0)  # s, columns of a chain's picture
STYLE = {"hpn": "-", "hpn-no-history": "--", "hpn-plain": ":", "last-frame": "-.", "gp-raster": "-"}


def training(logs: Mapping[str, Path], out: Path) -> None:
    """P's figure 6: training and validation loss with and without history, side by side on one scale."""
    names = [n for n in ("hpn", "hpn-no-history", "hpn-plain") if n in logs]
    figure = Figure(figsize=(4.2 * len(names), 3.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(names)))
    for axis, name in zip(axes, names, strict=True):
        with logs[name].open(newline="") as file:
            lines = list(csv.DictReader(file))
        for part, label in (("train_loss", "training"), ("validation_loss", "validation")):
            points = [(float(r["update"]), float(r[part])) for r in lines if r.get(part)]
            axis.plot(*zip(*points, strict=True), label=label)
        axis.set(title=name, xlabel="updates", ylabel="loss")
        axis.legend()
    pair = [a for a, n in zip(axes, names, strict=True) if n != "hpn-plain"]
    low, high = (f(a.get_ylim()[k] for a in pair) for k, f in ((0, min), (1, max)))
    for axis in pair:
        axis.set_ylim(low, high)
    save(figure, out)


def errors(table: Sequence[Mapping[str, Any]], out: Path) -> None:
    """PRE and IoU over the horizon, a column per scenario (the data of P's figure 8)."""
    worlds = list(dict.fromkeys(r["scenario"] for r in table))
    figure = Figure(figsize=(2.7 * len(worlds), 5.2), layout="constrained")
    axes = figure.subplots(2, len(worlds), squeeze=False, sharex=True)
    for column, world in enumerate(worlds):
        for predictor in dict.fromkeys(r["predictor"] for r in table):
            mine = [r for r in table if (r["scenario"], r["predictor"]) == (world, predictor)]
            for line, (name, scale) in enumerate((("pre", 1e3), ("iou", 1.0))):
                x, y = [r["horizon_s"] for r in mine], [scale * r[name] for r in mine]
                low, high = ([scale * r[f"{name}_{end}"] for r in mine] for end in ("low", "high"))
                axes[line, column].plot(x, y, STYLE.get(predictor, "-"), label=predictor)
                axes[line, column].fill_between(x, low, high, alpha=0.15)
        axes[0, column].set_title(world)
        axes[1, column].set_xlabel("horizon in s")
    axes[0, 0].set_ylabel("PRE in 1e-3 per pixel")
    axes[1, 0].set_ylabel("IoU")
    axes[0, 0].legend(fontsize="small")
    save(figure, out)


def pictures(
    folder: Path, out: Path, weights: Mapping[str, Path], scenarios: Sequence[str] = ()
) -> list[Path]:
    """For every scenario one decision of one recording: the chain's output beside the truth (P, figures 8
    and 10) and the networks' inner features (P, figure 7). Returns the files."""
    source, hpns = Folder(folder), load_hpns(weights)
    if not hpns:
        raise BadInput("there are no trained HPNs to show", field="weights")
    done: list[Path] = []
    seen: set[str] = set()
    for key in source.episodes():
        recording = read(source.episode_file(key))
        world = str(recording.case["scenario"])
        if world in seen or (scenarios and world not in scenarios):
            continue
        road = source.road(recording)
        moments = [m for m in followed(recording, road, COMPACT, 5) if m.maps]
        if not moments:
            continue
        seen.add(world)
        now, av = max(((m, a) for m in moments for a in m.maps), key=lambda pair: _interest(pair[0], pair[1]))
        predictors = MapPredictors(hpns, make_predictor("gp-indirect", 20, 0.2), COMPACT, road)
        done += [out / f"chain_{world}.png", out / f"features_{world}.png"]
        _chain(now, av, predictors, world, done[-2])
        _features(now, av, hpns, road, world, done[-1])
    return done


def _interest(now: Followed, av: str) -> float:
    """The interest of a picture: number of vehicles, and their motion in it."""
    channels = vehicle_channels(COMPACT)
    maps = now.maps[av][:, channels].astype(np.float32)
    return float(
        (maps[-1] > 0).sum() * np.abs(maps[-1] - now.histories[av].velocity_map[-1, channels]).mean()
    )


def picture(maps: Floats32 | Bytes) -> Floats32:
    """One map [C,H,W] in colours [H,W,3]: road grey, AVs blue, HVs orange, ego and mission green."""
    m = np.clip(unit_maps(maps), 0.0, 1.0)
    out = np.repeat(0.25 * m[2][..., None], 3, -1)
    for channel, colour in ((0, (0.35, 0.65, 1.0)), (1, (1.0, 0.6, 0.2)), (3, (0.4, 1.0, 0.4))):
        value = np.sqrt(m[channel])[..., None]
        out = out * (1 - value) + value * np.array(colour, np.float32)
    return np.asarray(np.clip(out, 0.0, 1.0), np.float32)


def _chain(now: Followed, av: str, predictors: MapPredictors, world: str, out: Path) -> None:
    guess = predictors.predict(now.histories)
    b = guess.agents.index(av)
    at = [frame_of(h) for h in SHOWN_HORIZONS]
    lines = [("what followed", now.maps[av][at])] + [(n, m[b, at]) for n, m in guess.maps.items()]
    figure, axes = _grid(len(lines), len(at))
    for axis, horizon in zip(axes[0], SHOWN_HORIZONS, strict=True):
        axis.set_title(f"{world}, {horizon:g} s ahead", fontsize="small")
    for row, (name, maps) in zip(axes, lines, strict=True):
        _show(row, name, [picture(one) for one in maps])
    save(figure, out)


def _grid(rows: int, columns: int) -> tuple[Figure, Any]:
    """A figure of wide pictures, its axes [rows,columns] without ticks."""
    figure = Figure(figsize=(3.1 * columns, 0.95 * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    return figure, axes


def _show(row: Any, name: str, images: Iterable[Floats32]) -> None:
    """Images side by side, named at the left."""
    row[0].set_ylabel(name, fontsize="small", rotation=0, ha="right", va="center")
    for axis, image in zip(row, images, strict=False):
        axis.imshow(image, aspect="auto", interpolation="nearest", cmap=colormaps["magma"])


def _features(now: Followed, av: str, hpns: Mapping[str, Any], road: RoadMap, world: str, out: Path) -> None:
    found = feature_pictures(hpns, now.histories, av, COMPACT, road, make_predictor("gp-indirect", 20, 0.2))
    columns = 4
    rows = [
        (name, maps[at : at + columns])
        for name, maps in found.items()
        for at in range(0, min(len(maps), 2 * columns), columns)
    ]
    figure, axes = _grid(len(rows), columns)
    for row, (name, maps) in zip(axes, rows, strict=True):
        _show(row, name, maps)
    figure.suptitle(f"{world}: inner features", fontsize="small")
    save(figure, out)
