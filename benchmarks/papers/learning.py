"""How the shipped approaches learned: crashes, missions and distance over training. Drives nothing.

python -m benchmarks.papers.learning [--training vfn-p=runs/vfn-p-0] [--out docs/results]

Drawn from runs/POLICY, runs/POLICY-0, -1, ... or, where there are none, from the logs of the trainings that
made the shipped weights (docs/results/trainings). Other runs: `python -m benchmarks.learning_curves`.
"""

from __future__ import annotations

import argparse

from benchmarks import learning_curves
from benchmarks.papers.driving import Settings, add_arguments, settings_of
from benchmarks.tables import write_page
from policy.agents import APPROACHES

NAME = "learning"


def write(settings: Settings) -> None:
    """learning.md, learning.png, data/learning.csv; nothing where no training is known of."""
    runs = [learning_curves.read(f"{name}={run}") for name in APPROACHES for run in settings.trained(name)]
    if not runs:
        return
    data = settings.out / "data"
    data.mkdir(parents=True, exist_ok=True)
    learning_curves.draw(settings.out / f"{NAME}.png", runs)
    learning_curves.write_csv(data / f"{NAME}.csv", runs)
    text = learning_curves.page(runs, f"python -m benchmarks.papers.{NAME}", f"{NAME}.png")
    write_page(settings.out / f"{NAME}.md", text)
    print(settings.out / f"{NAME}.md")


def main() -> None:
    """The command line: that of all papers' tables, most of which does nothing here."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.papers.{NAME}", description=__doc__)
    add_arguments(parser)
    write(settings_of(parser.parse_args()))


if __name__ == "__main__":
    main()
