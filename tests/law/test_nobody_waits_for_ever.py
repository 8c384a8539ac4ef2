"""Preset `lawful` at junctions: nobody waits for ever, whatever the junction's type, angles and lanes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.standing import Watcher
from cosim.scenario import Fleet, load
from cosim.scenario.vet import vetted
from cosim.simulation.lawful import inside, waves
from cosim.types import EpisodeResult, Preset
from cosim.workers.worker import Worker
from tests.law.drawn import KINDS, NO_TURNAROUNDS, build_net, configuration, draw

SEED = 140_000
# Seeds of junctions where SUMO's own drivers stand for less than 60 s; others are overloaded.
DRAWN = {"priority": 0, "priority_stop": 0, "two_junctions": 2}
LONG = 120.0  # s
ANGLE, RADIUS = 115.0, 1.5  # degrees, m: there the nose of a vehicle that waits to turn reaches into a lane
TURNS = """<routes><vType id="car"/><vType id="cav"/>
<flow id="left" type="car" from="wj" to="jn" begin="0" end="160" period="8" departSpeed="max"/>
<flow id="av" type="cav" from="ej" to="jw" begin="1" end="160" period="12" departSpeed="max"/>
<flow id="on" type="car" from="ej" to="jw" begin="4" end="160" period="6" departSpeed="max"/></routes>"""


def narrow_junction(folder: Path) -> Path:
    """The .sumocfg of a skewed junction where humans wait to turn left and AVs come from opposite."""
    x, y = 150.0 * math.cos(math.radians(ANGLE)), 150.0 * math.sin(math.radians(ANGLE))
    places = {"w": (-150.0, 0.0), "e": (150.0, 0.0), "n": (x, y), "s": (-x, -y)}
    nodes = [f'<node id="{name}" x="{x:.1f}" y="{y:.1f}"/>' for name, (x, y) in places.items()]
    nodes.append(f'<node id="j" x="0" y="0" type="priority" radius="{RADIUS}"/>')
    edges = [
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="13.89" '
        f'priority="{4 if arm in "we" else 2}"/>'
        for arm in places
        for a, b in ((arm, "j"), ("j", arm))
    ]
    build_net(folder, nodes, edges, *NO_TURNAROUNDS)
    return configuration(folder, TURNS, 200.0)


class Alone(Watcher):
    """A host whose cars may lack what keeps junctions going."""

    def take_away(self, what: str) -> None:
        """`aside`: AVs stay in the middle of their lane; `waves`: they wave nobody through."""
        if what == "aside":
            setattr(inside.Inside, "_lateral_offsets", lambda *_: iter((0.0,)))  # noqa: B010
        else:
            setattr(waves.Waves, "set", lambda *_: None)  # noqa: B010


def drive(config: Path, fleet: Fleet, *without: str) -> tuple[EpisodeResult, dict[str, float]]:
    """The car alone, with an agent that always asks for more speed; how long each vehicle stood (s)."""
    scenario = vetted(load(str(config), preset=Preset.LAWFUL, fleet=fleet, mission="none"))
    with Worker(Alone, scenario, "car-alone", math.pi / 4) as worker:
        for what in without:
            worker.call("take_away", what)
        found: tuple[EpisodeResult, dict[str, float]] = worker.call("watched", SEED)
    return found


@pytest.mark.parametrize("without", [(), ("waves",)])
def test_a_human_who_waits_to_turn_and_an_av_that_comes_from_opposite_both_get_on(
    tmp_path: Path, without: tuple[str, ...]
) -> None:
    """The nose of the human reaches 0.1 m into the way of the AV, which passes beside it."""
    result, longest = drive(narrow_junction(tmp_path), Fleet(type="cav"), *without)

    assert (result.value("av_trips_completed") or 0) >= 12
    assert max(longest.values()) < LONG
    assert result.value("avs_stuck") == result.value("av_involved_collisions") == 0


def test_without_both_they_wait_for_each_other_for_ever(tmp_path: Path) -> None:
    result, longest = drive(narrow_junction(tmp_path), Fleet(type="cav"), "aside", "waves")

    assert (result.value("av_trips_completed") or 0) < 4
    assert max(longest.values()) > LONG


@pytest.mark.parametrize("kind", KINDS)
def test_nobody_stands_for_long_at_a_drawn_junction(tmp_path: Path, kind: str) -> None:
    result, longest = drive(draw(tmp_path, kind, DRAWN.get(kind, 1)), Fleet(penetration=0.3))

    assert max(longest.values(), default=0.0) < LONG
    assert result.value("red_light_violations") == result.value("stop_sign_violations") == 0
