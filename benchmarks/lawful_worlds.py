"""Preset `lawful` against `unguarded` in our five worlds: crashes, hard brakings, distances.

    python -m benchmarks.lawful_worlds [--policies vfn-p ...] [--episodes 100] [--worlds merge ...]
        [--runs runs/lawful] [--workers 2] [--out PAGE]

The policies drive `dense` from test seed 200,000 on; the same command goes on where it stopped. What the way
that `lawful` is shorter comes from is taken away: the same networks in `unguarded` no faster than the limit
(`WithinLimit`), and in `lawful` in cars that keep no longer headway before humans (`ShortHeadway`). How far
anybody gets who keeps to the limit: `Hurries` and `HurriesCloser`, whom nothing but the limit and the leader
holds back. Writes docs/results/lawful_worlds.md.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import sumo_scenarios
from benchmarks.tables import markdown_row, write_page
from cosim.cli.main import main as cosim
from cosim.control import next_target
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.seeding import FIRST_TEST_SEED
from cosim.simulation import assistance
from cosim.simulation.backend import sumo
from cosim.simulation.fleet import AV_LANE_CHANGE, set_type
from cosim.types import Decision, History, PolicyContext, Preset
from cosim.workers.tasks import OK
from policy import agents
from policy.agents.idm import ACCEL, Idm

PAGE = Path("docs/results/lawful_worlds.md")
IDM = "idm"
WITHIN = "within-limit"  # `WithinLimit`, in `unguarded`
SHORT = "short-headway"  # `ShortHeadway`, in `lawful`
HURRIES, CLOSER = "hurries", "hurries-closer"  # `Hurries`, `HurriesCloser`, in `lawful`
FEWER = 3.0  # how many times fewer hard brakings are asked for
COLUMNS = (
    "world", "episodes", "crashed", "hard brakings of AVs", "of it in unguarded", "distance of all, m",
    "less what it is in unguarded, m", "the same of AVs, m", "too fast in unguarded",
    "mission", "in unguarded", "interventions", "idm less unguarded, m", "within the limit less unguarded, m",
    "lawful less within the limit, m", "with the short headway less lawful, m",
    "in a hurry less unguarded, m", "in a hurry and closer less unguarded, m", "targets",
)  # fmt: skip


class Changed:
    """`cosim.types.Policy`: `vfn-p`, with something taken away."""

    def __init__(self) -> None:
        self._inner = agents.make("vfn-p")
        self.observation = self._inner.observation
        self.files = getattr(self._inner, "files", ())

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        self._inner.reset(context)
        self._hold = context.timing.decision  # s

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """What `vfn-p` decides."""
        return dict(self._inner.decide(histories))


class WithinLimit(Changed):
    """No command leads above the limit of its lane."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Where a decision leads above the limit, it reaches the limit and stays there."""
        return {av: self._within(histories[av], d) for av, d in super().decide(histories).items()}

    def _within(self, seen: History, decision: Decision) -> Decision:
        limit, speed = seen.route.speed_limit, seen.ego_speed
        if next_target(seen.target_speed, speed, decision.action, limit) <= limit:
            return decision
        return decision._replace(accel=(limit - speed) / self._hold)


class ShortHeadway(Changed):
    """The car keeps no longer headway before humans; it changes the car of its process."""

    def __init__(self) -> None:
        super().__init__()
        assistance.HEADWAY = assistance.HEADWAY[:1] * 2
        assistance.STANDS = assistance.STANDS[:1] * 2


class Hurries(Idm):
    """SUMO's Krauss driver without imperfections in every AV: as fast as the limit and its leader let it, as
    close to him as `TIME_GAP` and `STANDSTILL` say, on nobody's behalf but its own."""

    name = HURRIES
    TIME_GAP, STANDSTILL, DECEL = 0.5, 1.0, 4.5  # s, m, m/s2

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self._changed: set[str] = set()

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Nobody is commanded; whoever is new gets that driver."""
        get = sumo.vehicle
        for av in histories.keys() - self._changed:
            krauss = f"{get.getTypeID(av).partition('@')[0]}.krauss"
            if krauss not in sumo.vehicletype.getIDList():
                sumo.vehicletype.copy("DEFAULT_VEHTYPE", krauss)
            set_type(av, krauss)
            get.setImperfection(av, 0.0)
            get.setTau(av, self.TIME_GAP)
            get.setMinGap(av, self.STANDSTILL)
            get.setAccel(av, ACCEL)
            get.setDecel(av, self.DECEL)
            for name, value in AV_LANE_CHANGE.items():
                get.setParameter(av, name, value)
        self._changed |= histories.keys()
        return {}


class HurriesCloser(Hurries):
    """The same, nearer to its leader than any driver may be."""

    name = CLOSER
    TIME_GAP, STANDSTILL, DECEL = 0.2, 0.5, 8.0


OURS: Mapping[str, type[Changed | Idm]] = {
    WITHIN: WithinLimit, SHORT: ShortHeadway, HURRIES: Hurries, CLOSER: HurriesCloser,
}  # fmt: skip


def by_seed(folder: Path, policy: str, preset: str) -> dict[str, dict[int, Row]]:
    """World -> seed -> the row of `dense` among mixed drivers."""
    found: dict[str, dict[int, Row]] = {}
    for row in run_folder.read(folder).rows:
        named = tuple(
            row[name] for name in ("policy", "preset", "demand", "behavior", "driver_model", "status")
        )
        if named == (policy, preset, "dense", "mixed", "lc2013", OK):
            found.setdefault(str(row["scenario"]), {})[int(row["seed"])] = row
    return found


Rows = Mapping[int, Row]  # by seed


def line(world: str, lawful: Rows, before: Rows, beside: Mapping[str, Rows]) -> list[str]:
    """One world's cells, paired by seed; crashes of all count. `before`: in `unguarded`."""
    seeds = sorted(lawful.keys() & before.keys() & beside[WITHIN].keys() & beside[IDM].keys())
    now, then = ([rows[s] for s in seeds] for rows in (lawful, before))

    def column(rows: list[Row], name: str) -> list[float]:
        return [float(row[name]) for row in rows if row.get(name) is not None]

    crashed = statistics.share(sum(map(bool, column(now, "crashed"))), len(now))
    hard, hard_before = (float(np.mean(column(rows, "hard_brakings_av"))) for rows in (now, then))

    def further(rows: Rows, others: Rows) -> statistics.Figure:
        both = [seed for seed in seeds if seed in rows and seed in others]
        before, after = (column([arm[seed] for seed in both], "dt_mean_m") for arm in (others, rows))
        return statistics.paired_mean(before, after)

    way = further(lawful, before)
    both = [pair for pair in zip(then, now, strict=True) if all(row["dt_av_m"] is not None for row in pair)]
    before_avs, now_avs = (column(list(rows), "dt_av_m") for rows in zip(*both, strict=True))
    of_avs = statistics.paired_mean(before_avs, now_avs)
    too_fast = float(np.mean(column(then, "speeding_share")))
    missions = [
        statistics.share(int(sum(v)), len(v)) for v in (column(r, "mission_success") for r in (now, then))
    ]
    missed = [
        name
        for name, wrong in (
            ("crashes", crashed.value > 0.0),
            ("hard brakings", hard * FEWER > hard_before),
            ("distance", way.high < 0.0),
        )
        if wrong
    ]
    return [
        *(world, str(len(seeds)), f"{crashed.text(1, 100.0)} %", f"{hard:.1f}", f"{hard_before:.1f}"),
        *(
            f"{np.mean(column(now, 'dt_mean_m')):.1f}",
            way.text(1),
            of_avs.text(1),
            f"{100.0 * too_fast:.0f} %",
        ),
        *(f"{m.text(0, 100.0)} %" if m.known else "-" for m in missions),
        *(
            f"{np.mean(column(now, 'interventions')):.1f}",
            further(beside[IDM], before).text(1),
            further(beside[WITHIN], before).text(1),
            further(lawful, beside[WITHIN]).text(1),
            further(beside[SHORT], lawful).text(1),
            further(beside[HURRIES], before).text(1),
            further(beside[CLOSER], before).text(1),
            "missed: " + ", ".join(missed) if missed else "met",
        ),
    ]


def driven(policy: str, preset: str, args: argparse.Namespace) -> dict[str, dict[int, Row]]:
    """World -> seed -> row; what is missing is driven."""
    episodes = min(args.episodes, args.changed) if policy == SHORT else args.episodes
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + episodes)
    out = args.runs / f"{policy}-{preset}"
    own = OURS.get(policy)
    named = f"{policy}=benchmarks.lawful_worlds:{own.__name__}" if own else policy
    words = [word for world in args.worlds for word in ("--scenario", world)]
    words += ["--demand", "dense", "--policy", named, "--preset", preset]
    words += ["--seeds", f"{seeds.start}:{seeds.stop}", "--resume", "--workers", args.workers]
    words += ["--duration", args.duration] if args.duration else []
    if code := cosim(["evaluate", *words, "--no-report", "--out", str(out)]):
        raise SystemExit(code)
    return by_seed(out, policy, preset)


def main() -> None:
    """Drive what is missing, write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policies", nargs="+", default=["vfn-p"])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--changed", type=int, default=40, help="episodes a world in a car that is changed")
    parser.add_argument("--worlds", nargs="+", default=sumo_scenarios.names(), choices=sumo_scenarios.names())
    parser.add_argument("--duration", metavar="S", help="counted s an episode; default: the worlds' own")
    parser.add_argument("--runs", type=Path, default=Path("runs/lawful"), help="where episodes are kept")
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--workers", default="2")
    args = parser.parse_args()
    lines = [
        "# Our worlds in preset `lawful`",
        "",
        f"`dense`, mixed drivers (`lc2013`), errors `none`, phi 45 degrees, {args.episodes} seeds from",
        f"{FIRST_TEST_SEED:,}; the same seeds in `unguarded`. There AVs drive up to the limit + 2 m/s, in",
        "`lawful` up to the limit: where the road is free that alone is a shorter way. Too fast: share of",
        "the AVs' time that they are more than 0.5 m/s above the limit. Targets: no crash, a third of the",
        "hard brakings at most, the distance of all not below (interval). Rates with Wilson, differences",
        "with bootstrap intervals (95 %). `idm`: SUMO's own driver in every vehicle, up to the limit. Within",
        "the limit: the same networks in `unguarded`, but no command leads above the limit of the lane.",
        "Short headway: in `lawful`, but the car keeps no longer headway before humans (on the first",
        f"{min(args.episodes, args.changed)} seeds). In a hurry: SUMO's Krauss driver without imperfections",
        f"in every AV, which accelerates with {ACCEL:g} m/s2 up to the limit and follows its leader",
        f"{Hurries.TIME_GAP:g} s and {Hurries.STANDSTILL:g} m behind; closer:",
        f"{HurriesCloser.TIME_GAP:g} s and {HurriesCloser.STANDSTILL:g} m.",
        "",
        "Made by `python -m benchmarks.lawful_worlds`.",
    ]
    presets = {WITHIN: Preset.UNGUARDED, **dict.fromkeys((IDM, SHORT, HURRIES, CLOSER), Preset.LAWFUL)}
    beside = {name: driven(name, preset, args) for name, preset in presets.items()}
    for policy in args.policies:
        lawful, before = (driven(policy, preset, args) for preset in (Preset.LAWFUL, Preset.UNGUARDED))
        rows = [
            line(world, lawful[world], before[world], {name: arm[world] for name, arm in beside.items()})
            for world in sorted(lawful)
        ]
        lines += ["", f"## {policy}", "", markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
        lines += map(markdown_row, rows)
    write_page(args.out, lines)
    print(args.out.read_text())


if __name__ == "__main__":
    main()
