"""Shapes of actors from above: polygons for the page and the film."""

import math
from collections.abc import Mapping

from cosim.types import Actor

Shape = tuple[tuple[str, tuple[tuple[float, float], ...]], ...]
BODY, LIGHT, DARK = "body", "light", "dark"  # in the colour of the driver; bright; nearly black
LEAST = {Actor.PERSON: (0.7, 0.9), Actor.BICYCLE: (1.8, 0.8)}  # m, minimum drawn length and width
NAMES = {
    Actor.CAR: "car",
    Actor.TRUCK: "truck",
    Actor.BUS: "bus",
    Actor.MOTORCYCLE: "motorcycle",
    Actor.BICYCLE: "bicycle",
    Actor.PERSON: "person on foot",
    Actor.OTHER: "other",
}


def _box(back: float, front: float, side: float) -> tuple[tuple[float, float], ...]:
    return ((back, -side), (front, -side), (front, side), (back, side))


def _round(x: float, along: float, across: float, y: float = 0.0) -> tuple[tuple[float, float], ...]:
    turns = [2.0 * math.pi * k / 16 for k in range(16)]
    return tuple((round(x + along * math.cos(a), 3), round(y + across * math.sin(a), 3)) for a in turns)


_SENSOR = _round(-0.16, 0.07, 0.17)
_CAR: Shape = (
    (BODY, ((-0.5, -0.44), (-0.47, -0.5), (0.4, -0.5), (0.47, -0.42), (0.5, -0.25), (0.5, 0.25), (0.47, 0.42),
            (0.4, 0.5), (-0.47, 0.5), (-0.5, 0.44))),
    (LIGHT, ((0.1, -0.4), (0.24, -0.36), (0.24, 0.36), (0.1, 0.4))),
)  # fmt: skip
# Actor -> parts (colour, polygon); x in lengths (front 0.5), y in widths (left 0.5)
SHAPES: Mapping[Actor, Shape] = {
    Actor.CAR: _CAR,
    Actor.TRUCK: (
        (DARK, _box(0.2, 0.3, 0.2)),
        (BODY, _box(-0.5, 0.22, 0.5)),
        (BODY, ((0.27, -0.46), (0.47, -0.46), (0.5, -0.36), (0.5, 0.36), (0.47, 0.46), (0.27, 0.46))),
        (LIGHT, _box(0.39, 0.45, 0.38)),
        *((DARK, _box(x, x + 0.012, 0.4)) for x in (-0.36, -0.2, -0.04, 0.12)),
    ),
    Actor.BUS: (
        (BODY, ((-0.5, -0.5), (0.48, -0.5), (0.5, -0.4), (0.5, 0.4), (0.48, 0.5), (-0.5, 0.5))),
        (LIGHT, _box(0.44, 0.475, 0.42)),
        *((LIGHT, _box(x, x + 0.12, 0.22)) for x in (-0.4, -0.19, 0.02, 0.23)),
    ),
    Actor.MOTORCYCLE: (
        (DARK, _round(0.0, 0.5, 0.16)),
        (DARK, _box(0.2, 0.27, 0.5)),
        (BODY, _round(-0.05, 0.3, 0.42)),
        (LIGHT, _round(0.0, 0.11, 0.18)),
    ),
    Actor.BICYCLE: (
        (DARK, _box(-0.5, 0.5, 0.09)),
        (DARK, _box(0.2, 0.26, 0.45)),
        (BODY, _round(-0.06, 0.2, 0.5)),
    ),
    Actor.PERSON: ((BODY, _round(0.0, 0.4, 0.5)), (LIGHT, _round(0.06, 0.2, 0.17))),
    Actor.OTHER: ((BODY, _box(-0.5, 0.5, 0.5)), (LIGHT, _box(0.4, 0.46, 0.4))),
}
SENSOR: Shape = ((LIGHT, _SENSOR),)  # on the roof of an AV
BRAKES: Shape = (("brake", _box(-0.5, -0.42, 0.48)),)
