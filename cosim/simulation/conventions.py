"""Converts SUMO's positions, angles and vType names; needs no SUMO, so file readers use it too."""

import numpy as np
import numpy.typing as npt

from cosim.types import Floats

# Prefix of AV types in SUMO's outputs, and of no other types; the name of the original type follows.
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
    """The type as SUMO writes it, then the types it is derived from: `type@vehicle` is one vehicle's copy,
    `type/class` has a Table II driver, `cosim.av.type` is an AV's."""
    of_copy = vehicle_type.partition("@")[0]
    ours = of_copy.rpartition("/")[0] or of_copy  # a user's types may have slashes too
    return vehicle_type, of_copy, ours, of_copy.removeprefix(AV_TYPE), ours.removeprefix(AV_TYPE)
