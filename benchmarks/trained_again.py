"""Trains the shipped networks again by their own commands, and compares the logs with the shipped ones.

    python -m benchmarks.trained_again [NETWORK ...] [--iterations 10]

Commands are from the model cards (docs/reference/models.md). Logs are from docs/results/trainings, with four
digits and some of the fields; all of these except seconds are compared. A command is stopped after
`--iterations`. `conv2d-dqn` and `conv3d-dqn` fill the replay buffer until iteration 22, without learning.
Exits with 1 if a field differs. A processor with other vector instructions than AVX2 rounds sums differently,
so that losses and later drives may differ.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.learning import TRAININGS
from cosim.cli.arguments import count
from policy.agents import APPROACHES
from policy.checkpoint import SHIPPED, read_card

DIGITS = 4  # of the shipped logs
Line = Mapping[str, float]


def commands() -> dict[str, str]:
    """Network -> training command in this version."""
    data = {name: read_card(SHIPPED / f"{name}.safetensors")["data"] for name in APPROACHES}
    return {name: about["commands"]["train"] for name, about in data.items()}


def differences(name: str, iterations: int) -> list[str]:
    """Differences between the first iterations of a new training and the shipped log.

    Raises SystemExit if the shipped log is shorter.
    """
    shipped = log(TRAININGS / f"{name}-0")[:iterations]
    if len(shipped) < iterations:
        raise SystemExit(f"{TRAININGS / name}-0 holds a log of {len(shipped)} iterations")
    with tempfile.TemporaryDirectory() as folder:
        driven = trained(commands()[name], iterations, Path(folder))
    return [*compared(shipped, driven)]


def trained(command: str, iterations: int, folder: Path) -> list[Line]:
    """The log of the first iterations of `cosim train ...`; shorter if the training ends earlier."""
    words = [*shlex.split(command)[1:], "--out", str(folder)]
    with subprocess.Popen(
        [sys.executable, "-m", "cosim.cli.main", *words], stdout=subprocess.DEVNULL
    ) as process:
        while process.poll() is None and len(log(folder)) < iterations:
            time.sleep(0.2)
        process.terminate()
    return log(folder)[:iterations]


def log(folder: Path) -> list[Line]:
    """Every complete line of a training's log; empty without a log."""
    file = folder / "log.jsonl"
    lines = file.read_text("utf-8").splitlines(keepends=True) if file.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def compared(shipped: Sequence[Line], driven: Sequence[Line]) -> Iterator[str]:
    """`iteration 3, train/reward: shipped 0.5413, now 0.5623`, for every field that differs."""
    for k, line in enumerate(shipped):
        now = driven[k] if k < len(driven) else {}
        for name, value in line.items():
            if not name.endswith("_s") and _shown(value) != _shown(now.get(name)):
                yield f"iteration {k}, {name}: shipped {_shown(value)}, now {_shown(now.get(name))}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and compare, one network after another."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = list(commands())
    parser.add_argument("networks", nargs="*", metavar="NETWORK", help=f"of {', '.join(known)}; default: all")
    parser.add_argument("--iterations", type=count, default=10, metavar="N")
    args = parser.parse_args(arguments)
    if unknown := set(args.networks) - set(known):
        parser.error(f"no command trains {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    failed = False
    for name in args.networks or known:
        found = differences(name, args.iterations)
        print(f"{name}: {len(found) or 'no'} fields differ in {args.iterations} iterations")
        print(*found, sep="\n", end="\n" * bool(found))
        failed |= bool(found)
    return int(failed)


def _shown(value: float | None) -> str:
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
