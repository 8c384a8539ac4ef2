"""Arrivals with AVs in networks of other authors, compared with the same demand without AVs.

    python -m benchmarks.throughput [--seeds A:B] [--nets NAME ...] [--config FILE.sumocfg ...]
                                    [--duration S] [--workers N] [--again] [--out docs/results]

Drives A10KW, a motorway interchange, on every seed and the other games of the eclipse-sumo package on the
first; `--config` drives your own network instead. Rows are kept in docs/results/data/throughput.csv; the page
is made from them. Needs `pip install '.[tools]'`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from benchmarks.drives import Case, measure
from benchmarks.real_nets import a10kw
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.cli.arguments import seeds as seed_range
from cosim.report.statistics import paired_change

RESULTS = Path("docs/results")
PAGE, DATA = "throughput.md", "data/throughput.csv"
NETS = ("A10KW", "corridor", "cross_demo", "fokr_bs_demo", "grid6", "ramp", "square")  # those with >= 18 AVs
FIRST, SEEDS = 300_000, 10
LONGEST = 900.0  # s of each drive
NONE, CAR = "no AVs", "the lawful car"
SHARE = 0.2
DRIVERS: dict[str, dict[str, Any]] = {
    NONE: {"policy": "idm", "penetration": 0.0, "traffic": "controlled"},  # the SUMO options of the others
    "`idm`": {"policy": "idm", "penetration": SHARE},
    "`idm-courteous`": {"policy": "idm-courteous", "penetration": SHARE},
    CAR: {"policy": "car-alone", "penetration": SHARE, "svo_deg": 45.0},
    "`yield-rule`": {"policy": "yield-rule", "penetration": SHARE, "svo_deg": 45.0},
}


class Drive(NamedTuple):
    """A row of the CSV."""

    network: str
    driver: str
    seed: int
    arrivals: float
    total_delay_s: float
    avs_stuck: float
    av_involved_collisions: float
    av_caused_collisions: float


def cases(configs: Sequence[Path], seeds: range, every: bool, duration: float) -> Iterator[Case]:
    """Every requested episode; `every`: all networks on every seed, else only A10KW."""
    for config in configs:
        for seed in seeds if every or config.stem == "A10KW" else seeds[:1]:
            for driver, options in DRIVERS.items():
                wanted = {"what": str(config), "seed": seed, "duration": duration, **options}
                yield Case((config.stem, driver, seed), wanted)


def page(rows: Sequence[Drive], duration: float) -> list[str]:
    """The page; `duration`: s of each drive."""
    columns = ["network", "seeds", "driver", "arrivals", "change", "total delay, s", "AVs stuck"]
    columns += ["collisions with an AV", "caused by AVs"]
    lines = markdown_head(columns)
    networks: list[str] = []
    for network in dict.fromkeys(row.network for row in rows):
        of = {(row.driver, row.seed): row for row in rows if row.network == network}
        seeds = [seed for driver, seed in of if driver == NONE and all((d, seed) in of for d in DRIVERS)]
        if not seeds:
            continue
        networks.append(network)
        before = [of[NONE, seed].arrivals for seed in seeds]
        for driver in DRIVERS:
            drives = [of[driver, seed] for seed in seeds]
            lines.append(markdown_row([network, str(len(seeds)), driver, *_cells(before, drives)]))
    return WORDS.format(
        table="\n".join(lines), longest=duration, nets=" ".join(networks), data=DATA
    ).splitlines()


def _cells(before: Sequence[float], drives: Sequence[Drive]) -> list[str]:
    """The cells of one driver on one network; `before`: arrivals without AVs, seed by seed."""
    arrived = [one.arrivals for one in drives]
    counts = (
        sum(getattr(one, name) for one in drives)
        for name in ("avs_stuck", "av_involved_collisions", "av_caused_collisions")
    )
    return [
        f"{fmean(arrived):,.0f}",
        "" if drives[0].driver == NONE else _change(before, arrived),
        f"{fmean(one.total_delay_s for one in drives):.0f}",
        *("" if math.isnan(count) or drives[0].driver == NONE else f"{count:.0f}" for count in counts),
    ]


def _change(before: Sequence[float], after: Sequence[float]) -> str:
    """`-1.2 % (-2.0 to -0.4)`; no interval of fewer than five pairs."""
    if not any(before):
        return ""
    found = paired_change(before, after)
    bounds = f" ({100.0 * found.low:+.1f} to {100.0 * found.high:+.1f})" if len(before) >= 5 else ""
    return f"{100.0 * found.value:+.1f} %{bounds}"


WORDS = """# Do AVs reduce the throughput of other authors' networks?

Arrivals compared with the same demand without AVs, with 95 % intervals over paired seeds. There is
no interval for fewer than five seeds. 20 % of the vehicles are AVs. The lawful car's agent always
asks for more speed, at phi 45.

{table}

## Conditions

The networks and their human drivers are unmodified, without driver errors. All drives have
[SUMO's options](../reference/formats.md#traffic-options) of controlled traffic. Each is driven for
{longest:.0f} s at most. Sensing is `ideal`. Seeds are from 300,000. An AV is stuck if it stands for
a minute without a reason ([figures](../reference/figures.md)). Rows:
[{data}]({data}).

```
python -m benchmarks.throughput --nets {nets}
```

Your own network: `--config FILE.sumocfg --out FOLDER`.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive the missing episodes, then write rows and page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=seed_range, default=f"{FIRST}:{FIRST + SEEDS}", metavar="A:B")
    parser.add_argument("--nets", nargs="+", default=NETS, metavar="NAME")
    parser.add_argument("--config", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--duration", type=float, default=LONGEST, metavar="S", help="of each drive; needs its own --out"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="drive the kept episodes again")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    configs = args.config or [a10kw().with_name(f"{name}.sumocfg") for name in args.nets]
    wanted = list(cases(configs, args.seeds, bool(args.config), args.duration))
    rows = measure(Drive, wanted, args.workers, args.out / DATA, args.again)
    write_page(args.out / PAGE, page(rows, args.duration))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
