"""Converts SUMO's positions and angles of vehicles to ours; needs no SUMO: file readers use it too."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cosim.types import Floats


def centres(
    front_x: Floats, front_y: Floats, angle: npt.NDArray[np.float64], half_length: Floats
) -> tuple[Floats, Floats, Floats]:
    """Front bumper and degrees clockwise from north -> centre and radians counter-clockwise from east.

    front_x, front_y, half_length [n] m, angle [n] degrees -> x [n] m, y [n] m, heading [n] rad in [-pi, pi).
    """
    heading = (np.radians(90.0 - angle) + np.pi) % (2 * np.pi) - np.pi
    return front_x - half_length * np.cos(heading), front_y - half_length * np.sin(heading), heading
