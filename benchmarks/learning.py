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
    means = {label: _means([run for run in runs if run.label == label]) for label in (MASKED, BARE)}
    if not all(means.values()):
        return []
    masked, bare = means[MASKED], means[BARE]
    better = masked[CRASHES] < bare[CRASHES] and all(masked[k] > bare[k] for k in FIGURES if k != CRASHES)
    count = min(sum(run.label == label for run in runs) for label in means)
    seeds = "one training seed" if count == 1 else f"{count} training seeds"
    head = ["agent", *(f"{COURSES[name]} ({PARTS[part]})" for part, name in FIGURES)]
    return [
        *("", "## Does the safety prioritizer accelerate learning?", ""),
        f"P (section III) says so. **{'Yes' if better else 'No'}**, with {seeds} each, so without interval.",
        f"`{MASKED}` and `{BARE}` differ in the mask alone. Values are means over the whole training.",
        "",
        *markdown_head(head),
        *(
            markdown_row([f"`{label}`", *(learning_curves.shown(key[1], of[key]) for key in FIGURES)])
            for label, of in means.items()
        ),
    ]


def _means(runs: Sequence[Training]) -> dict[tuple[str, str], float]:
    """The mean of each figure over the whole training, over all runs; empty without runs."""
    if not runs:
        return {}
    return {key: fmean(fmean(run.courses[key].value) for run in runs) for key in FIGURES}


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
