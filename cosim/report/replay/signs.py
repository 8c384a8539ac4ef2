"""Signs at the end of a lane at a junction: stop line, sign, signals, and pedestrian crossings."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cosim.recording.replay_data import ReplayData
from cosim.road import Crossing, Link, RoadMap, Rule
from cosim.types import Floats

SIGNED = (Rule.STOP, Rule.ALL_WAY_STOP, Rule.YIELD)
STRIPE = 0.5  # m: of a zebra crossing, and between two
LAMPS = {  # signal state -> colour (SUMO, Simulation/Traffic_Lights): off is grey, off and blinking is brown
    "r": (224, 32, 32), "R": (224, 32, 32), "u": (242, 106, 27), "y": (245, 184, 0), "Y": (245, 184, 0),
    "g": (120, 205, 110), "s": (120, 205, 110), "G": (18, 161, 80), "o": (150, 110, 40), "O": (138, 146, 156),
}  # fmt: skip


class StopLine(NamedTuple):
    """The end of one lane at a junction."""

    lane: int
    rule: Rule  # PRIORITY, YIELD, STOP or ALL_WAY_STOP; valid without a signal, or with a signal that is off
    signals: tuple[int, ...]  # indices into `Snapshot.signals`, the leftmost turn first


def stop_lines(road: RoadMap) -> list[StopLine]:
    """Every lane's end with a signal or a sign, by lane."""
    links: dict[int, list[Link]] = {}
    for link in road.links:
        links.setdefault(link.origin, []).append(link)
    found = []
    for lane, outgoing in sorted(links.items()):
        turns = sorted(outgoing, key=lambda link: -_turn(road, link))
        signals = tuple(dict.fromkeys(link.signal for link in turns if link.signal >= 0))
        rules = {link.rule for link in outgoing}
        # no yield line on a lane with a link that has priority
        rule = next((r for r in SIGNED if r in rules), Rule.PRIORITY)
        rule = Rule.PRIORITY if rule == Rule.YIELD and Rule.PRIORITY in rules else rule
        if signals or rule in SIGNED:
            found.append(StopLine(lane, rule, signals))
    return found


def heading_at_end(shape: Floats) -> float:
    """Heading of the last segment of a lane's shape [p,2] m, rad."""
    dx, dy = shape[-1] - shape[-2]
    return math.atan2(dy, dx)


def states_at(r: ReplayData, time: float) -> str:
    """Every signal's state in the frame at or before `time` s."""
    k = min(max(int(np.searchsorted(r.times, time + 1e-6, side="right")) - 1, 0), len(r.signals) - 1)
    return r.signals[k].tobytes().decode("ascii") if k >= 0 else ""


def zebra(crossing: Crossing) -> list[Floats]:
    """The stripes of a pedestrian crossing: polygons [4,2] m."""
    found, half = [], 0.5 * crossing.width
    for a, b in pairwise(crossing.shape):
        length = float(np.hypot(*(b - a)))
        along = (b - a) / max(length, 1e-6)
        across = half * np.array([-along[1], along[0]])
        for begin in np.arange(0.5 * STRIPE, length, 2.0 * STRIPE):
            p, q = a + begin * along, a + min(begin + STRIPE, length) * along
            found.append(np.array([p - across, q - across, q + across, p + across]))
    return found


def _turn(road: RoadMap, link: Link) -> float:
    """The turn of a link, rad, positive to the left."""
    origin, target = road.lanes[link.origin].shape, road.lanes[link.target].shape
    turn = math.atan2(*(target[1] - target[0])[::-1]) - heading_at_end(origin)
    return (turn + math.pi) % (2.0 * math.pi) - math.pi
