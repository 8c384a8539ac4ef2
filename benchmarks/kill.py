"""Kills `cosim evaluate` and its workers at random (SIGKILL), resumes, compares with an undisturbed run.

    python -m benchmarks.kill [--rounds 20] [--kills 4] [--seed 0] [--engine local] [--out DIR]

In each round workers and the parent are killed `--kills` times at random; a killed parent is restarted with
--resume. In the end every episode must exist exactly once, and be equal except for timings and the number of
attempts. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pyarrow.parquet

from cosim.types import TIMINGS

MATRIX = "--scenario merge --demand free --policy idm --policy keep-lane --duration 4 --seeds 200000:200008"
VARYING = {"timings", "attempts", *TIMINGS}  # columns
LIMIT = 600.0  # s for a round


def command(out: Path, engine: str) -> list[str]:
    """`cosim evaluate` of the matrix, resuming in `out`."""
    start = [sys.executable, "-m", "cosim.cli.main", "evaluate"]
    return [*start, *MATRIX.split(), "--workers", "2", "--engine", engine, "--out", str(out), "--resume"]


def rows(out: Path) -> list[dict[str, Any]]:
    """The rows of a run, without fields that may differ."""
    table = pyarrow.parquet.read_table(out / "episodes.parquet").to_pylist()
    return [{k: v for k, v in row.items() if k not in VARYING} for row in table]


def children(pid: int) -> list[int]:
    """The child processes of a process."""
    found = []
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += [int(word) for word in file.read_text().split()]
        except OSError:
            continue
    return found


def disturbed(out: Path, kills: int, dice: random.Random, longest: float, engine: str) -> str:
    """One round with a kill after at most `longest` s; the kills: "w" of a worker, "P" of the parent."""
    killed = ""
    began = time.monotonic()
    while True:
        parent = subprocess.Popen(command(out, engine), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
        while len(killed) < kills:
            if dice.random() < 0.75:  # else the parent may be killed before it has workers
                while parent.poll() is None and not children(parent.pid):
                    time.sleep(0.05)
            try:
                parent.wait(dice.uniform(0.0, longest))
                break
            except subprocess.TimeoutExpired:
                pass
            workers = children(parent.pid)
            if workers and dice.random() < 0.6:
                os.kill(dice.choice(workers), signal.SIGKILL)
                killed += "w"
            else:
                parent.kill()
                killed += "P"
                check_gone(workers)
                break
        stderr = parent.communicate(timeout=LIMIT)[1].decode()
        if parent.returncode == 0:
            return killed
        if parent.returncode != -signal.SIGKILL or time.monotonic() - began > LIMIT:
            raise SystemExit(f"cosim evaluate ended with {parent.returncode}: {stderr}")


def check_gone(workers: list[int]) -> None:
    """Raises SystemExit if workers outlive their parent."""
    end = time.monotonic() + 5.0
    while any(alive(pid) for pid in workers):
        if time.monotonic() > end:
            raise SystemExit(f"workers outlived their parent: {workers}")
        time.sleep(0.05)


def alive(pid: int) -> bool:
    """Whether a process is running (a zombie is not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--kills", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=("local", "ray"), default="local")
    parser.add_argument("--out", type=Path, help="keep the runs here")
    args = parser.parse_args()
    place = args.out or Path(tempfile.mkdtemp(prefix="cosim-kill-"))
    dice = random.Random(args.seed)
    began = time.monotonic()
    subprocess.run(command(place / "undisturbed", "local"), check=True, stdout=subprocess.DEVNULL)
    longest = 0.5 * (time.monotonic() - began)
    wanted = rows(place / "undisturbed")
    wrong = 0
    for k in range(args.rounds):
        out = place / f"round{k}"
        killed = disturbed(out, args.kills, dice, longest, args.engine)
        found = rows(out)
        once = sorted(row["key"] for row in found) == sorted({row["key"] for row in wanted})
        same = found == wanted
        wrong += not (once and same)
        print(f"round {k + 1}: killed {killed}: each once {once}, identical {same}", flush=True)
    print(f"{args.rounds - wrong} of {args.rounds} rounds identical to the undisturbed run")
    if args.out is None:
        shutil.rmtree(place)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
