"""How faithfully SUMO's LC2013 drives Table II: measured against our MOBIL, and calibrated to it.

    python -m benchmarks.behaviors --report      # test seeds; rewrites docs/results/behaviors.md
    python -m benchmarks.behaviors --calibrate   # tuning seeds; rewrites lc2013 in behaviors.yaml

The road: 3 lanes, 3 km, 25 m/s, 3,600 vehicles an hour wished (conservative drivers with T = 3 s cannot all
enter: the flow is then what their headway allows). A lane change is judged in the state in which it begins.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import libsumo
import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, differential_evolution
from scipy.stats import binom, chi2, norm

from cosim.simulation.drivers import (
    BEHAVIORS_FILE,
    LC2013,
    MIXED,
    MOBIL,
    Behaviors,
    DriverClass,
    Drivers,
    load_behaviors,
)
from cosim.simulation.mobil import (
    LEFT,
    RIGHT,
    IdmParameters,
    accelerations,
    changing,
    incentive,
    is_safe,
    read_beside,
    read_own_lane,
)

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results" / "behaviors.md"
CLASSES = ("aggressive", "moderate", "conservative")
TUNING_SEEDS, TEST_SEEDS = 100_000, 200_000

LENGTH = 3000.0  # m
MEASURED = (500.0, 2500.0)  # m: away from where vehicles appear and vanish
FLOW = 3600.0  # vehicles per hour
WARM_UP = 120.0  # s: the time to cross the road at the speed limit
STEP = 0.1  # s

Known = Callable[[str], IdmParameters | None]


@dataclass(frozen=True, slots=True)
class Change:
    """One lane change at its beginning."""

    driver: str  # class
    egoistic: float  # m/s2, incentive without politeness
    polite: float  # m/s2, incentive with the class's p
    worth: bool  # the polite incentive exceeds a_th
    worth_egoistic: bool  # the egoistic incentive exceeds a_th
    safe: bool  # the new follower need not brake harder than b_safe
    front_gap: float  # m, to the new leader; nan: nobody
    rear_gap: float  # m
    imposed: float  # m/s2, deceleration that IDM asks of the new follower (0: none or it accelerates)


@dataclass
class Traffic:
    """What was measured: changes, vehicle-kilometres and headways per class, collided pairs."""

    changes: list[Change] = field(default_factory=list)
    kilometres: dict[str, float] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0.0))
    headways: dict[str, list[tuple[int, float]]] = field(  # (block: seed and minute, s)
        default_factory=lambda: {name: [] for name in CLASSES}
    )
    collisions: set[tuple[int, str, str]] = field(default_factory=set)
    vehicles: int = 0

    def add(self, other: Traffic) -> None:
        self.changes += other.changes
        self.collisions |= other.collisions
        self.vehicles += other.vehicles
        for name in CLASSES:
            self.kilometres[name] += other.kilometres[name]
            self.headways[name] += other.headways[name]


# ---------------------------------------------------------------- the road


def build_highway(folder: Path) -> None:
    """The net in `folder`; needs netconvert (extra `tools`)."""
    import sumo  # type: ignore[import-untyped]

    nodes = f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{LENGTH}" y="0"/></nodes>'
    (folder / "n.nod.xml").write_text(nodes)
    (folder / "e.edg.xml").write_text('<edges><edge id="e" from="a" to="b" numLanes="3" speed="25"/></edges>')
    netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    files = ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.xml"]
    subprocess.run([netconvert, *files], cwd=folder, check=True, capture_output=True)


def _flow(folder: Path, driver: DriverClass, duration: float) -> Path:
    """Vehicles are inserted with the gaps of `driver`, at random moments and lanes."""
    idm = driver.idm
    path = folder / "flow.rou.xml"
    path.write_text(
        f'<routes><vType id="car" length="5" width="2" carFollowModel="IDM" tau="{idm.time_headway}"'
        f' minGap="{idm.minimum_gap}" accel="{idm.max_acceleration}" decel="{idm.comfortable_deceleration}"'
        f' emergencyDecel="{max(9.0, idm.comfortable_deceleration)}" speedDev="0"/>'
        f'<route id="r" edges="e"/><flow id="f" type="car" route="r" begin="0" end="{duration:g}"'
        f' period="exp({FLOW / 3600.0:g})" departLane="random" departSpeed="max"/></routes>'
    )
    return path


def measure(
    folder: Path, behavior: str, model: str, seed: int, duration: float, behaviors: Behaviors
) -> Traffic:
    """Drive one episode of `duration` s after the warm-up."""
    inserted_as = behaviors.classes.get(behavior) or behaviors.classes["moderate"]
    flow = _flow(folder, inserted_as, WARM_UP + duration)
    options = "--step-length 0.1 --lanechange.duration 2 --no-step-log --no-warnings --time-to-teleport -1 "
    options += "--collision.action warn --collision.mingap-factor 0 --max-depart-delay 10"
    net, types = str(folder / "net.xml"), str(BEHAVIORS_FILE.parent / "types.add.xml")
    libsumo.start(["sumo", "-n", net, "-r", str(flow), "-a", types, *options.split(), "--seed", str(seed)])
    try:
        return _drive(Drivers(behavior, model, seed, behaviors), duration)
    finally:
        libsumo.close()


def _drive(drivers: Drivers, duration: float) -> Traffic:
    traffic = Traffic()
    known: Known = drivers.mobil.known if drivers.mobil else lambda _vehicle: None
    get, before = libsumo.vehicle, set[str]()
    first, warm = MEASURED[0], round(WARM_UP / STEP)
    for step in range(round((WARM_UP + duration) / STEP)):
        libsumo.simulationStep()
        for vehicle in libsumo.simulation.getDepartedIDList():
            drivers.apply(vehicle)
            traffic.vehicles += 1
        traffic.collisions.update(
            (drivers.seed, c.collider, c.victim) for c in libsumo.simulation.getCollisions()
        )
        vehicles = get.getIDList()
        now = {vehicle for vehicle in vehicles if changing(vehicle)}
        if step >= warm:
            for vehicle in now - before:
                if first <= get.getLanePosition(vehicle) <= MEASURED[1]:
                    traffic.changes.append(_judge(drivers, vehicle, known))
            if step % 10 == 0:
                _sample(drivers, traffic, vehicles, drivers.seed * 1000 + step // 600)
        before = now
        drivers.step(libsumo.simulation.getTime())
    return traffic


def _judge(drivers: Drivers, vehicle: str, known: Known) -> Change:
    """The change of `vehicle` that began in this step; neighbours as SUMO sees them at this moment."""
    name = drivers.classes[vehicle]
    mobil = drivers.behaviors.classes[name].mobil
    direction = LEFT if libsumo.vehicle.getLateralSpeed(vehicle) > 0.0 else RIGHT
    s = read_beside(read_own_lane(vehicle, known), vehicle, direction, known)
    a = accelerations(s)
    egoistic, polite = incentive(a, 0.0), incentive(a, mobil.politeness)
    return Change(
        name,
        egoistic,
        polite,
        polite > mobil.threshold,
        egoistic > mobil.threshold,
        is_safe(a, mobil),
        s.new_leader.gap if s.new_leader else math.nan,
        s.new_follower.gap if s.new_follower else math.nan,
        max(0.0, -a.new_follower_after),
    )


def _sample(drivers: Drivers, traffic: Traffic, vehicles: Iterable[str], block: int) -> None:
    """Once a second: distance driven and time headway (front to front) on the measured stretch."""
    get = libsumo.vehicle
    for vehicle in vehicles:
        if not MEASURED[0] <= get.getLanePosition(vehicle) <= MEASURED[1]:
            continue
        name, speed = drivers.classes[vehicle], get.getSpeed(vehicle)
        traffic.kilometres[name] += speed / 1000.0
        leader = get.getLeader(vehicle, 0.0)
        if leader and leader[0] and speed > 1.0:
            gap = leader[1] + get.getMinGap(vehicle) + get.getLength(leader[0])
            traffic.headways[name].append((block, gap / speed))


# ---------------------------------------------------------------- figures with intervals


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, digits: int, scale: float = 1.0) -> str:
        if math.isnan(self.value):
            return "-"
        value, low, high = (f"{scale * x:.{digits}f}" for x in (self.value, self.low, self.high))
        return f"{value} ({low} to {high})"


def share(hits: int, count: int) -> Figure:
    """Wilson's interval of a proportion."""
    if count == 0:
        return Figure(math.nan, math.nan, math.nan)
    z, p = float(norm.ppf(0.975)), hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return Figure(p, max(0.0, middle - half), min(1.0, middle + half))


def rate(count: int, exposure: float) -> Figure:
    """Exact Poisson interval of events per unit of exposure."""
    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return Figure(
        count / exposure, float(low) / exposure, float(chi2.ppf(0.975, 2 * count + 2)) / 2 / exposure
    )


def quantile(values: Sequence[float], q: float) -> Figure:
    """A quantile of independent values with its order-statistic interval; nan values are left out."""
    ordered = np.sort([v for v in values if not math.isnan(v)])
    if len(ordered) < 2:
        return Figure(math.nan, math.nan, math.nan)
    low, high = (int(binom.ppf(p, len(ordered), q)) for p in (0.025, 0.975))
    last = len(ordered) - 1
    return Figure(
        float(np.quantile(ordered, q)), float(ordered[min(low, last)]), float(ordered[min(high, last)])
    )


def median_of_blocks(samples: Sequence[tuple[int, float]]) -> Figure:
    """Median of autocorrelated samples: bootstrap over whole blocks (minutes)."""
    blocks: dict[int, list[float]] = {}
    for block, value in samples:
        blocks.setdefault(block, []).append(value)
    parts = [np.asarray(v) for v in blocks.values()]
    if not parts:
        return Figure(math.nan, math.nan, math.nan)
    rng = np.random.default_rng(0)
    medians = [
        np.median(np.concatenate([parts[i] for i in rng.integers(0, len(parts), len(parts))]))
        for _ in range(200)
    ]
    value = float(np.median(np.concatenate(parts)))
    return Figure(value, float(np.quantile(medians, 0.025)), float(np.quantile(medians, 0.975)))


# ---------------------------------------------------------------- calibration

FORMULAS = {  # the uncalibrated mapping: b_safe -> lcAssertive, a_th -> lcSpeedGain
    "aggressive": {"lcAssertive": 1.31, "lcSpeedGain": 20.0, "lcSpeedGainLookahead": 0.0},
    "moderate": {"lcAssertive": 1.41, "lcSpeedGain": 3.33, "lcSpeedGainLookahead": 0.0},
    "conservative": {"lcAssertive": 1.41, "lcSpeedGain": 0.95, "lcSpeedGainLookahead": 0.0},
}

# Free attributes and their bounds; lcSpeedGain is searched by its logarithm. lcAssertive is not free: it
# alone rules mandatory changes too (merges, exits), where MOBIL has no incentive but only b_safe, and there
# its formula is exact. lcCooperative is p; on a highway without merges it changes nothing.
FREE = {"lcSpeedGain": (-2.0, 3.0), "lcSpeedGainLookahead": (0.0, 10.0)}
TUNING_DURATION = {"aggressive": 240.0, "moderate": 240.0, "conservative": 1800.0}  # s: few changes need long
WANTED_SHARE, WORST_UNSAFE = 0.75, 0.02


def with_attributes(behaviors: Behaviors, name: str, values: Mapping[str, float]) -> Behaviors:
    """The same behaviours with some LC2013 attributes of one class replaced."""
    driver = behaviors.classes[name]
    lc2013 = tuple({**dict(driver.lc2013), **values}.items())
    return replace(behaviors, classes={**behaviors.classes, name: replace(driver, lc2013=lc2013)})


def summary(traffic: Traffic, name: str) -> dict[str, float]:
    """What the calibration compares; nan where a class never changed lanes."""
    changes = [c for c in traffic.changes if c.driver == name]
    values: dict[str, float] = {"rate": (len(changes) + 0.5) / traffic.kilometres[name]}
    for key in ("front_gap", "rear_gap", "imposed"):
        numbers = [getattr(c, key) for c in changes if not math.isnan(getattr(c, key))]
        for q in (10, 50, 90):
            values[f"{key}_{q}"] = float(np.percentile(numbers, q)) if numbers else math.nan
    count = max(1, len(changes))
    values["egoistic"] = sum(c.worth_egoistic for c in changes) / count
    values["unsafe"] = sum(not c.safe for c in changes) / count
    return values


def loss(found: Mapping[str, float], wanted: Mapping[str, float], b_safe: float) -> float:
    """Squared distance from the MOBIL reference: log rate, log gaps, imposed deceleration per b_safe.

    Penalties keep the egoistic incentive at WANTED_SHARE and breaches of b_safe below WORST_UNSAFE.
    """
    gaps = [f"{side}_gap_{q}" for side in ("front", "rear") for q in (10, 50)]
    terms = [math.log(found["rate"] / wanted["rate"]) ** 2]
    terms += [math.log(max(found[g], 0.1) / max(wanted[g], 0.1)) ** 2 for g in gaps]
    terms += [((found[f"imposed_{q}"] - wanted[f"imposed_{q}"]) / b_safe) ** 2 for q in (50, 90)]
    total = sum(9.0 if math.isnan(t) else t for t in terms)
    total += 100.0 * max(0.0, WANTED_SHARE - found["egoistic"]) ** 2
    return total + 100.0 * max(0.0, found["unsafe"] - WORST_UNSAFE) ** 2


def calibrate(
    folder: Path, names: Sequence[str], cache_file: Path, population: int, generations: int
) -> None:
    """Fit each class on tuning seeds; results go into behaviors.yaml. Every evaluation is cached: an
    interrupted run continues where it stopped, since the search itself is deterministic."""
    cache: dict[str, dict[str, float]] = json.loads(cache_file.read_text()) if cache_file.exists() else {}
    behaviors = load_behaviors()

    def evaluate(name: str, model: str, values: Mapping[str, float]) -> dict[str, float]:
        key = json.dumps([name, model, {k: round(v, 4) for k, v in sorted(values.items())}])
        if key not in cache:
            changed = with_attributes(behaviors, name, values)
            traffic = measure(folder, name, model, TUNING_SEEDS, TUNING_DURATION[name], changed)
            cache[key] = summary(traffic, name)
            cache_file.write_text(json.dumps(cache, indent=0))
        return cache[key]

    for name in names:
        started = time.perf_counter()
        wanted = evaluate(name, MOBIL, {})
        b_safe = behaviors.classes[name].mobil.safe_deceleration

        def decode(x: npt.NDArray[np.float64]) -> dict[str, float]:
            values = dict(zip(FREE, map(float, x), strict=True))
            return {k: round(10.0**v if k == "lcSpeedGain" else v, 3) for k, v in values.items()}

        def objective(x: npt.NDArray[np.float64], /, *_: object) -> float:
            return loss(evaluate(name, LC2013, decode(x)), wanted, b_safe)  # noqa: B023  used in this turn

        start = FORMULAS[name]
        x0 = np.array([math.log10(start["lcSpeedGain"]), start["lcSpeedGainLookahead"]])
        result = differential_evolution(
            objective,
            Bounds(*np.array([*FREE.values()]).T),
            x0=x0,
            seed=TUNING_SEEDS,
            popsize=population,
            maxiter=generations,
            polish=False,
        )
        best = decode(result.x)
        found = evaluate(name, LC2013, best)
        write_attributes(BEHAVIORS_FILE, name, best)
        print(f"{name}: {best}, loss {result.fun:.3f} (start {objective(x0):.3f}), b_safe {b_safe:g}")
        for key, value in found.items():
            print(f"    {key:14s} LC2013 {value:8.3f}   MOBIL {wanted[key]:8.3f}")
        print(f"    {result.nfev} evaluations, {time.perf_counter() - started:.0f} s", file=sys.stderr)


def write_attributes(path: Path, name: str, values: Mapping[str, float]) -> None:
    """Replace numbers in one class's lc2013 block; the rest of the file, comments included, stays."""
    text = path.read_text(encoding="utf-8")
    head, block, tail = re.split(rf"(?m)^(  {name}:\n(?:    .*\n)+)", text, maxsplit=1)
    for key, value in values.items():
        block, count = re.subn(rf"(?m)^(      {key}: )[^\s#]+", rf"\g<1>{value:g}", block)
        if count != 1:
            raise ValueError(f"{path}: {name} has {count} lines for {key}")
    path.write_text(head + block + tail, encoding="utf-8")


# ---------------------------------------------------------------- report

# s per test seed, two seeds each: chosen so that the whole report takes less than three minutes on one core.
REPORT_DURATION = {"aggressive": 150.0, "moderate": 240.0, "conservative": 3000.0, MIXED: 300.0}
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def report(folder: Path, scale: float) -> str:
    """Measure on test seeds; the Markdown tables."""
    behaviors = load_behaviors()

    def collect(behavior: str, model: str, used: Behaviors) -> Traffic:
        total = Traffic()
        for seed in (TEST_SEEDS, TEST_SEEDS + 1):
            total.add(measure(folder, behavior, model, seed, scale * REPORT_DURATION[behavior], used))
        return total

    rows: list[tuple[str, str, str, Traffic]] = []
    for name in CLASSES:
        rows.append((name, name, "MOBIL", collect(name, MOBIL, behaviors)))
        rows.append((name, name, "LC2013", collect(name, LC2013, behaviors)))
        formulas = with_attributes(behaviors, name, FORMULAS[name])
        rows.append((name, name, "LC2013, formulas", collect(name, LC2013, formulas)))
    polite = with_attributes(behaviors, "conservative", {"lcAssertive": 0.5, "lcSpeedGain": 10.0})
    rows.append(
        ("conservative", "conservative", "LC2013, lcAssertive 0.5", collect("conservative", LC2013, polite))
    )
    for model, label in ((MOBIL, "MOBIL"), (LC2013, "LC2013")):
        traffic = collect(MIXED, model, behaviors)
        rows += [(name, MIXED, label, traffic) for name in CLASSES]

    head = "| class | traffic | model | changes | per vehicle-km | incentive > a_th, egoistic, % | with p, % "
    head += "| break b_safe, % |"
    one = [head, "|---|---|---|---|---|---|---|---|"]
    two = [
        "| class | traffic | model | front gap, m: 10 % | 50 % | rear gap, m: 10 % | 50 % "
        "| imposed, m/s2: 50 % | 90 % | median headway, s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, traffic_name, label, traffic in rows:
        changes, n = [c for c in traffic.changes if c.driver == name], 0
        n = len(changes)
        start = f"| {name} | {'mixed' if traffic_name == MIXED else 'own class'} | {label} |"
        figures = [
            str(n),
            rate(n, traffic.kilometres[name]).text(3),
            share(sum(c.worth_egoistic for c in changes), n).text(0, 100.0),
            share(sum(c.worth for c in changes), n).text(0, 100.0),
            share(sum(not c.safe for c in changes), n).text(1, 100.0),
        ]
        one.append(f"{start} {' | '.join(figures)} |")
        gaps = [
            quantile([getattr(c, side) for c in changes], q).text(1)
            for side in ("front_gap", "rear_gap")
            for q in (0.1, 0.5)
        ]
        imposed = [quantile([c.imposed for c in changes], q).text(2) for q in (0.5, 0.9)]
        headway = median_of_blocks(traffic.headways[name]).text(2)
        two.append(f"{start} {' | '.join([*gaps, *imposed, headway])} |")
    collisions = sum(len(t.collisions) for t in {id(t): t for *_, t in rows}.values())
    vehicles = sum(t.vehicles for t in {id(t): t for *_, t in rows}.values())
    safety = f"Collisions between HVs in all of these runs: {collisions} among {vehicles} vehicles."
    return "\n".join(["", *one, "", *two, "", safety, ""])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.behaviors", description=(__doc__ or "").split("\n", 1)[0]
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--report", action="store_true", help="measure on test seeds, rewrite the tables")
    what.add_argument("--calibrate", action="store_true", help="fit LC2013 to MOBIL on tuning seeds")
    parser.add_argument("--classes", nargs="+", choices=CLASSES, default=CLASSES, help="classes to fit")
    parser.add_argument(
        "--cache", type=Path, default=Path("behaviors_calibration.json"), help="evaluations so far"
    )
    parser.add_argument("--population", type=int, default=5, help="of differential evolution, per parameter")
    parser.add_argument("--generations", type=int, default=2)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the report's simulated time")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build_highway(folder)
        if options.calibrate:
            calibrate(folder, options.classes, options.cache, options.population, options.generations)
            return
        tables = report(folder, options.scale)
    print(tables)
    if options.scale == 1.0:
        text = RESULTS.read_text(encoding="utf-8")
        before, rest = text.split(BEGIN, 1)
        RESULTS.write_text(f"{before}{BEGIN}\n{tables}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
