"""`cosim bench predict`: position error and interval coverage of the kinematic predictors."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.files import write_csv
from cosim.learning import map_bench, map_figures
from cosim.learning.picture import save
from cosim.learning.prediction_scores import LEVEL, Predicted, Scores
from cosim.recording.file import Recording, read
from cosim.recording.folder import Folder, fits
from cosim.recording.views import Windows, windows
from cosim.report import statistics
from cosim.road import RoadMap
from cosim.types import Floats
from cosim.workers.progress import shown
from policy.prediction.forecast import KinematicForecast
from policy.prediction.lane import along_lanes
from policy.prediction.predictors import PREDICTORS, Predictor, make_predictor

FRAME_STRIDE = 5  # frames between two moments: 1 s
LANE_PREDICTOR = "gp-lane"  # uses the road, so it is not in PREDICTORS
HORIZON, DT = 20, 0.2  # frames, s
PAGE, MAPS_PAGE = "prediction.md", "prediction_maps.md"
PICTURE_SCENARIO = "roundabout"  # scenario of the drawn maps, if recorded
TOLERANCE = 0.03  # a 90 % interval should cover 90 +- 3 %
CHUNK = 2048  # windows forecast at once


def bench_predict(
    folder: Folder,
    out: Path,
    *,
    scenarios: Sequence[str] = (),
    behaviors: Sequence[str] = (),
    seeds: range | None = None,
    predictors: Sequence[str] = (),
    command: str = "",
) -> Scores:
    """Measure `predictors` (none: all of the table) on recorded episodes; writes position_error.csv,
    interval_coverage.csv, position_error.png and PAGE into `out`.

    Raises BadInput: no recording fits, no such predictor, two of one name.
    """
    made = [make_predictor(name, HORIZON, DT) for name in predictors or PREDICTORS]
    called = [LANE_PREDICTOR, *(predictor.name for predictor in made)]
    if twice := next((name for name in called if called.count(name) > 1), None):
        raise BadInput("two predictors have this name", field="predictor", value=twice)
    keys = folder.episodes(seeds)
    scores = Scores(HORIZON, DT)
    for key in shown(keys, len(keys), "bench predict", "episodes"):
        recording = read(folder.episode_file(key))
        if fits(recording.case, scenarios, behaviors):
            measure(scores, recording, made, folder.road(recording))
    if not scores.cases:
        raise BadInput("holds no recording of these scenarios, behaviours and seeds", file=folder.path)
    positions, coverage = scores.position_table(), scores.coverage_table()
    write_csv(out / "position_error.csv", positions)
    if coverage:
        write_csv(out / "interval_coverage.csv", coverage)
    plot(out / "position_error.png", scores)
    (out / PAGE).write_text(markdown(scores, positions, coverage, command))
    (out / "prediction.json").write_text(json.dumps(paired(scores), indent=1) + "\n")
    return scores


def bench_maps(
    folder: Folder,
    out: Path,
    *,
    scenarios: Sequence[str] = (),
    behaviors: Sequence[str] = (),
    seeds: range | None = None,
    workers: int = 1,
    command: str = "",
) -> None:
    """The maps on the same recordings: map_error.csv, map_gain.csv, MAPS_PAGE, P's figures 6, 7, 8, 10.

    Raises BadInput when no recorded episode is long enough.
    """
    weights = map_bench.hpn_weights()
    episodes = map_bench.measure(
        folder.path, weights=weights, scenarios=scenarios, behaviors=behaviors, seeds=seeds, workers=workers
    )
    table = map_bench.rows(episodes)
    write_csv(out / "map_error.csv", table)
    compared = map_bench.against(episodes)
    if compared:
        write_csv(out / "map_gain.csv", compared)
    map_figures.errors(table, out / "map_error.png")
    logs = {name: path.with_suffix(".csv") for name, path in weights.items()}
    if present := {name: log for name, log in logs.items() if log.is_file()}:
        map_figures.training(present, out / "hpn_training.png")
    worlds = sorted({episode.scenario for episode in episodes}, key=lambda name: name != PICTURE_SCENARIO)
    shown = map_figures.pictures(folder.path, out, weights, worlds[:1]) if weights else []
    page = [map_bench.markdown(table, compared), "## Pictures", ""]
    page += ["Errors against the horizon (P, figure 8):", "", "![errors](map_error.png)", ""]
    if present:
        page += ["Losses with and without history (P, figure 6):", "", "![losses](hpn_training.png)", ""]
    if shown:
        page += ["Predicted maps, true maps, and inner features (P, figures 8, 10 and 7):", ""]
        page += [*(f"![{picture.stem}]({picture.name})" for picture in shown), ""]
    page += ["```", command, "```"] if command else []
    (out / MAPS_PAGE).write_text("\n".join(page) + "\n")


def measure(
    scores: Scores, recording: Recording, predictors: Sequence[Predictor], road: RoadMap | None = None
) -> None:
    """Add one episode to the scores: every vehicle perceived by an AV, once a second.

    With the `road`, `gp-indirect` is also moved along the lanes (LANE_PREDICTOR).
    """
    w = windows(recording, every=FRAME_STRIDE, horizon=scores.steps)
    forecasts = {p.name: forecast(p, w.past) for p in predictors}
    for predictor in predictors:
        if road is not None and predictor.name == "gp-indirect":
            forecasts[LANE_PREDICTOR] = lane_forecast(predictor, w, road)
    scores.add(recording.case, w.future, forecasts)


def lane_forecast(predictor: Predictor, w: Windows, road: RoadMap) -> Predicted:
    """The predictor's speeds along the lanes, moment by moment; no intervals of its own."""
    parts = []
    for frame in np.unique(w.frame):
        rows = w.frame == frame
        past = w.past[rows]
        valid = np.isfinite(past[:, :, 0])
        plain = predictor.predict(past, valid)
        parts.append(
            along_lanes(plain, past, valid, w.lane[rows], w.lane_position[rows], w.length[rows], road)
        )
    f = KinematicForecast(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    zero = np.zeros_like(f.x)
    return Predicted(f.x, f.y, f.speed, f.heading, (zero, zero, zero, zero))


def forecast(predictor: Predictor, past: Floats) -> Predicted:
    """Forecasts of windows [S,N,4] (nan where unknown), in portions that fit into a processor's cache."""
    parts = []
    for at in range(0, max(len(past), 1), CHUNK):
        part = past[at : at + CHUNK]
        parts.append(predictor.predict(part, np.isfinite(part[:, :, 0])))
    f = KinematicForecast(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return Predicted(f.x, f.y, f.speed, f.heading, (f.speed_std, f.heading_std, f.along_std, f.across_std))


def paired(scores: Scores) -> dict[str, Any]:
    """Each predictor against `gp-indirect` on the same episodes: difference of the mean error over the
    horizon (m), per scenario; positive if the predictor is worse."""
    reference = scores.errors.get("gp-indirect")
    found: dict[str, Any] = {}
    if reference is None:
        return found
    for name, errors in scores.errors.items():
        if name == "gp-indirect":
            continue
        found[name] = {}
        for scenario, behavior, members in scores.groups():
            if behavior == "all" and scenario != "all":
                ours = [float(np.nanmean(reference[i])) for i in members]
                theirs = [float(np.nanmean(errors[i])) for i in members]
                found[name][scenario] = statistics.paired_mean(ours, theirs).document()
    return found


def markdown(
    scores: Scores,
    positions: Sequence[Mapping[str, Any]],
    coverage: Sequence[Mapping[str, Any]],
    command: str,
) -> str:
    """The tables as a document."""
    named = sorted({str(c["scenario"]) for c in scores.cases})
    at = {(r["predictor"], r["scenario"], r["behavior"], r["horizon_s"]): r for r in positions}
    overall = {name: at[name, "all", "all", "mean"] for name in scores.errors}
    best = min(overall, key=lambda name: float(overall[name]["mean_m"]))
    lines = ["# Kinematic prediction", ""]
    lines += [f"`{best}` has the smallest mean position error over 4 s: {_figure(overall[best])} m.", ""]
    lines += [_row(["predictor", *named, "all"]), _row(["---"] + ["---:"] * (len(named) + 1))]
    for name in scores.errors:
        lines.append(_row([name, *(_figure(at[name, s, "all", "mean"]) for s in [*named, "all"])]))
    horizons = list(scores.horizons())
    lines += ["", "## Against the horizon, all scenarios", ""]
    lines += [_row(["predictor", *(f"{h:g} s" for h in horizons)])]
    lines += [_row(["---"] + ["---:"] * len(horizons))]
    for name in scores.errors:
        lines.append(_row([name, *(f"{at[name, 'all', 'all', h]['mean_m']:.3f}" for h in horizons)]))
    lines += ["", "![position error against the horizon](position_error.png)", ""]
    lines += _coverage(coverage, horizons)
    lines += [
        "## Conditions",
        "",
        f"{len(scores.cases)} episodes, every vehicle that an AV perceives, once a second. Errors in m,",
        "with 95 % bootstrap intervals over episodes; scenarios have equal weight. The predictors know",
        f"the last 2 s of a vehicle. `{LANE_PREDICTOR}` also knows the road: it moves `gp-indirect`'s speeds",
        "along the lanes.",
    ]
    return "\n".join(lines + (["", "```", command, "```"] if command else [])) + "\n"


def _coverage(coverage: Sequence[Mapping[str, Any]], horizons: Sequence[float]) -> list[str]:
    """The section on intervals, over all scenarios; none where no predictor has intervals."""
    inside = {
        (r["predictor"], r["quantity"], r["horizon_s"]): r["coverage"]
        for r in coverage
        if r["behavior"] == r["scenario"] == "all"
    }
    if not inside:
        return []
    lines = ["## Share of the truth inside the 90 % interval, all scenarios", ""]
    lines += [f"Bold: more than {100 * TOLERANCE:g} points off.", ""]
    lines += [_row(["predictor", "quantity", *(f"{h:g} s" for h in horizons)])]
    lines += [_row(["---"] * 2 + ["---:"] * len(horizons))]
    for name, quantity in dict.fromkeys(key[:2] for key in inside):
        lines.append(_row([name, quantity, *(_share(inside[name, quantity, h]) for h in horizons)]))
    return [*lines, ""]


def plot(file: Path, scores: Scores) -> None:
    """P's figure 5: position error against the horizon, a panel per scenario and one for all."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panels = [(s, b, m) for s, b, m in scores.groups() if b == "all"]
    figure, axes = plt.subplots(2, math.ceil(len(panels) / 2), figsize=(12, 7), squeeze=False)
    time = scores.dt * np.arange(1, scores.steps + 1)
    for axis, (scenario, _, members) in zip(axes.flat, panels, strict=False):
        for k, (name, errors) in enumerate(scores.errors.items()):
            each = np.stack(errors)[members]
            weight = np.ones(len(members))
            if scenario == "all":
                names = [scores.cases[i]["scenario"] for i in members]
                weight = np.array([1.0 / names.count(n) for n in names])
            there = np.isfinite(each)
            mean = (np.where(there, each, 0.0) * weight[:, None]).sum(0) / (there * weight[:, None]).sum(0)
            wide = 2.2 if name == "gp-indirect" else 1.2
            style = ":" if name == LANE_PREDICTOR else "-"
            axis.plot(time, mean, style, label=name, color=f"C{k}", linewidth=wide)
        axis.set_title(scenario)
        axis.set_xlabel("horizon (s)")
        axis.set_ylabel("position error (m)")
        axis.grid(alpha=0.3)
    axes.flat[0].legend(fontsize=8)
    for axis in list(axes.flat)[len(panels) :]:
        axis.axis("off")
    figure.tight_layout()
    save(figure, file)
    plt.close(figure)


def _figure(row: Mapping[str, Any]) -> str:
    return statistics.Figure(row["mean_m"], row["ci_low"], row["ci_high"]).text(3)


def _share(coverage: float) -> str:
    text = f"{100 * coverage:.1f} %"
    return text if abs(coverage - LEVEL) <= TOLERANCE or math.isnan(coverage) else f"**{text}**"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
