"""Start-up time of short commands, relative to their unavoidable imports and episodes.

    python -m benchmarks.startup [--rounds 7] [--out docs/results/startup.md]

Whole processes alternate, after one uncounted round that compiles kernels. Ratios are formed within a round,
so that other load affects both sides equally.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

IMPORTS = ("-c", "import numpy, libsumo")
TORCH = ("-c", "import torch")
POLICY = "vfn-p"
RUN = ("-m", "cosim.cli.main", "run", "merge", "--json")
SHORT = (*RUN, "--policy", "idm", "--demand", "free")
NETWORK = (*RUN, "--policy", POLICY)
TARGET = {"idm": 5.0, POLICY: 2.0}

PAGE = """# How long a short command takes to start

Made by `python -m benchmarks.startup --rounds {rounds}`. Whole processes alternate, with compiled
kernels. Values are medians of {rounds} rounds (range). Ratios are formed within a round. Compare
ratios, not seconds.

|  | measured | target |
|---|---|---|
| `python -c "import numpy, libsumo"` | {imports} s |  |
| `cosim run merge --policy idm --demand free` | {short} s |  |
| ... of which the episode | {driven} s |  |
| times importing numpy and libsumo | {idm} | at most {most_idm:g}: {held_idm} |
| `python -c "import torch"` | {torch} s |  |
| `cosim run merge --policy {policy}` | {network} s |  |
| ... of which the episode | {episode} s |  |
| times its episode and the import of torch together | {vfn} | at most {most_vfn:g}: {held_vfn} |
"""


def timed(arguments: tuple[str, ...]) -> tuple[float, str]:
    """Duration of a whole Python process in s, and its output. Raises CalledProcessError."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True)
    return time.perf_counter() - began, done.stdout


def one_round() -> dict[str, float]:
    """Run every process once: durations in s, those of the episodes, and both ratios."""
    imports, torch = timed(IMPORTS)[0], timed(TORCH)[0]
    short, quick = timed(SHORT)
    network, slow = timed(NETWORK)
    driven, episode = (json.loads(text)["timings"]["total_s"] for text in (quick, slow))
    ratios = {"idm": short / imports, POLICY: network / (episode + torch)}
    seconds = {"imports": imports, "torch": torch, "short": short, "network": network}
    return seconds | {"driven": driven, "episode": episode} | ratios


def page(rounds: list[dict[str, float]]) -> str:
    """The figures as Markdown."""

    def figure(name: str) -> str:
        each = [one[name] for one in rounds]
        return f"{statistics.median(each):.2f} ({min(each):.2f} to {max(each):.2f})"

    held = {
        name: "met" if statistics.median(one[name] for one in rounds) <= most else "missed"
        for name, most in TARGET.items()
    }
    return PAGE.format(
        rounds=len(rounds),
        policy=POLICY,
        most_idm=TARGET["idm"],
        most_vfn=TARGET[POLICY],
        held_idm=held["idm"],
        held_vfn=held[POLICY],
        vfn=figure(POLICY),
        **{name: figure(name) for name in rounds[0] if name != POLICY},
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.startup",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rounds", type=int, default=7, metavar="N", help="default 7")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the page there")
    args = parser.parse_args()
    one_round()
    text = page([one_round() for _ in range(args.rounds)])
    print(text)
    if args.out is not None:
        args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
