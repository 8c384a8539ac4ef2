"""Random roads and demands: `python -m sumo_scenarios.draw A:B --out FOLDER` writes FOLDER/SEED.

Training seeds are below 100,000, validation seeds below 200,000; other seeds are refused. No random road is
similar (`sumo_scenarios.roads.alike`) to one of the six test roads.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.errors import BadInput, CosimError
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS, generator
from sumo_scenarios import road_folders
from sumo_scenarios.roads import (
    NAMED,
    Arterial,
    LaneDrop,
    Minor,
    OnRamp,
    Road,
    Roundabout,
    Weave,
    alike,
)

SEEDS = range(TRAINING_SEEDS.start, TUNING_SEEDS.stop)
LEVEL = (0.5, 1.3)  # demand range, as a share of the nominal capacity
MOTORWAY = (22.22, 25.0, 27.78, 30.56, 33.33)  # m/s
STREET = (11.11, 13.89, 16.67, 19.44)  # m/s
RADIUS_PER_ARM = 7.0  # m, minimum for a roundabout, to leave room for lane changes between two arms
DEMAND = "drawn"


@dataclass(frozen=True)
class Drawn:
    """A random road and its demand."""

    road: Road
    level: float  # demand, as a share of the nominal capacity
    per_hour: float  # vehicles/h


def draw(seed: int) -> Drawn:
    """The road and demand of a seed (deterministic).

    The nominal capacity is that of the named road of this kind, scaled by the lanes at the bottleneck.

    Raises:
        BadInput: neither a training nor a validation seed.
    """
    if seed not in SEEDS:
        problem = f"roads are drawn for training and validation: {SEEDS.start} to {SEEDS.stop - 1}"
        raise BadInput(problem, field="seed", value=seed)
    random = generator(seed, "road")
    road = _road(random)
    while any(alike(road, named) for named in NAMED.values()):
        road = _road(random)
    level = float(random.uniform(*LEVEL))
    named = NAMED[road.kind]
    nominal = road_folders.capacities()[road.kind] * road.lanes_at_bottleneck / named.lanes_at_bottleneck
    return Drawn(road, level, level * nominal)


def write(seed: int, folder: Path) -> Path:
    """Write the scenario `drawn/SEED` to `folder`/SEED. Raises BadInput as `draw` or without netconvert."""
    drawn, place = draw(seed), folder / str(seed)
    text = road_folders.demand(drawn.road, drawn.per_hour, f"{drawn.level:.2f} of a nominal capacity")
    road_folders.write(drawn.road, place, f"drawn/{seed}", {DEMAND: text}, DEMAND)
    return place


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the roads of these seeds."""
    parser = argparse.ArgumentParser(prog="python -m sumo_scenarios.draw", description=__doc__)
    parser.add_argument("seeds", metavar="A:B", help="B excluded")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    given = parser.parse_args(arguments)
    try:
        span = re.fullmatch(r"(\d+):(\d+)", given.seeds)
        if span is None:
            raise BadInput("two whole numbers a:b are needed (b excluded)", field="seeds", value=given.seeds)
        for seed in range(int(span[1]), int(span[2])):
            print(write(seed, given.out))
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


# ---- inside: one function per kind ----


def _road(random: np.random.Generator) -> Road:
    kind = str(random.choice([*KINDS]))
    return KINDS[kind](random)


def _lane_drop(random: np.random.Generator) -> Road:
    lanes = int(random.integers(2, 5))
    return LaneDrop(
        lanes=lanes,
        after=max(lanes - int(random.integers(1, 3)), 1),
        from_the_right=bool(random.integers(2)),
        before_m=_round(random, 700.0, 1500.0),
        after_m=_round(random, 300.0, 700.0),
        speed=_one(random, MOTORWAY),
    )


def _on_ramp(random: np.random.Generator) -> Road:
    return OnRamp(
        lanes=int(random.integers(1, 4)),
        acceleration_m=_round(random, 100.0, 450.0),
        ramp_share=float(random.uniform(0.08, 0.4)),
        before_m=_round(random, 600.0, 1300.0),
        after_m=_round(random, 300.0, 700.0),
        ramp_m=_round(random, 300.0, 600.0),
        speed=_one(random, MOTORWAY),
    )


def _weave(random: np.random.Generator) -> Road:
    return Weave(
        lanes=int(random.integers(1, 4)),
        weave_m=_round(random, 120.0, 800.0),
        on_share=float(random.uniform(0.05, 0.25)),
        off_share=float(random.uniform(0.05, 0.25)),
        both_share=float(random.uniform(0.0, 0.06)),
        before_m=_round(random, 600.0, 1300.0),
        after_m=_round(random, 300.0, 700.0),
        ramp_m=_round(random, 300.0, 600.0),
        speed=_one(random, MOTORWAY),
    )


def _roundabout(random: np.random.Generator) -> Road:
    arms = int(random.integers(3, 6))
    return Roundabout(
        lanes=int(random.integers(1, 3)),
        arms=arms,
        radius=_round(random, RADIUS_PER_ARM * arms, 55.0, 1.0),
        through_share=float(random.uniform(0.3, 0.8)),
        first_exit_share=float(random.uniform(0.1, 0.5)),
        arm_m=_round(random, 200.0, 400.0),
        speed=_one(random, STREET),
        ring_speed=_one(random, (6.94, 8.33, 9.72)),
    )


def _minor(random: np.random.Generator) -> Road:
    return Minor(
        lanes=int(random.integers(1, 3)),
        arms=int(random.integers(3, 5)),
        minor_share=float(random.uniform(0.1, 0.35)),
        into_share=float(random.uniform(0.02, 0.12)),
        main_m=_round(random, 300.0, 700.0),
        minor_m=_round(random, 200.0, 400.0),
        speed=_one(random, STREET),
        minor_speed=_one(random, STREET[:2]),
    )


def _arterial(random: np.random.Generator) -> Road:
    green, side = _round(random, 18.0, 50.0, 1.0), _round(random, 12.0, 34.0, 1.0)
    return Arterial(
        signals=int(random.integers(2, 5)),
        lanes=int(random.integers(1, 4)),
        block_m=_round(random, 150.0, 450.0),
        main_green=green,
        side_green=side,
        offset=_round(random, 0.0, green + side, 1.0),
        side_share=float(random.uniform(0.2, 0.5)),
        speed=_one(random, STREET),
        ends_m=_round(random, 250.0, 450.0),
    )


KINDS: Mapping[str, Callable[[np.random.Generator], Road]] = {
    "lane_drop": _lane_drop,
    "on_ramp": _on_ramp,
    "weave": _weave,
    "roundabout": _roundabout,
    "minor": _minor,
    "arterial": _arterial,
}


def _round(random: np.random.Generator, low: float, high: float, to: float = 10.0) -> float:
    return to * round(float(random.uniform(low, high)) / to)


def _one(random: np.random.Generator, values: Sequence[float]) -> float:
    return float(random.choice(values))


if __name__ == "__main__":
    raise SystemExit(main())
