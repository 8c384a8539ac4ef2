"""At which phi AVs begin to yield, and at which one their reward begins to ask for it.

    python -m benchmarks.turn [--policy vfn-p] [--episodes 10] [--errors none] [--out PAGE] [--workers 2]

One network drives every contested world with a mission vehicle on equal test seeds at phi 0, 15, ... 90
degrees, preset `lawful`, without human errors or (with a page and rows of its own) with them. The turn is the
angle at which the share of mission vehicles that are let in crosses the middle between 0 degrees and its
largest, interpolated between the two driven angles that it lies between. The reward is cos(phi) own +
sin(phi) others' (P, equation 6), so that of two ways of driving the kinder one earns more from the angle on
at which tan(phi) = own reward lost / others' reward gained: the break-even of the drives at 0 and at 90
degrees.
Rows are kept in --rows, and not driven twice; those of other weights under the policy's name are driven anew.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture

from benchmarks.tables import markdown_row, write_page
from benchmarks.worlds import WITH_MISSION
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.record import planned
from cosim.cli.arguments import seeds as seeds_of
from cosim.episode import Episode, Step
from cosim.files import write_csv
from cosim.host import Earnings
from cosim.learning.prediction_data import spread
from cosim.policies import make
from cosim.report.statistics import CONFIDENCE, RESAMPLES, Figure, holm, mean, paired_mean, share, signed_rank
from cosim.rewards import RewardConfig
from cosim.scenario.human_errors import NONE
from cosim.scenario.manifest import digests
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import read as read_name
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Floats, Ints
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task
from research.picture import save

RESULTS = Path("docs/results")
DEMAND = "contested"
PHIS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # degrees
COLUMNS = (
    *("phi", "episodes", "let in", "its time, s", "of AVs, m", "of all, m"),
    *("own reward", "others' reward", "its time, p", "of AVs, p"),
)
# `rewards.yaml` of commit f591cb8, by which `vfn-p` learned
REWARD = RewardConfig(eta=0.0, social=0.02, mission=200.0, perception_range=250.0)


@dataclass(frozen=True, slots=True)
class Drive:
    """One episode."""

    policy: str
    world: str
    phi: float  # degrees
    seed: int
    served: bool
    time: float  # s until the mission vehicle was let in; the episode's duration where it was not
    av_m: float  # mean distance of the AVs
    all_m: float
    own: float  # reward per AV and decision, of cos(phi)
    others: float  # and of sin(phi)
    crashed: bool
    weights: str = ""  # what tells the policy's files apart


class Parts(Earnings):
    """What the AVs earn themselves and by others, before it is weighed."""

    def __init__(self) -> None:
        super().__init__(REWARD, 0.0)
        self.own: list[float] = []
        self.others: list[float] = []

    def on_step(self, episode: Episode, step: Step) -> None:
        """One decision of every AV that was on the road."""
        for terms in self.pay(step, step.before.avs).values():
            self.own.append(terms.ego)
            self.others.append(terms.av_social + terms.hv_social)


class Earning(EpisodeRunner):
    """Hosted by an engine's worker."""

    def run(self, case: EpisodeOptions, progress: Progress) -> Drive:  # type: ignore[override]
        """Drives and adds up both parts of the reward."""
        host, parts = self.open(case, ()), Parts()
        result = host.run(case.seed, progress, hooks=[parts]).document()
        time = result["mission_time_s"] if result["mission_success"] else host.episode.scenario.duration
        return Drive(
            *(case.policy, result["scenario"], case.svo_deg, case.seed),
            *(bool(result["mission_success"]), float(time), result["dt_av_m"], result["dt_mean_m"]),
            *(float(np.mean(parts.own)), float(np.mean(parts.others)), bool(result["crashed"])),
        )


def columns(drives: Sequence[Drive], name: str) -> Floats:
    """One figure [episodes, PHIS], by seeds that were driven at all of them."""
    found: dict[int, dict[float, float]] = {}
    for drive in drives:
        found.setdefault(drive.seed, {})[drive.phi] = float(getattr(drive, name))
    whole = [seed for seed, by_phi in sorted(found.items()) if set(PHIS) <= set(by_phi)]
    return np.array([[found[seed][phi] for phi in PHIS] for seed in whole]).reshape(-1, len(PHIS))


def break_even(own: Floats, others: Floats) -> float:
    """Degrees from which on driving as at 90 degrees earns more than driving as at 0; nan: at none or always.

    Both [..., PHIS], means over episodes.
    """
    lost, gained = own[0] - own[-1], others[-1] - others[0]
    return math.degrees(math.atan2(lost, gained)) if lost >= 0.0 and gained > 0.0 else math.nan


def first_worth(own: Floats, others: Floats) -> tuple[float, float]:
    """Degrees from which on any driven way earns more than driving as at 0, and at which phi that is driven.

    Arguments as of `break_even`; nan, nan: none ever does.
    """
    found = [(break_even(own[[0, k]], others[[0, k]]), PHIS[k]) for k in range(1, len(PHIS))]
    return min((one for one in found if not math.isnan(one[0])), default=(math.nan, math.nan))


def crossing(served: Floats) -> tuple[float, float, float]:
    """Where the share [PHIS] first crosses the middle between that at 0 degrees and the largest: the driven
    angles before and after, and the angle between them by interpolation, degrees; nan: it does not rise."""
    middle = 0.5 * (served[0] + served.max())
    if served.max() > served[0]:
        for (low, high), (before, after) in zip(pairwise(PHIS), pairwise(served), strict=True):
            if before <= middle < after:
                return low, high, low + (high - low) * float((middle - before) / (after - before))
    return math.nan, math.nan, math.nan


def turn(served: Floats) -> Figure:
    """Degrees at which the share [episodes, PHIS] crosses; from the driven angle before the interval's lower
    end to the one after its upper end, by the bootstrap over episodes."""
    before, after, between = (resampled(lambda share, k=k: crossing(share)[k], served) for k in range(3))
    return Figure(between.value, before.low, after.high)


def resampled(statistic: Callable[..., float], *figures: Floats) -> Figure:
    """A statistic of means over episodes, with the percentile bootstrap's interval over episodes (seeds)."""
    rng, count = np.random.default_rng(0), len(figures[0])
    draws: Ints = rng.integers(0, count, (RESAMPLES, count))
    value = float(statistic(*(figure.mean(0) for figure in figures)))
    found = np.array([statistic(*(figure[rows].mean(0) for figure in figures)) for rows in draws])
    known = found[~np.isnan(found)]
    if len(known) < CONFIDENCE * RESAMPLES:
        return Figure(value, math.nan, math.nan)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(known, [tail, 100.0 - tail])
    return Figure(value, float(low), float(high))


def table(drives: Sequence[Drive]) -> list[str]:
    """One world: a line per phi, with tests of the step from the phi before."""
    time, av, every, own, others = (columns(drives, n) for n in ("time", "av_m", "all_m", "own", "others"))
    served = columns(drives, "served")
    steps = range(1, len(PHIS))
    later, shorter = (holm([signed_rank(f[:, k - 1], f[:, k]) for k in steps]) for f in (time, av))
    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    for k, phi in enumerate(PHIS):
        tested = ["", ""]
        if k:
            tested = [
                f"{paired_mean(f[:, k - 1], f[:, k]).value:+.1f}, {p[k - 1]:.2g}"
                for f, p in ((time, later), (av, shorter))
            ]
        let_in = share(int(served[:, k].sum()), len(served)).text(0, 100.0)
        figures = [mean(f[:, k]).text(d) for f, d in ((time, 1), (av, 0), (every, 0), (own, 3), (others, 3))]
        lines.append(markdown_row([f"{phi:g}", str(len(served)), f"{let_in} %", *figures, *tested]))
    return lines


def verdict(drives: Sequence[Drive]) -> str:
    """Turn and break-even in a sentence."""
    served, own, others = (columns(drives, n) for n in ("served", "own", "others"))
    turns, even = turn(served), resampled(break_even, own, others)
    least, driven = first_worth(own.mean(0), others.mean(0))
    crashed = sum(drive.crashed for drive in drives)
    said = "the interval of the turn misses it"
    if turns.low <= even.value <= turns.high:
        said = "the interval of the turn holds it"
    elif turns.low <= even.high and even.low <= turns.high:
        said = "the interval of the turn misses it, both intervals overlap"
    if math.isnan(turns.low):
        said = "too few seeds for an interval of the turn"
    return (
        f"Turn {turns.text(0)} degrees, break-even of the reward {even.text(0)} degrees: {said}. Driving as"
        f" at {driven:g} degrees earns more than as at 0 from {least:.0f} degrees on. Episodes with a crash:"
        f" {crashed} of {len(drives)}."
    )


def picture(drives: Mapping[str, Sequence[Drive]], path: Path) -> str:
    """A panel per world: share let in and the AVs' distance over phi, and the break-even (Markdown)."""
    drawn = Picture(figsize=(3.2 * len(drives), 3.0), layout="constrained")
    panels = drawn.subplots(1, len(drives), squeeze=False, sharey=True)[0]
    for axes, (world, mine) in zip(panels, drives.items(), strict=True):
        served, av = columns(mine, "served"), columns(mine, "av_m")
        shares = [share(int(column.sum()), len(column)) for column in served.T]
        bars = np.array([[s.value - s.low, s.high - s.value] for s in shares]).T.clip(0.0)
        axes.errorbar(PHIS, [s.value for s in shares], bars, fmt="o-", ms=4, label="let in")
        axes.plot(PHIS, av.mean(0) / av[:, 0].mean(), "s--", ms=3, label="AVs' distance, of that at 0")
        even = resampled(break_even, columns(mine, "own"), columns(mine, "others"))
        if even.known:
            axes.axvline(even.value, color="C3", lw=1.0, label="break-even of the reward")
            axes.axvspan(even.low, even.high, color="C3", alpha=0.15)
        axes.set(title=world, xlabel="phi, degrees", ylim=(-0.05, 1.1), xticks=PHIS)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize="x-small")
    save(drawn, path)
    return f"![{path.stem}]({path.name})"


def read(path: Path) -> dict[tuple[str, str, float, int], Drive]:
    """What was driven before."""
    if not path.is_file():
        return {}
    made: dict[str, Callable[[str], Any]]
    made = {"str": str, "float": float, "int": int, "bool": "True".__eq__}
    with path.open(newline="") as file:
        rows = [
            Drive(**{f.name: made[str(f.type)](row[f.name]) for f in fields(Drive) if f.name in row})
            for row in csv.DictReader(file)
        ]
    return {(d.policy, d.world, d.phi, d.seed): d for d in rows}


def weights_of(policy: str) -> str:
    """Twelve digits that tell the files of a policy apart; none where it has none."""
    files = digests(getattr(make(policy), "files", ()))
    return hashlib.sha256(json.dumps(sorted(files.items())).encode()).hexdigest()[:12] if files else ""


def main() -> None:
    """Drive what is missing, write rows, picture and page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", default="vfn-p")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seeds", type=seeds_of, help="in place of --episodes of the test seeds")
    parser.add_argument("--worlds", nargs="+", default=list(WITH_MISSION), choices=WITH_MISSION)
    parser.add_argument("--errors", default=NONE, help="of human drivers: none, field, stress or a file")
    parser.add_argument("--duration", type=float, help="counted s an episode; default: the worlds' own")
    parser.add_argument("--rows", type=Path, help="default docs/results/data/turn.csv")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="default docs/results/turn.md, or turn_stress.md")
    args = parser.parse_args()
    name = "turn" if args.errors == NONE else f"turn_{Path(args.errors).stem}"
    out, kept = args.out or RESULTS / f"{name}.md", args.rows or RESULTS / "data" / f"{name}.csv"
    seeds = args.seeds or range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.episodes)
    asked = f"--seeds {seeds.start}:{seeds.stop}" if args.seeds else f"--episodes {args.episodes}"
    asked += "" if args.errors == NONE else f" --errors {args.errors}"
    asked += "" if args.duration is None else f" --duration {args.duration:g}"
    policy, weights = read_name(args.policy).text, weights_of(args.policy)
    done = {k: d for k, d in read(kept).items() if d.policy != policy or d.weights == weights}
    for world in args.worlds:
        what = {"scenario": world, "demand": DEMAND, "policy": policy, "svo": [*PHIS]}
        plan = planned(seeds, **what, duration=args.duration, errors=args.errors)
        cases = [
            case for _, case in plan.cases() if (case.policy, world, case.svo_deg, case.seed) not in done
        ]
        tasks = [Task(case.key, case.cell, (case,)) for case in cases]
        for drive in spread(LocalEngine(Earning, workers=args.workers), tasks, world):
            key = (drive.policy, drive.world, drive.phi, drive.seed)
            done[key] = replace(drive, weights=weights)
        write_csv(kept, [asdict(done[key]) for key in sorted(done)])
    drives = {
        world: [d for d in done.values() if d.world == world and d.policy == policy and d.seed in seeds]
        for world in args.worlds
    }
    lines = [
        *("# At which phi the AVs begin to yield", ""),
        f"Made by `python -m benchmarks.turn --policy {args.policy} {asked}`: "
        f"seeds {seeds.start}:{seeds.stop},",
        f"`{DEMAND}`, moderate drivers (`lc2013`), errors `{args.errors}`, preset `lawful`. Equal seeds at",
        "every phi; shares with Wilson's, means with bootstrap 95 % intervals. A mission vehicle that is",
        "not let in counts with the episode's whole duration. Rewards are those of",
        "`rewards.yaml` (commit f591cb8), per AV and decision,",
        "before they are weighed. p: the step from the phi before, mean difference and",
        "Wilcoxon's signed ranks, over the six steps by Holm's method. Turn: where the share let in crosses",
        "the middle between 0 degrees and its largest, interpolated between the driven angles; its interval",
        "goes from one driven angle to another: nothing was driven between them. Break-even: where",
        "driving as at 90 degrees begins to earn more than as at 0. Bootstrap intervals over seeds.",
        *("", picture(drives, out.with_suffix(".svg")), ""),
    ]
    for world, mine in drives.items():
        lines += [f"## {world}", "", *table(mine), "", verdict(mine), ""]
    write_page(out, lines)
    print(out.read_text())


if __name__ == "__main__":
    main()
