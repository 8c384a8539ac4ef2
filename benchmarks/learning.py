"""Learning curves of the shipped approaches: crashes, missions and distance over training.

    python -m benchmarks.learning [--training vfn-p=runs/vfn-p-0] [--out docs/results]

Sources: runs/POLICY, runs/POLICY-0, -1, ... or else the logs of the trainings of the shipped weights
(docs/results/trainings). No episode is driven. Other runs: `python -m benchmarks.learning_curves`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from benchmarks import learning_curves
from benchmarks.learning_curves import COURSES, PARTS, Training
from benchmarks.tables import markdown_head, markdown_row, write_page
from policy.agents import APPROACHES

NAME = "learning"
MASKED, BARE = "safe-dqn", "conv3d-dqn"  # approaches that differ in the mask alone
CRASHES = "train", "crashed"
FIGURES = (CRASHES, ("train", "mission_success"), ("train", "dt_mean_m"), ("valid", "mission_success"))
TRAININGS = Path("docs/results/trainings")  # training logs of the shipped weights


def write(out: Path, given: Mapping[str, Sequence[Path]]) -> None:
    """Write learning.md, learning.png and data/learning.csv; nothing without a known training.

    `given`: policy -> runs of `cosim train`, in place of those found.
    """
    runs = [
        learning_curves.read(f"{name}={run}") for name in APPROACHES for run in given.get(name, found(name))
    ]
    if not runs:
        return
    data = out / "data"
    data.mkdir(parents=True, exist_ok=True)
    learning_curves.draw(out / f"{NAME}.png", runs)
    learning_curves.write_csv(data / f"{NAME}.csv", runs)
    text = learning_curves.page(runs, f"python -m benchmarks.{NAME}", f"{NAME}.png")
    write_page(out / f"{NAME}.md", [*text, *mask(runs)])
    print(out / f"{NAME}.md")


def mask(runs: Sequence[Training]) -> list[str]:
    """The section on P's claim that the safety prioritizer accelerates learning; empty without both."""
    of = {label: [run for run in runs if run.label == label] for label in (MASKED, BARE)}
    if not all(of.values()):
        return []
    ends = {label: {key: _ends(mine, key) for key in FIGURES} for label, mine in of.items()}
    gains = [
        [last - first for first, last in (ends[label][key] for label in (MASKED, BARE))]
        for key in FIGURES
        if key != CRASHES
    ]
    yes = all(masked > bare for masked, bare in gains)
    seeds = min(map(len, of.values()))
    head = ["agent", *(f"{COURSES[name]} ({PARTS[part]})" for part, name in FIGURES)]
    rows = [
        [f"`{label}`", *(" to ".join(learning_curves.shown(key[1], v) for v in mine[key]) for key in FIGURES)]
        for label, mine in ends.items()
    ]
    return [
        *("", "## Does the safety prioritizer accelerate learning?", ""),
        f"P (section III) says so. **{'Yes' if yes else 'Not shown'}**: `{MASKED}` and `{BARE}` differ in",
        f"the mask alone, with training seeds: {seeds} each. The mask counts from the first drive on, before",
        "anything is learned, so what learning adds is the change from the first value to the last:",
        "",
        *markdown_head(head),
        *map(markdown_row, rows),
    ]


def _ends(runs: Sequence[Training], key: tuple[str, str]) -> tuple[float, float]:
    """The first and the last value of a figure, means over the runs."""
    first, last = (fmean(float(run.courses[key].value[k]) for run in runs) for k in (0, -1))
    return first, last


def found(policy: str) -> list[Path]:
    """The known runs of `cosim train` of a policy."""
    for root in (Path("runs"), TRAININGS):
        places = [root / policy, *sorted(root.glob(f"{policy}-[0-9]*"))]
        if runs := [place for place in places if (place / "log.jsonl").is_file()]:
            return runs
    return []


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{NAME}", description=__doc__)
    parser.add_argument("--training", action="append", default=[], metavar="POLICY=RUN")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), metavar="DIR")
    args = parser.parse_args()
    given: dict[str, list[Path]] = {}
    for text in args.training:
        policy, _, run = text.partition("=")
        given.setdefault(policy, []).append(Path(run))
    write(args.out, given)


if __name__ == "__main__":
    main()
