"""Result pages not made from the papers' episodes: predictions, costs, drivers, other networks.

    python -m benchmarks.measured [--only NAME ...] [--again] [--small]        # part of `make results`

Each page has its own command. A finished page is not measured again until its command changes (or with
`--again`), so that an interrupted run resumes. Measure costs on an idle machine. `--small`: minimal sizes to
test the commands; the figures are meaningless.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sumo_scenarios import names

RESULTS = Path("docs/results")
APPROACHES = ("vfn-p", "vfn", "safe-dqn", "conv3d-dqn", "conv3d-a2c", "conv2d-dqn")  # of P's Table III
REAL_NETS = "data/real_nets.csv"
PREDICTED = (  # pictures and data of `cosim bench predict`
    *("position_error.png", "map_error.png", "hpn_training.png"),
    *("data/position_error.csv", "data/interval_coverage.csv", "data/map_error.csv", "data/map_gain.csv"),
)


@dataclass(frozen=True)
class Place:
    """Folders and size of a run of a page's commands."""

    out: Path  # pages and pictures; CSV files in its data/
    work: Path  # intermediate files
    small: bool


@dataclass(frozen=True)
class Page:
    """One page, or several made together."""

    name: str
    commands: Callable[[Place], list[list[str]]]  # modules with their flags
    files: tuple[str, ...]  # resulting files, relative to the results
    drop: tuple[str, ...] = ()  # patterns of files in work/NAME to copy to the results


def prediction(place: Place) -> list[list[str]]:
    """P's figures 5 to 8 and 10: errors of predictors and predicted maps on recorded episodes."""
    flags = ["--seeds", "200000:200001", "--behavior", "mixed", "--out", str(place.work / "prediction")]
    if place.small:
        flags += ["--scenario", "merge", "--demand", "dense", "--policy", "idm"]
    return [["cosim.cli.main", "bench", "predict", *flags]]


def attribution(place: Place) -> list[list[str]]:
    """Which inputs the trained networks use."""
    policies = APPROACHES[:1] if place.small else APPROACHES
    flags = [word for policy in policies for word in ("--policy", policy)]
    flags += ["--scenario", "merge", "--scenario", "intersection", "--demand", "contested"]
    flags += ["--preset", "unguarded", "--seeds", "300000:300001" if place.small else "300000:300002"]
    flags += ["--duration", "2"] if place.small else []
    return [["cosim.cli.main", "bench", "attribution", *flags, "--out", str(place.work / "attribution")]]


def prediction_speed(place: Place) -> list[list[str]]:
    """Cost of a prediction over four seconds."""
    size = ["--size", "compact", "--threads", "1"] if place.small else ["--threads", "2"]
    flags = ["--rounds", "1", "--decisions", "2" if place.small else "12"]
    flags += ["--backend", "eager"] if place.small else []  # inductor compiles C++ for a minute
    return [["benchmarks.prediction_maps", *size, *flags, "--out", str(place.out / "prediction_speed.md")]]


def agent(place: Place) -> list[list[str]]:
    """Cost of a decision, and speed of training."""
    sizes = ["compact"] if place.small else ["compact", "paper"]
    flags = ["--size", *sizes, "--threads", "1", "2", "--decisions", "12", "--episodes", "4"]
    if place.small:
        flags = ["--size", *sizes, "--threads", "1", "--decisions", "1", "--only", "decision"]
    configs = ["papers"] if place.small else ["papers", "paper"]
    return [["benchmarks.agent", *flags, "--config", *configs, "--out", str(place.out / "agent.md")]]


def decision_cost(place: Place) -> list[list[str]]:
    """Cost of a decision per AV in a city."""
    flags = ["--avs", "2", "--decisions", "2"] if place.small else ["--real"]
    return [["benchmarks.decision_cost", *flags, "--out", str(place.out / "decision_cost.md")]]


def sensing_cost(place: Place) -> list[list[str]]:
    """Cost of sensing per AV and frame."""
    flags = ["--small"] if place.small else []
    return [["benchmarks.sensing_cost", *flags, "--out", str(place.out / "sensing_cost.md")]]


def compensation(place: Place) -> list[list[str]]:
    """Errors of delayed states with latency compensation."""
    flags = ["--small"] if place.small else []
    return [["benchmarks.compensation", *flags, "--out", str(place.out / "compensation.md")]]


def performance(place: Place) -> list[list[str]]:
    """Cost of the loop, a batch and the Gaussian process."""
    where = str(place.work / "recordings")
    traffic = ["--demand", "dense", "--behavior", "mixed"]
    record = ["cosim.cli.main", "record", *traffic, "--out", where, "--resume"]
    if place.small:
        record += ["--scenario", "merge", "--seeds", "100000:100001", "--duration", "8"]
    else:
        record += [word for world in names() for word in ("--scenario", world)] + ["--seeds", "100000:100004"]
    flags = ["--recordings", where, "--out", str(place.out / "performance.md")]
    return [record, ["benchmarks.performance", *flags, *(["--small"] if place.small else [])]]


def startup(place: Place) -> list[list[str]]:
    """Start-up time of short commands."""
    flags = ["--rounds", "1" if place.small else "7"]
    return [["benchmarks.startup", *flags, "--out", str(place.out / "startup.md")]]


def behaviors(place: Place) -> list[list[str]]:
    """Fidelity of LC2013 to Table II."""
    flags = ["--report", "--scale", "0.002" if place.small else "1"]
    return [["benchmarks.behaviors", *flags, "--out", str(place.out / "behaviors.md")]]


def real_nets(place: Place) -> list[list[str]]:
    """Networks of other authors."""
    flags = ["--runs", str(place.out / REAL_NETS), "--out", str(place.out / "real_nets.md")]
    few = ["--nets", "A10KW", "DRT", "fkk_in", "rail", "--duration", "4", "--seeds", "1"]
    return [["benchmarks.real_nets", *flags, *(few if place.small else [])]]


def joining(place: Place) -> list[list[str]]:
    """Speed of `cosim join`."""
    flags = ["--rounds", "1", "--seconds", "1", "--small"] if place.small else ["--rounds", "5"]
    return [["benchmarks.joining", *flags, "--out", str(place.out / "joining.md")]]


def estimate(place: Place) -> list[list[str]]:
    """Validity of the intervals of `cosim estimate`."""
    flags = ["--intervals", "2"] if place.small else []
    runs = str(place.work / "estimate")
    return [["benchmarks.estimate", "page", "--runs", runs, *flags, "--out", str(place.out / "estimate.md")]]


def law(place: Place) -> list[list[str]]:
    """Compliance of AVs with traffic rules in the networks of tests/worlds."""
    flags = ["--seeds", "10", "--runs", str(place.work / "law_runs")]
    if place.small:
        flags = ["--worlds", "arterial", "--arms", "random", "--penetration", "0.2", "--seeds", "1"]
    return [["benchmarks.law", "--page", *flags, "--out", str(place.out / "law.md")]]


def capacity(place: Place) -> list[list[str]]:
    """Capacity of the open roads with human drivers."""
    few = ["--roads", "minor", "--seeds", "100000:100001"] if place.small else []
    return [["benchmarks.capacity", *few, "--out", str(place.out)]]


def front(place: Place) -> list[list[str]]:
    """Costs and benefits of each habit of the lawful car."""
    few = ["--each", "1", "--habits", "the car", "--duration", "30"] if place.small else []
    return [["benchmarks.front", *few, "--out", str(place.out)]]


def earlier_car(place: Place) -> list[list[str]]:
    """The lawful car beside an earlier one."""
    few = ["--commit", "HEAD", "--scenario", "minor", "--seeds", "100000:100001", "--duration", "30"]
    return [["benchmarks.earlier_car", *(few if place.small else []), "--out", str(place.out)]]


def yielding(place: Place) -> list[list[str]]:
    """Scripted yielding beside the lawful car."""
    few = ["--each", "1", "--kinds", "weave", "--duration", "30"] if place.small else []
    return [["benchmarks.yielding", *few, "--out", str(place.out)]]


def yielding_window(place: Place) -> list[list[str]]:
    """What 100 s of yielding bring, in copies of one simulation."""
    few = ["--each", "1", "--kinds", "weave"] if place.small else []
    return [["benchmarks.yielding_window", *few, "--out", str(place.out)]]


def throughput(place: Place) -> list[list[str]]:
    """Arrivals with and without AVs in networks of other authors."""
    few = ["--nets", "corridor", "--seeds", "300000:300001", "--duration", "30"] if place.small else []
    return [["benchmarks.throughput", *few, "--out", str(place.out)]]


PAGES = (
    Page(
        "attribution",
        attribution,
        ("attribution.md", "attribution.png", "data/attribution.csv"),
        drop=("*.md", "*.png", "*.csv"),
    ),
    Page("capacity", capacity, ("capacity.md", "capacity.svg", "data/capacity.csv")),
    Page("front", front, ("front.md", "front.svg", "data/front.csv")),
    Page("earlier_car", earlier_car, ("earlier_car.md", "data/earlier_car.csv")),
    Page("yielding", yielding, ("yielding.md", "data/yielding.csv")),
    Page("yielding_window", yielding_window, ("yielding_window.md", "data/yielding_window.csv")),
    Page("law", law, ("law.md",)),
    Page("agent", agent, ("agent.md",)),
    Page("prediction_speed", prediction_speed, ("prediction_speed.md",)),
    Page("decision_cost", decision_cost, ("decision_cost.md",)),
    Page("sensing_cost", sensing_cost, ("sensing_cost.md",)),
    Page("compensation", compensation, ("compensation.md",)),
    Page("performance", performance, ("performance.md",)),
    Page("startup", startup, ("startup.md",)),
    Page("joining", joining, ("joining.md",)),
    Page("estimate", estimate, ("estimate.md",)),
    Page("real_nets", real_nets, ("real_nets.md", REAL_NETS)),
    Page("throughput", throughput, ("throughput.md", "data/throughput.csv")),
    Page("behaviors", behaviors, ("behaviors.md",)),
    Page(
        "prediction",
        prediction,
        ("prediction.md", "prediction_maps.md", *PREDICTED),
        drop=("*.md", "*.png", "*.csv"),
    ),
)


def make(page: Page, place: Place, *, again: bool = False) -> bool:
    """Measure a page unless it is finished; return whether it was. Raises CalledProcessError."""
    commands = page.commands(place)
    mark = place.work / f"{page.name}.json"
    there = all((place.out / file).is_file() for file in page.files)
    if there and not again and mark.is_file() and json.loads(mark.read_text()) == commands:
        return False
    (place.out / "data").mkdir(parents=True, exist_ok=True)
    place.work.mkdir(parents=True, exist_ok=True)
    for words in commands:
        subprocess.run([sys.executable, "-m", *words], check=True, stdout=subprocess.DEVNULL)
    made = [file for pattern in page.drop for file in sorted((place.work / page.name).glob(pattern))]
    for file in made:
        shutil.copyfile(file, place.out / ("data" if file.suffix == ".csv" else "") / file.name)
    if missing := [file for file in page.files if not (place.out / file).is_file()]:
        raise SystemExit(f"error: {page.name}: did not leave {', '.join(missing)}")
    mark.write_text(json.dumps(commands) + "\n")
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.measured",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=[page.name for page in PAGES], metavar="NAME")
    parser.add_argument("--again", action="store_true", help="measure finished pages again")
    parser.add_argument("--small", action="store_true", help="minimal sizes, to test")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="DIR", help="pages and pictures")
    parser.add_argument("--runs", type=Path, default=Path("runs/measured"), metavar="DIR")
    args = parser.parse_args(arguments)
    place = Place(args.out, args.runs, args.small)
    pages = [page for page in PAGES if not args.only or page.name in args.only]
    for number, page in enumerate(pages, 1):
        began = time.perf_counter()
        print(f"measured {number}/{len(pages)}: {page.name} ...", file=sys.stderr, flush=True)
        try:
            fresh = make(page, place, again=args.again)
        except subprocess.CalledProcessError as error:
            words = " ".join(["python", *error.cmd[1:]])
            raise SystemExit(f"error: {page.name}: `{words}` ended with {error.returncode}") from None
        except KeyboardInterrupt:
            print("interrupted: the same command continues", file=sys.stderr)
            raise SystemExit(130) from None
        took = (
            f"{time.perf_counter() - began:.0f} s" if fresh else "finished before (--again measures it again)"
        )
        print(f"measured {number}/{len(pages)}: {page.name}: {took}", file=sys.stderr, flush=True)
        print(place.out / page.files[0])


if __name__ == "__main__":
    main()
