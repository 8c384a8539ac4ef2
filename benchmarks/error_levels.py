"""The tables of driver_errors.md: rates, effect of `stress` on IDM AVs, crashes of human drivers, cost.

    python -m benchmarks.error_levels [rates] [stress] [alone] [cost] [--episodes 40] [--page PAGE]

`stress`: AVs driven by SUMO's IDM, validation seeds, every scenario, dense and contested. `alone`: no AVs,
and errors of `field` at raised rates, so that brute force finds crashes. Results are scaled back, by the
factor of the rate for single errors, by the product of both factors for pairs. A pair is inattention behind
hard braking or a cut-in. `cost`: processor time of episodes in which all errors of `stress` are drawn but
none begins, against equal episodes without errors, alternating. Each table stands between a pair of markers
in the page; `rates` only reads sumo_scenarios/errors.yaml.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sumo_scenarios
from benchmarks.tables import fill, markdown_row
from cosim.episode import Episode, Hook, Step
from cosim.host import Host
from cosim.report.statistics import Z, paired_change, pooled_rate, rate, share
from cosim.scenario import Fleet, load
from cosim.scenario.human_errors import KINDS, Errors, Kinds, levels
from cosim.scenario.vet import vetted
from cosim.seeding import TUNING_SEEDS
from cosim.types import EpisodeResult
from cosim.workers.worker import Worker

RATES, MEASURED = Path("docs/explanation/driver_errors.md"), Path("docs/results/driver_errors.md")
DEMANDS = ("dense", "contested")
MILLION = 1e6  # km
RARE = 1e-15  # rate of an error that is drawn but never begins


class Raised(NamedTuple):
    """One line of `alone`."""

    name: str
    by: dict[str, float]  # kind -> factor on its rate in `field`
    factor: float  # by which the collisions of this line are more frequent
    parts: tuple[str, ...] = ()  # lines of the single kinds, to subtract their collisions


ALONE = (
    Raised("inattention", {"inattention": 800.0}, 800.0),
    Raised("hard braking", {"hard_braking": 100.0}, 100.0),
    Raised("cut-ins", {"cut_in": 300.0, "aborted_cut_in": 300.0}, 300.0),
    Raised("forced entries", {"forced_entry": 1000.0}, 1000.0),
    Raised("failures to yield", {"failure_to_yield": 200.0}, 200.0),
    Raised("stalled cars", {"stalled_car": 1000.0}, 1000.0),
    Raised(
        "hard braking ahead of an inattentive driver",
        {"hard_braking": 100.0, "inattention": 800.0},
        80_000.0,
        ("inattention", "hard braking"),
    ),
    Raised(
        "cut-ins ahead of an inattentive driver",
        {"cut_in": 300.0, "aborted_cut_in": 300.0, "inattention": 800.0},
        240_000.0,
        ("inattention", "cut-ins"),
    ),
)


class Kilometres(Hook):
    """The distance driven by all vehicles in the counted time."""

    def __init__(self) -> None:
        self.driven = 0.0  # km

    def on_step(self, episode: Episode, step: Step) -> None:
        """Speeds times the time between frames."""
        for frame in step.frames:
            self.driven += float(frame.vehicles.speed.sum()) * episode.scenario.timing.frame / 1000.0


@dataclass
class Tally:
    """Counts over several episodes."""

    episodes: int = 0
    av: int = 0  # episodes with an AV in a collision
    ended: int = 0  # episodes with a collision of an AV or the mission vehicle
    pairs: int = 0  # collisions
    near: int = 0  # near-misses by time to collision, if measured
    driven: float = 0.0  # km
    errors: Counter[str] = field(default_factory=Counter)

    def add(self, result: EpisodeResult, driven: float) -> None:
        """One episode."""
        crashes = [c for c in result.collisions if not c.insertion]
        near = result.metrics.get("near_misses_ttc")
        self.episodes += 1
        self.av += any(c.involves_av for c in crashes)
        self.ended += any(c.crash for c in crashes)
        self.pairs += len(crashes)
        self.near += int(near.value or 0) if near is not None else 0
        self.driven += driven
        self.errors.update(e.kind for e in result.errors_begun)


def places() -> list[tuple[str, str]]:
    """Every scenario with its demands among `DEMANDS`."""
    return [(w, d) for w in sumo_scenarios.names() for d in DEMANDS if d in (load(w).demands or {})]


def driven(name: str, demand: str, errors: Errors, episodes: int, fleet: Fleet | None = None) -> Tally:
    """Counts over episodes on validation seeds, with AVs driven by SUMO."""
    scenario = vetted(replace(load(name, demand=[demand], fleet=fleet), errors=errors))
    host, tally = Host(scenario, "idm", math.radians(45.0)), Tally()
    try:
        for seed in TUNING_SEEDS[:episodes]:
            hook = Kilometres()
            tally.add(host.run(seed, hooks=[hook]), hook.driven)
    finally:
        host.close()
    print(name, demand, tally, flush=True)
    return tally


def rates() -> list[str]:
    """The table of all kinds and levels."""
    shipped = levels()
    lines = [
        markdown_row(["kind", *shipped, "source of `field`"]),
        markdown_row(["---"] * (len(shipped) + 2)),
    ]
    for kind in KINDS:
        of = [getattr(level.kinds, kind) for level in shipped.values()]
        cells = [_with_scenarios(_magnitudes(one), name, kind) for one, name in zip(of, shipped, strict=True)]
        lines.append(markdown_row([f"`{kind}`", *cells, of[0].source]))
    return lines


def stress(episodes: int) -> list[str]:
    """The table for IDM AVs among human drivers with errors of level `stress`."""
    heads = "scenario, demand, with an AV in a collision, ended by a crash, collisions an episode"
    heads += ", errors an episode"
    lines = [markdown_row(heads.split(", ")), markdown_row(["---"] * 6)]
    for name, demand in places():
        t = driven(name, demand, levels(name)["stress"], episodes)
        hit = share(t.av, t.episodes)
        interval = f"{100 * hit.value:.0f} % ({100 * hit.low:.0f} to {100 * hit.high:.0f})"
        cells = [name, demand, interval, f"{100 * t.ended / t.episodes:.0f} %"]
        counts = (f"{n / t.episodes:.1f}" for n in (t.pairs, t.errors.total()))
        lines.append(markdown_row([*cells, *counts]))
    return lines


def alone(episodes: int) -> list[str]:
    """The table for human drivers without AVs at raised rates of `field`, scaled back to its own rates.

    Near-misses happen without errors too: the effect of errors is the difference to the first line.
    """
    base = levels()["field"]
    heads = "raised, by, km, collisions, near-misses, per million km at the rates of `field`: collisions"
    heads += ", near-misses that errors add"
    lines = [markdown_row(heads.split(", ")), markdown_row(["---"] * 7)]
    raw: dict[str, float] = {}  # collisions per million km
    added: dict[str, tuple[float, float]] = {}  # near-misses per million km, and their variance
    each: list[tuple[bool, float]] = []  # (whether a collision, weight of a collision)
    collisions = near_misses = variance = 0.0
    for name, factors, factor, parts in (Raised("nothing", {}, 1.0), *ALONE):
        kinds = Kinds(**{kind: _raised(getattr(base.kinds, kind), by) for kind, by in factors.items()})
        errors = Errors(name, "", kinds, base.file)
        tallies = [
            driven(w, d, errors, episodes, Fleet(penetration=0.0)) for w, d in places() if d == "dense"
        ]
        km, pairs, near = (sum(getattr(t, n) for t in tallies) for n in ("driven", "pairs", "near"))
        by = " and ".join(f"{by:g}" for by in dict.fromkeys(factors.values()))
        cells = [name, by, f"{km:,.0f}", str(pairs), str(near)]
        found = near / km * MILLION, near / km**2 * MILLION**2
        if not factors:
            without = found
            lines.append(markdown_row([*cells, "", f"({_signed(*found)} without errors)"]))
            continue
        raw[name] = pairs / km * MILLION
        added[name] = found[0] - without[0], found[1] + without[1]
        per = max(raw[name] - sum(raw[part] for part in parts), 0.0) / factor
        of = rate(pairs, km * factor / MILLION)
        bounds = f"at most {of.high:.2g}" if parts or not pairs else f"{of.low:.2g} to {of.high:.2g}"
        here = (added[name][0] - sum(added[part][0] for part in parts)) / factor
        spread = (added[name][1] + sum(added[part][1] for part in parts)) / factor**2
        lines.append(markdown_row([*cells, f"{per:.2g} ({bounds})", _signed(here, spread)]))
        collisions, near_misses, variance = collisions + per, near_misses + here, variance + spread
        each += [(pairs > 0, MILLION / (km * factor))] * max(pairs, 1)
    counts, weights = (np.array(values, float) for values in zip(*each, strict=True))
    pooled = pooled_rate(counts, 1.0 / (len(weights) * weights), weights)
    together = f"{collisions:.2g} ({pooled.low:.2g} to {pooled.high:.2g})"
    return [*lines, markdown_row(["together", "", "", "", "", together, _signed(near_misses, variance)])]


def _signed(value: float, variance: float) -> str:
    """The value with its normal 95 % interval, rounded to two digits of the interval."""
    half = Z * math.sqrt(variance)
    digits = max(1 - math.floor(math.log10(half)), 0) if half else 0
    return f"{value:,.{digits}f} ({value - half:,.{digits}f} to {value + half:,.{digits}f})"


def cost(episodes: int) -> list[str]:
    """The table of the cost of drawing: equal drives with and without trials, none of which succeeds."""
    base = levels()["stress"]
    drawn = Errors(
        "drawn", "", Kinds(**{k: replace(getattr(base.kinds, k), rate=RARE) for k in KINDS}), base.file
    )
    heads = ["episodes", "s without", "s with", "more, %"]
    lines = [markdown_row(heads), markdown_row(["---"] * len(heads))]
    every: list[tuple[float, float]] = []
    for name, demand in places():
        scenario = load(name, demand=[demand])
        scenarios = [vetted(replace(scenario, errors=errors)) for errors in (None, drawn)]
        took: list[tuple[float, float]] = []
        with Worker(Timed, scenarios[0], "idm", 0.0) as one, Worker(Timed, scenarios[1], "idm", 0.0) as other:
            for seed in TUNING_SEEDS[: episodes + 1]:
                (without, before), (with_, after) = (w.call("timed", seed) for w in (one, other))
                assert before == after, "an error has begun"
                took.append((without, with_))
        every += took[1:]  # the first one is a warm-up
    return [*lines, _cost_row(every)]


class Timed(Host):
    """A host in a worker process, since a process can hold only one simulation."""

    def timed(self, seed: int) -> tuple[float, str]:
        """Processor time (s) of an episode, and the hash of its trace."""
        begin = time.process_time()
        result = self.run(seed)
        return time.process_time() - begin, result.trace_hash


def _cost_row(took: Sequence[tuple[float, float]]) -> str:
    without, with_ = (list(each) for each in zip(*took, strict=True))
    more = paired_change(without, with_).text(1, 100.0)
    means = (f"{sum(each) / len(each):.3f}" for each in (without, with_))
    return markdown_row([str(len(took)), *means, more])


def _raised(kind: Any, by: float) -> Any:
    return replace(kind, rate=min(kind.rate * by, 1.0))


def _magnitudes(kind: Any) -> str:
    """`0.008; duration 1 to 3`"""
    if kind is None:
        return "-"
    more = {k: v for k, v in asdict(kind).items() if k not in ("rate", "source")}
    words = [f"{k} {v[0]:g} to {v[1]:g}" if isinstance(v, tuple) else f"{k} {v:g}" for k, v in more.items()]
    return "; ".join([f"{kind.rate:.2g}", *words])


def _with_scenarios(everywhere: str, level: str, kind: str) -> str:
    """The magnitudes, with the deviating ones of single scenarios."""
    of = {name: _magnitudes(getattr(levels(name)[level].kinds, kind)) for name in sumo_scenarios.names()}
    return "; ".join([everywhere, *(f"{w}: {said}" for w, said in of.items() if said != everywhere)])


TABLES = {"stress": stress, "alone": alone, "cost": cost}


def main() -> None:
    """Make the requested tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="*", choices=("rates", *TABLES), default=["rates"])
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--page", type=Path, metavar="PAGE", help=f"default: {RATES} (rates), {MEASURED}")
    args = parser.parse_args()
    for name in args.tables:
        page = args.page or (RATES if name == "rates" else MEASURED)
        fill(page, name, rates() if name == "rates" else TABLES[name](args.episodes))


if __name__ == "__main__":
    main()
