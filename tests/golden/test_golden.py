"""Golden episodes: a change that moves traffic moves one of these, and must say so in CHANGELOG.md.

`python tests/golden/test_golden.py` drives them anew and rewrites episodes.json.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from cosim.host import Host
from cosim.scenario import load
from cosim.types import Preset
from cosim.workers.worker import Worker
from sumo_scenarios import names

FILE = Path(__file__).with_name("episodes.json")
SEED = 200_011
DRIVEN = (("contested", "altruist-rule"), ("dense", "idm"))  # in every world
EPISODES: dict[str, dict[str, Any]] = json.loads(FILE.read_text())
FIGURES = (
    "steps crashed collisions mission_success mission_time_s dt_mean_m dt_av_m dt_mission_m min_ttc_s "
    "hard_brakings vehicles_inserted vehicles_never_inserted"
)


def drive(world: str, demand: str, policy: str) -> dict[str, Any]:
    """The figures of one episode."""
    with Worker(Host, load(world, demand=[demand], preset=Preset.UNGUARDED), policy, math.pi / 4) as worker:
        result = worker.call("run", SEED)
    return {
        name: result.steps if name == "steps" else result.value(name) for name in FIGURES.split()
    }  # fmt: skip


@pytest.mark.parametrize("episode", EPISODES)
def test_the_episode_is_the_golden_one(episode: str) -> None:
    found = drive(*episode.split("/"))
    for name, value in EPISODES[episode].items():
        if isinstance(value, float):
            assert found[name] == pytest.approx(value, rel=1e-6), name
        else:
            assert found[name] == value, name


def main() -> None:
    """Rewrite the file."""
    episodes = ((world, *rest) for world in names() for rest in DRIVEN)
    FILE.write_text(json.dumps({"/".join(e): drive(*e) for e in episodes}, indent=1) + "\n")


if __name__ == "__main__":
    main()
