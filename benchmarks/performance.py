"""Cost of the loop, a batch and a prediction on one page: runs `loop`, `batch` and `prediction`.

    python -m benchmarks.performance --recordings DIR [--out docs/results/performance.md] [--small]

Run on an idle machine. `--recordings`: a folder of `cosim record`, validation seeds. `--small`: minimal
sizes; the figures are meaningless then.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown_row, write_page

LOOP = ("--rounds", "11")
BATCH = ("--episodes", "200", "--rounds", "1")
PREDICTION = ("--vehicles", "50")
SMALL = {
    "loop": ("--rounds", "1", "--decisions", "5", "--resets", "3", "--highway", "3"),
    "batch": ("--episodes", "2", "--rounds", "1", "--duration", "1", "--policy", "idm"),
    "prediction": ("--vehicles", "2", "--seconds", "0.1"),
}


def measured(module: str, flags: Sequence[str]) -> Any:
    """The document that `python -m benchmarks.MODULE FLAGS --json` prints. Raises CalledProcessError."""
    command = [sys.executable, "-m", f"benchmarks.{module}", *flags, "--json"]
    print(f"performance: {module} {' '.join(flags)}", file=sys.stderr, flush=True)
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def page(found: dict[str, Any], flags: dict[str, Sequence[str]], command: str) -> list[str]:
    """The Markdown page."""
    return [
        "# What the loop, a batch and a prediction cost",
        "",
        f"Made by `{command}`. Compare ratios, not seconds.",
        "",
        *_loop(found["loop"], f"python -m benchmarks.loop {' '.join(flags['loop'])}"),
        *_batch(found["batch"], f"python -m benchmarks.batch {' '.join(flags['batch'])}"),
        *_prediction(found["prediction"], f"python -m benchmarks.prediction {' '.join(flags['prediction'])}"),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recordings", required=True, metavar="DIR", help="a folder of `cosim record`")
    parser.add_argument("--out", type=Path, default=Path("docs/results/performance.md"), metavar="FILE.md")
    parser.add_argument("--small", action="store_true", help="minimal sizes, to test")
    args = parser.parse_args(arguments)
    flags: dict[str, Sequence[str]] = {"loop": LOOP, "batch": BATCH, "prediction": PREDICTION}
    flags = {**(SMALL if args.small else flags)}
    flags["prediction"] = ("--recordings", args.recordings, *flags["prediction"])
    found = {module: measured(module, words) for module, words in flags.items()}
    command = f"python -m benchmarks.performance --recordings {args.recordings}"
    write_page(args.out, page(found, flags, command + (" --small" if args.small else "")))
    print(args.out)


# ---- inside ----


def _rows(*rows: tuple[str, str, str]) -> list[str]:
    head = [markdown_row(["", "measured", "target"]), "|---|---|---|"]
    return [*head, *(markdown_row(list(row)) for row in rows), ""]


def _target(value: float, limit: float, unit: str = "", *, most: bool = True) -> str:
    met = value <= limit if most else value >= limit
    return f"{'at most' if most else 'at least'} {limit:g}{unit}: {'met' if met else '**missed**'}"


def _loop(one: dict[str, Any], command: str) -> list[str]:
    def times(size: str) -> tuple[str, str, str]:
        part = one[size]
        low, high = part["ratio_range"]
        ratio = f"{part['ratio']:.2f} ({low:.2f} to {high:.2f})"
        return f"{size} size, times bare libsumo", ratio, _target(part["ratio"], part["target"])

    other = one["highway_env"]
    return [
        "## The loop",
        "",
        f"`{command}`: one decision without the agent (4 SUMO steps of 0.1 s, two frames of",
        "VelocityMap and kinematics for every AV, full history) compared with bare libsumo on the same",
        "episode, and with HighwayEnv with equally many vehicles and agents and a grid of similar size.",
        f"Scenario `{one['scenario']}`, demand `{one['demand']}`, validation seeds, AVs driven by SUMO. The",
        f"median decision has {one['vehicles']:.0f} vehicles and {one['avs']:.0f} AVs. The processes",
        "alternate every five decisions, so that other load affects all equally. Values are medians over",
        "decisions, then over rounds (range).",
        "",
        *_rows(
            times("compact"),
            times("paper"),
            (
                "simulated s per s, times HighwayEnv",
                f"{other['ratio']:.0f}",
                _target(other["ratio"], other["target"], most=False),
            ),
            (
                f"reset (load and first frame, median of {one['resets']})",
                f"{one['reset_ms']:.2f} ms",
                _target(one["reset_ms"], 5.0, " ms"),
            ),
            (
                "of which bare `libsumo.load`, same options, same process",
                f"{one['bare_load_ms']:.2f} ms",
                "",
            ),
            (f"memory over {one['resets']} resets", f"{one['memory_growth_mib']:+.1f} MiB", "flat"),
        ),
    ]


def _batch(one: dict[str, Any], command: str) -> list[str]:
    return [
        "## Batches",
        "",
        f"`{command}`: the engine of `cosim evaluate`,",
        f"{one['episodes']} episodes of {one['episode_s']:.2f} s (median) on merge, dense.",
        "",
        *_rows(
            ("one worker", f"{one['one_worker_s']:.0f} s", ""),
            (
                "two workers",
                f"{one['two_workers_s']:.0f} s, {one['ratio']:.2f} of it",
                _target(one["ratio"], one["target"]),
            ),
            (
                "engine's overhead, share of serial time",
                f"{100 * one['overhead']:.2f} %",
                _target(100 * one["overhead"], 100 * one["overhead_target"], " %"),
            ),
            ("start of the first worker", f"{one['start_s']:.1f} s", ""),
        ),
    ]


def _prediction(one: dict[str, Any], command: str) -> list[str]:
    return [
        "## Prediction",
        "",
        f"`{command}`: {one['vehicles']} vehicles of recorded episodes (validation seeds) at a time.",
        "",
        *_rows(
            ("kernel bank", f"{one['bank_ms']:.2f} ms", _target(one["bank_ms"], one["target_ms"], " ms")),
            ("with everything around it (`gp-indirect`)", f"{one['predictor_ms']:.2f} ms", ""),
        ),
    ]


if __name__ == "__main__":
    main()
