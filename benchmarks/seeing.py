"""What the frame encoder reads off a velocity map, on drives that it has never seen.

    python -m benchmarks.seeing [--drives N] [--worlds NAME ...] [--workers N] [--weights FILE]
                                [--out docs/results/seeing.md]

R2 of every reading, by world, from the map alone: 1 is all, 0 no more than the mean. Perceived frames and
frames that were predicted (the HPN's hypotheses, up to 4 s ahead) apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.tables import markdown_row, write_page
from cosim.errors import CosimError
from cosim.learning.configuration import configuration
from cosim.learning.train_encoder import gather
from cosim.seeding import FIRST_TEST_SEED
from policy.checkpoint import SHIPPED
from policy.training import sight
from policy.training.config import agent_config
from policy.training.sight import ACTIONS, BANDS, LANES, MISSION, READINGS, Seen
from sumo_scenarios import names

GROUPS = {
    "Lanes, perceived frames": (LANES, False),
    "Own frame, perceived frames": (BANDS, False),
    "Own frame, predicted frames": (BANDS, True),
    "Mission vehicle, perceived frames": (MISSION, False),
    "Mission vehicle, predicted frames": (MISSION, True),
    "Time to collision of the actions, perceived frames": (ACTIONS, False),
}


def page(found: Seen, readings: np.ndarray, worlds: Sequence[str], drives: int, command: str) -> list[str]:
    """The Markdown page. readings [n,READINGS]: what the encoder says."""
    predicted = np.isnan(found.readings[:, READINGS.index(LANES[0])])
    counts = ", ".join(f"{w} {int((found.world == k).sum()):,}" for k, w in enumerate(worlds))
    lines = ["# What the encoder sees", "", f"Made by `{command}`.", ""]
    lines += [
        f"{drives} drives of every demand, seeds from {FIRST_TEST_SEED}, half of them with humans who err,",
        "AVs driven by SUMO and by random actions that the prioritizer allows. R2 of what the encoder",
        "reads off one map, with nothing else beside it: 1 is all, 0 no more than the mean of the world.",
        f"Blank: the same everywhere in that world. Frames: {counts}; every second one is a predicted",
        "map (1 to 4 s ahead), whose truth is the prediction that it was drawn from.",
        "",
    ]
    for title, (group, later) in GROUPS.items():
        lines += [f"## {title}", "", markdown_row(["reading", *worlds, "all"])]
        lines += [markdown_row(["---"] + ["---:"] * (len(worlds) + 1))]
        parts = [(found.world == k) & (predicted == later) for k in range(len(worlds))]
        tables = [
            sight.explained(found.readings[part], readings[part]) for part in (*parts, predicted == later)
        ]
        for name in group:
            cells = [f"{table[name]:.2f}" if name in table else "" for table in tables]
            lines.append(markdown_row([name, *cells]))
        lines.append("")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive, read, write the page."""
    parser = argparse.ArgumentParser(description="What the frame encoder reads off a velocity map.")
    parser.add_argument("--drives", type=int, default=6, metavar="N", help="of every demand (6)")
    parser.add_argument("--worlds", nargs="+", default=list(names()), choices=names(), metavar="NAME")
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    parser.add_argument("--weights", type=Path, default=SHIPPED / "encoder.safetensors", metavar="FILE")
    parser.add_argument("--out", type=Path, default=Path("docs/results/seeing.md"), metavar="FILE")
    args = parser.parse_args(arguments)
    file = configuration("compact").file
    try:
        network = sight.load(args.weights, file.encoder)
        seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.drives)
        found = gather(agent_config("vfn-p", file), file.sight, args.worlds, seeds, args.workers, "drives")
        some = "" if args.worlds == list(names()) else f" --worlds {' '.join(args.worlds)}"
        command = f"python -m benchmarks.seeing --drives {args.drives}{some}"
        readings = sight.read_all(network, found.maps)
        write_page(args.out, page(found, readings, args.worlds, args.drives, command))
    except CosimError as error:
        print(f"seeing: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
