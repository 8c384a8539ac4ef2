"""Learning curves: crashes, missions and distance over training, with several seeds per agent.

    python -m benchmarks.learning_curves vfn-p=runs/vfn-p-0 vfn-p=runs/vfn-p-1 twin=runs/twin-0 \\
        [--out docs/results/learning.md]

RUN is a folder of `cosim train`; runs of one LABEL are one agent trained from several seeds (default label:
the folder's name). With --out a page, CSV and picture are written, else the page is printed.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.errors import BadInput, CosimError
from cosim.learning.picture import save
from cosim.types import Floats

COURSES = {"crashed": "crashed, %", "mission_success": "missions, %", "dt_mean_m": "distance, m"}
PERCENT = ("crashed", "mission_success")
PARTS = {"train": "training", "valid": "validation"}
WINDOW = 20  # iterations, averaging window of training drives


@dataclass(frozen=True)
class Course:
    """The curve of one figure over one run; [k] each."""

    iteration: Floats
    value: Floats  # in the figure's unit, shares as fractions


@dataclass(frozen=True)
class Training:
    """One run: (part, figure) -> its course."""

    label: str
    name: str
    courses: Mapping[tuple[str, str], Course]
    iterations: int
    seed: int | None  # None: unknown


def read(text: str) -> Training:
    """Read `[LABEL=]RUN`. Raises BadInput without a training log in it."""
    label, _, folder = text.rpartition("=")
    path = Path(folder)
    log = path / "log.jsonl"
    if not log.is_file():
        raise BadInput("holds no log.jsonl: is it a run of `cosim train`?", file=path)
    try:
        records: list[dict[str, Any]] = [json.loads(line) for line in log.read_text().splitlines()]
        at = [float(record["iteration"]) for record in records]
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"is no log of a training: {error!r}", file=log) from None
    courses = {}
    for part in PARTS:
        for name in COURSES:
            found = [
                (k, float(r[f"{part}/{name}"]))
                for k, r in zip(at, records, strict=True)
                if f"{part}/{name}" in r
            ]
            if found:
                x, y = np.array(found).T
                courses[part, name] = smoothed(x, y) if part == "train" else Course(x, y)
    if not courses:
        raise BadInput("holds none of the figures that are drawn", file=log)
    return Training(label or path.name, path.name, courses, len(records), _seed(path))


def smoothed(x: Floats, y: Floats, window: int = WINDOW) -> Course:
    """Moving means over `window` points (or all, if fewer), each at its last point."""
    width = min(window, len(y))
    return Course(x[width - 1 :], np.convolve(y, np.full(width, 1.0 / width), "valid"))


def together(courses: Sequence[Course]) -> tuple[Floats, Floats, Floats, Floats]:
    """Iterations common to all courses, and the mean, minimum and maximum there: [k] each."""
    first, last = max(c.iteration[0] for c in courses), min(c.iteration[-1] for c in courses)
    x = courses[0].iteration
    x = x[(x >= first) & (x <= last)]
    values = np.array([np.interp(x, c.iteration, c.value) for c in courses])
    return x, values.mean(0), values.min(0), values.max(0)


def page(runs: Sequence[Training], command: str, drawn: str = "") -> list[str]:
    """The Markdown page."""
    lines = ["# Learning curves", "", f"Made by `{command}`.", ""]
    lines += [
        f"Training drives explore; their values are means over {WINDOW} iterations. Validation is greedy, on",
        "validation seeds. Thin lines are single training seeds, thick lines are their mean. The table has",
        "the first and the last mean over training seeds, in brackets the lowest and the highest value.",
        "",
        *([f"![crashes, missions, distance over training]({drawn})", ""] if drawn else []),
        *markdown_head(["agent", "seeds", "iterations", "drives", *COURSES.values()]),
    ]
    for label, mine in _by_label(runs).items():
        seeds = ", ".join("?" if run.seed is None else str(run.seed) for run in mine)
        count = ", ".join(dict.fromkeys(str(run.iterations) for run in mine))
        courses = _shared(mine)
        for part, drives in PARTS.items():
            cells = [_ends(name, courses.get((part, name), ())) for name in COURSES]
            if any(cells):
                lines.append(markdown_row([label, seeds, count, drives, *cells]))
    return lines


def _ends(name: str, courses: Sequence[Course]) -> str:
    """The first and the last value over the seeds; empty without any."""
    mean, low, high = together(courses)[1:] if courses else ((),) * 3
    return "; ".join(_text(name, mean[k], low[k], high[k]) for k in (0, -1)) if len(mean) else ""


def shown(name: str, value: float) -> str:
    """A figure's value as in the tables, shares in %."""
    return f"{100.0 * value:.1f}" if name in PERCENT else f"{value:.0f}"


def write_csv(path: Path, runs: Iterable[Training]) -> None:
    """Write the points of every run: all of validation, every `WINDOW`-th mean of the training drives."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("agent", "run", "drives", "figure", "iteration", "value"))
        for run in runs:
            for (part, name), course in run.courses.items():
                step = WINDOW if part == "train" else 1
                for x, y in zip(course.iteration[::step], course.value[::step], strict=True):
                    writer.writerow((run.label, run.name, part, name, f"{x:g}", f"{y:.6g}"))


def draw(path: Path, runs: Sequence[Training]) -> None:
    """Draw the curves: one row per part, one column per figure."""
    parts = [part for part in PARTS if any(p == part for run in runs for p, _ in run.courses)]
    picture = Picture(figsize=(4.2 * len(COURSES) + 1.6, 3.2 * len(parts)), layout="constrained")
    axes = picture.subplots(len(parts), len(COURSES), squeeze=False)
    for row, part in enumerate(parts):
        for column, (name, title) in enumerate(COURSES.items()):
            _draw(axes[row, column], runs, (part, name))
            axes[row, column].set(title=f"{title} ({PARTS[part]})", xlabel="iterations")
    picture.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    save(picture, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Read, then write or print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="[LABEL=]RUN")
    parser.add_argument("--out", type=Path, metavar="FILE.md")
    args = parser.parse_args(arguments)
    try:
        runs = [read(text) for text in args.runs]
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    words = sys.argv[1:] if arguments is None else arguments
    command = " ".join(["python -m benchmarks.learning_curves", *words])
    if args.out is None:
        print("\n".join(page(runs, command)))
        return 0
    args.out.parent.mkdir(parents=True, exist_ok=True)
    picture = args.out.with_suffix(".png")
    draw(picture, runs)
    write_csv(args.out.with_suffix(".csv"), runs)
    write_page(args.out, page(runs, command, picture.name))
    return 0


# ---- inside ----


def _seed(folder: Path) -> int | None:
    """The training seed from the checkpoint."""
    try:
        return int(json.loads((folder / "state.json").read_text())["config"]["seed"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _by_label(runs: Iterable[Training]) -> dict[str, list[Training]]:
    found: dict[str, list[Training]] = {}
    for run in runs:
        found.setdefault(run.label, []).append(run)
    return found


def _shared(runs: Sequence[Training]) -> dict[tuple[str, str], list[Course]]:
    """The courses common to all of these runs."""
    keys = [key for key in runs[0].courses if all(key in run.courses for run in runs)]
    return {key: [run.courses[key] for run in runs] for key in keys}


def _text(name: str, *values: float) -> str:
    mean, low, high = (shown(name, v) for v in values)
    return mean if low == high else f"{mean} ({low} to {high})"


def _draw(axes: Axes, runs: Sequence[Training], key: tuple[str, str]) -> None:
    scale = 100.0 if key[1] in PERCENT else 1.0
    for k, (label, mine) in enumerate(_by_label(runs).items()):
        courses = [run.courses[key] for run in mine if key in run.courses]
        for course in courses:
            axes.plot(course.iteration, scale * course.value, color=f"C{k}", alpha=0.35, linewidth=0.8)
        if courses:
            x, mean, _, _ = together(courses)
            axes.plot(x, scale * mean, color=f"C{k}", linewidth=1.8, label=label)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    sys.exit(main())
