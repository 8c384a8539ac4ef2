"""What prediction is worth where humans err: without it, with it, and with the future that really comes.

    python -m benchmarks.foresight [--episodes 60] [--demand contested] [--worlds merge ...]
        [--seeds-from 200000] [--runs runs/foresight] [--workers 2] [--out docs/results/foresight.md]

`vfn` (sees no predicted map, and its prioritizer expects constant speeds), `vfn-p` and `vfn-p-oracle` (the
simulation, driven on in a copy, predicts: fair, for errors that have not begun do not begin) at 60 degrees,
mixed drivers, errors `stress`, preset `lawful`, on equal seeds. Near-misses of AVs come first, named before
looking; then collisions and distances. The share of the oracle's gain is what `vfn-p` has of what
`vfn-p-oracle` has less than `vfn`. The same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.learned import asked, drivers, driving, of, options, share
from benchmarks.tables import markdown_row, write_page
from benchmarks.turn import resampled
from benchmarks.worlds import WITH_MISSION
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.report.statistics import Figure
from cosim.workers.tasks import OK

SVO = 60
BEHAVIOR, LEVEL = "mixed", "stress"
WITHOUT, WITH, ORACLE = ARMS = ("vfn", "vfn-p", "vfn-p-oracle")
PAIRS = ((WITH, WITHOUT), (ORACLE, WITHOUT), (ORACLE, WITH))
TOGETHER = "all worlds"
NEAR, HIT = "av_near_misses_ttc", "av_involved_collisions"
DISTANCES = ("dt_mission_m", "dt_av_m", "dt_mean_m")
MEANS = ("world", "arm", "episodes", "near-misses of AVs", "with an AV in a collision", "let in",
         "distance of the mission vehicle, m", "of AVs, m", "of all, m")  # fmt: skip
DIFFERENCES = ("world", "arms", "pairs", "near-misses of AVs", "p by Holm", "with an AV in a collision, pp",
               "p by Holm", "distance of the mission vehicle, m", "of AVs, m", "of all, m")  # fmt: skip

Arms = Mapping[str, Sequence[Row]]  # rows in the same order of worlds and seeds


def hits(rows: Sequence[Row], name: str) -> np.ndarray:
    """[episodes] bool."""
    return np.array([bool(row.get(name)) for row in rows])


def paired(rows: Sequence[Row], wanted: Sequence[str] = ARMS) -> dict[str, Arms]:
    """World (and `TOGETHER`) -> arm -> rows, of the seeds that all `wanted` arms have driven."""
    found: dict[tuple[str, int], dict[str, Row]] = {}
    for row in rows:
        found.setdefault((str(row["scenario"]), int(row["seed"])), {})[str(row["policy"])] = row
    whole = {key: arms for key, arms in sorted(found.items()) if arms.keys() >= set(wanted)}
    worlds = dict.fromkeys(world for world, _ in whole)
    return {
        world: {
            arm: [arms[arm] for (where, _), arms in whole.items() if world in (where, TOGETHER)]
            for arm in wanted
        }
        for world in (*worlds, TOGETHER)
    }


def means(world: str, arm: str, rows: Sequence[Row]) -> list[str]:
    """The cells of one arm in one world."""
    near = statistics.mean(of(rows, NEAR)).text(2)
    return [
        *(world, arm, str(len(rows)), near, share(rows, HIT), share(rows, "mission_success")),
        *(statistics.mean(of(rows, name)).text(0) for name in DISTANCES),
    ]


def tested(worlds: Mapping[str, Arms], first: str, other: str) -> list[list[str]]:
    """The cells of every world: differences first - other. Holm's method over the worlds, not over all
    together."""

    def p_values(test: Callable[[Sequence[Row], Sequence[Row]], float]) -> list[float]:
        *each, every = [test(arms[other], arms[first]) for arms in worlds.values()]
        return [*statistics.holm(each), every]

    near = p_values(lambda before, after: statistics.signed_rank(of(before, NEAR), of(after, NEAR)))
    crash = p_values(
        lambda before, after: statistics.mcnemar(*statistics.discordant(hits(before, HIT), hits(after, HIT)))
    )
    lines = []
    for (world, arms), p_near, p_crash in zip(worlds.items(), near, crash, strict=True):
        before, after = arms[other], arms[first]
        changes = [statistics.paired_mean(of(before, n), of(after, n)) for n in (NEAR, *DISTANCES)]
        points = statistics.paired_share(hits(before, HIT), hits(after, HIT)).text(1, 100.0)
        lines.append(
            [
                *(world, f"{first} less {other}", str(len(before)), changes[0].text(2), f"{p_near:.2g}"),
                *(points, f"{p_crash:.2g}", *(change.text(0) for change in changes[1:])),
            ]
        )
    return lines


def gained(arms: Arms, name: str) -> Figure | None:
    """The share of the oracle's gain that prediction has, with a bootstrap interval over pairs; None where
    the interval of that gain holds 0."""
    gain = statistics.paired_mean(of(arms[WITHOUT], name), of(arms[ORACLE], name))
    if not (gain.low > 0.0 or gain.high < 0.0):
        return None

    def ratio(without: float, mine: float, oracle: float) -> float:
        return (mine - without) / (oracle - without) if oracle != without else math.nan

    return resampled(ratio, *(np.array(of(arms[arm], name)) for arm in ARMS))


def page(rows: Sequence[Row], about: Sequence[str]) -> list[str]:
    """The Markdown page of whatever all arms have driven."""
    worlds = paired(rows)
    lines = ["# What prediction is worth where humans err", "", *about, "", markdown_row(MEANS)]
    lines += [markdown_row(["---"] * len(MEANS))]
    lines += [markdown_row(means(w, arm, arms[arm])) for w, arms in worlds.items() for arm in ARMS]
    lines += ["", markdown_row(DIFFERENCES), markdown_row(["---"] * len(DIFFERENCES))]
    lines += [markdown_row(cells) for pair in PAIRS for cells in tested(worlds, *pair)]
    lines += [""]
    for name, what in ((NEAR, "near-misses of AVs"), ("dt_mean_m", "distance of all")):
        shares = {world: gained(arms, name) for world, arms in worlds.items()}
        known = "; ".join(f"{w} {one.text(0, 100.0)} %" for w, one in shares.items() if one is not None)
        nothing = ", ".join(world for world, one in shares.items() if one is None)
        lines.append(
            f"- Share of the oracle's gain in {what} that `vfn-p` has: {known or 'there is no gain'}."
        )
        lines.append(f"  The oracle gains nothing that these pairs show: {nothing or 'nowhere'}.")
    return lines


def drive(arms: Sequence[str], worlds: Sequence[str], out: Path, args: argparse.Namespace) -> list[Row]:
    """The rows of these arms in these worlds; what is in `out` is not driven again."""
    words = [word for world in worlds for word in ("--scenario", world)]
    words += [word for arm in arms for word in ("--policy", arm)]
    words += [*driving(args), "--behavior", BEHAVIOR, "--errors", LEVEL, "--svo", str(SVO)]
    if code := cosim(["evaluate", *words, "--no-report", "--out", str(out)]):
        raise SystemExit(code)
    return [row for row in run_folder.read(out).rows if row["status"] == OK]


def main() -> None:
    """Drive what is missing, write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options(parser, "foresight", "contested", WITH_MISSION)
    parser.set_defaults(episodes=60)
    args = parser.parse_args()
    seeds = f"{args.seeds_from}:{args.seeds_from + args.episodes}"
    rows = drive(ARMS, args.worlds, args.runs / "whole", args)
    about = [
        f"`{args.demand}`, {drivers(rows)}, errors `{LEVEL}`, seeds {seeds}, preset `lawful`, phi {SVO}",
        "degrees. Means with bootstrap, shares with Wilson's, differences of shares with Tango's 95 %",
        "intervals; p by Wilcoxon's signed ranks and McNemar's test, over the worlds by Holm's method.",
        "`vfn` sees no predicted map, and its mask expects constant speeds; the oracle tells networks and",
        "mask where everybody is in 4 s if AVs do as commanded and no human error begins",
        "(docs/reference/presets.md).",
        "",
        f"Made by `python -m benchmarks.foresight{asked(parser, args)}`.",
    ]
    write_page(args.out, page(rows, about))
    print(args.out.read_text())


if __name__ == "__main__":
    main()
