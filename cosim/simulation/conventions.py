"""Converts SUMO's positions, angles and types of vehicles to ours; needs no SUMO: file readers use it too."""

import numpy as np
import numpy.typing as npt

from cosim.types import Floats

# The types of AVs in SUMO's outputs begin so, and nobody else's: then follows the name of their own type.
OURS = "cosim."
AV_TYPE = f"{OURS}av."


def centres(
    front_x: Floats, front_y: Floats, angle: npt.NDArray[np.float64], half_length: Floats
) -> tuple[Floats, Floats, Floats]:
    """Front bumper and degrees clockwise from north -> centre and radians counter-clockwise from east.

    front_x, front_y, half_length [n] m, angle [n] degrees -> x [n] m, y [n] m, heading [n] rad in [-pi, pi).
    """
    heading = (np.radians(90.0 - angle) + np.pi) % (2 * np.pi) - np.pi
    return front_x - half_length * np.cos(heading), front_y - half_length * np.sin(heading), heading


def type_names(vehicle_type: str) -> tuple[str, ...]:
    """The type as SUMO writes it, then what it was made of: `type@vehicle` is one vehicle's own copy,
    `type/class` one of ours, `cosim.av.type` that of an AV."""
    of_copy = vehicle_type.partition("@")[0]
    ours = of_copy.rpartition("/")[0] or of_copy  # a user's types may have slashes too
    return vehicle_type, of_copy, ours, of_copy.removeprefix(AV_TYPE), ours.removeprefix(AV_TYPE)
