"""What a value network drives into without the safety prioritizer and without the car's own braking.

    python -m benchmarks.alone [--episodes 20] [--demand dense] [--worlds merge ...] [--seeds-from 200000]
        [--arms vfn-p ...] [--weights FILE] [--runs runs/alone] [--workers 2] [--out docs/results/alone.md]

Preset `unguarded`, no mask: the best valued action is carried out. `vfn-p-present` is `vfn-p` shown the
present in place of every predicted map. `conv3d-dqn` and `conv3d-a2c`, of a demonstrator,
see maps alone; so do `vfn-p` and `vfn`, beside their own speed, lanes and command. FILE is a network that is
shown what `vfn-p` is, and drives too. The same command goes on where it stopped.
"""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.learned import asked, drivers, driving, options, share
from benchmarks.tables import markdown_row, write_page
from cosim.cli.main import main as cosim
from cosim.learning.attribution import questioned
from cosim.policies.trained import config
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.types import Policy
from cosim.workers.tasks import OK
from policy.agents.approaches import compact
from policy.agents.prediction_aware import PredictionAware
from policy.attribution import PRESENT, Replaced
from sumo_scenarios import names

SVO = 60
EVERY = "all worlds"
CRASHED = "av_involved_collisions"
WEIGHTS = "COSIM_ALONE_WEIGHTS"  # the environment variable that names the file to the workers
ARMS = (  # functions of this module
    *("given", "vfn_p", "vfn_p_present", "vfn"),
    *("conv3d_dqn", "conv3d_a2c", "vfn_p_demonstrated"),
)
COLUMNS = (
    "world", "network", "episodes", "with an AV in a collision", "AV-caused", "mission fulfilled",
    "distance of all, m", "less vfn-p-demonstrated, points",
)  # fmt: skip


def unmasked(approach: str) -> Policy:
    """A shipped approach whose best valued action is carried out."""
    return PredictionAware(f"{approach} alone", replace(compact(approach), mask=False))


def given() -> Policy:
    """The network of `--weights` without the mask."""
    return PredictionAware("given alone", replace(config(Path(os.environ[WEIGHTS])), mask=False))


def vfn_p() -> Policy:
    """`vfn-p` without the mask."""
    return unmasked("vfn-p")


def vfn_p_present() -> Policy:
    """`vfn-p` without the mask, whose predicted maps show the present."""
    agent = questioned("vfn-p")
    return Replaced(agent.name, replace(agent.config, mask=False), ("predicted maps", PRESENT))


def conv3d_dqn() -> Policy:
    """`conv3d-dqn`: it never has a mask."""
    return unmasked("conv3d-dqn")


def conv3d_a2c() -> Policy:
    """`conv3d-a2c`: it never has a mask."""
    return unmasked("conv3d-a2c")


def vfn() -> Policy:
    """`vfn` without the mask."""
    return unmasked("vfn")


def vfn_p_demonstrated() -> Policy:
    """`vfn-p-demonstrated` without the mask."""
    return unmasked("vfn-p-demonstrated")


def table(rows: Sequence[Row]) -> list[str]:
    """The Markdown table of whatever has been driven: world by world, then all worlds together."""
    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    worlds = list(dict.fromkeys(str(row["scenario"]) for row in rows))
    for world in [*worlds, EVERY]:
        of = {
            arm: {
                (row["scenario"], row["seed"]): row
                for row in rows
                if row["policy"] == _label(arm) and world in (row["scenario"], EVERY)
            }
            for arm in ARMS
        }
        before = of[ARMS[-1]]
        for arm in ARMS:
            mine = list(of[arm].values())
            if not mine:
                continue
            pairs = sorted(of[arm].keys() & before.keys(), key=str)
            crashed, theirs = ([bool(part[key][CRASHED]) for key in pairs] for part in (of[arm], before))
            distance = [float(row["dt_mean_m"]) for row in mine]
            lines.append(
                markdown_row(
                    [
                        world,
                        _label(arm),
                        str(len(mine)),
                        share(mine, CRASHED),
                        share(mine, "av_caused_collisions"),
                        share(mine, "mission_success"),
                        statistics.mean(distance).text(0),
                        statistics.paired_share(theirs, crashed).text(0, 100.0) if arm != ARMS[-1] else "",
                    ]
                )
            )
    return lines


def beside(rows: Sequence[Row]) -> list[str]:
    """Pairs of `vfn-p` and each other network: episodes with an AV in a collision, a line a network."""
    lines = []
    mine = {(row["scenario"], row["seed"]): row for row in rows if row["policy"] == _label("vfn_p")}
    for arm in (arm for arm in ARMS if arm != "vfn_p"):
        theirs = {(row["scenario"], row["seed"]): row for row in rows if row["policy"] == _label(arm)}
        told = []
        for world in (EVERY, *dict.fromkeys(str(world) for world, _ in mine)):
            pairs = [key for key in mine if key in theirs and world in (key[0], EVERY)]
            after, before = (np.array([bool(part[key][CRASHED]) for key in pairs]) for part in (mine, theirs))
            p = statistics.mcnemar(*statistics.discordant(before, after))
            told.append(f"{world} {after.sum()} and {before.sum()} of {len(pairs)}, p {p:.2g}")
        if theirs:
            lines.append(f"- `{_label('vfn_p')}` and `{_label(arm)}`: {'; '.join(told)}.")
    return lines


def _label(arm: str) -> str:
    return f"{arm.replace('_', '-')}-alone"


def main() -> None:
    """Drive what is missing, write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options(parser, "alone", "dense", names())
    shipped = [arm.replace("_", "-") for arm in ARMS[1:]]
    parser.add_argument(
        "--arms", nargs="+", choices=shipped, default=shipped, help=f"default: {' '.join(shipped)}"
    )
    parser.add_argument("--weights", metavar="FILE", help="a further network: `given-alone`")
    args = parser.parse_args()
    if args.weights:
        os.environ[WEIGHTS] = args.weights
    seeds = f"{args.seeds_from}:{args.seeds_from + args.episodes}"
    arms = [arm.replace("-", "_") for arm in args.arms]
    arms = [ARMS[0], *arms] if args.weights else arms
    words = [word for world in args.worlds for word in ("--scenario", world)]
    words += [word for arm in arms for word in ("--policy", f"{_label(arm)}=benchmarks.alone:{arm}")]
    words += [*driving(args), "--svo", str(SVO), "--preset", "unguarded"]
    code = cosim(["evaluate", *words, "--out", str(args.runs)])
    if code:
        raise SystemExit(code)
    rows = [row for row in run_folder.read(args.runs).rows if row["status"] == OK]
    about = [
        "# A network alone",
        "",
        f"Made by `python -m benchmarks.alone{asked(parser, args)}`: `{args.demand}`,",
        f"seeds {seeds}, {drivers(rows)}, errors `none`, phi {SVO} degrees, preset",
        "`unguarded`. No action is masked and no car brakes by itself: what the network values best is",
        "carried out. Shares of episodes with Wilson's, means with bootstrap, paired differences with",
        "Tango's 95 % intervals.",
        "",
    ]
    pairs = "Pairs with an AV in a collision, p by McNemar, not corrected for how many there are:"
    write_page(args.out, [*about, *table(rows), "", pairs, "", *beside(rows)])
    print(args.out.read_text())


if __name__ == "__main__":
    main()
