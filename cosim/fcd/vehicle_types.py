"""Vehicle sizes from SUMO's route and additional files, since floating-car data contain none."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from cosim.errors import BadInput
from cosim.files.xml_input import scan
from cosim.simulation.conventions import type_names


class Size(NamedTuple):
    """m"""

    length: float
    width: float


DEFAULT = Size(5.0, 1.8)  # SUMO's default vehicle
# SUMO 1.28's default sizes by vClass (read back from libsumo; all others are DEFAULT).
OF_CLASS = {
    "bicycle": Size(1.6, 0.65),
    "bus": Size(12.0, 2.5),
    "coach": Size(14.0, 2.6),
    "delivery": Size(6.5, 2.16),
    "emergency": Size(6.5, 2.16),
    "moped": Size(2.1, 0.78),
    "motorcycle": Size(2.2, 0.9),
    "rail": Size(135.0, 2.84),
    "rail_electric": Size(200.0, 2.95),
    "rail_fast": Size(200.0, 2.95),
    "rail_urban": Size(109.5, 3.0),
    "scooter": Size(1.2, 0.5),
    "ship": Size(17.0, 4.0),
    "subway": Size(109.5, 3.0),
    "trailer": Size(16.5, 2.55),
    "tram": Size(22.0, 2.4),
    "truck": Size(7.1, 2.4),
    "wheelchair": Size(1.2, 0.72),
}


def read_sizes(files: Iterable[Path]) -> dict[str, Size]:
    """vType -> size, of every `<vType>` in these files; later files win.

    Raises:
        BadInput: a file is malformed, or a length or width is not a positive number.
    """
    found: dict[str, Size] = {}
    for path in files:

        def start(tag: str, attributes: dict[str, str], line: int, path: Path = path) -> None:
            if tag == "vType" and "id" in attributes:
                usual = OF_CLASS.get(attributes.get("vClass", ""), DEFAULT)
                found[attributes["id"]] = Size(
                    _metres(attributes, "length", usual.length, path, line),
                    _metres(attributes, "width", usual.width, path, line),
                )

        scan(path, ("routes", "additional"), start)
    return found


def size_of(vehicle_type: str, sizes: Mapping[str, Size]) -> Size | None:
    """The size of a type by its name in SUMO's outputs (`type_names`)."""
    return next((sizes[name] for name in type_names(vehicle_type) if name in sizes), None)


def _metres(attributes: Mapping[str, str], name: str, default: float, path: Path, line: int) -> float:
    text = attributes.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        problem = f"must be a positive number of metres (vType {attributes['id']!r}, line {line})"
        raise BadInput(problem, file=path, field=name, value=text)
    return value
