"""A picture of the traffic around one vehicle, drawn from a snapshot: no display, no window system."""

import numpy as np

from cosim.geometry.raster import CHANNELS, ROAD_LINE, draw_snapshot, rasterize_road
from cosim.road import RoadMap
from cosim.types import Bytes, ObservationConfig, Snapshot

# 64 m x 256 m at 0.4 m a pixel, the vehicle in the middle looking to the right
VIEW = ObservationConfig(height=160, width=640, metres_across=0.4, metres_along=0.4, channels=CHANNELS)
GRASS, SURFACE, LINE = (222, 231, 214), (105, 108, 112), (235, 235, 235)
COLOURS = {"hv": (250, 190, 60), "av": (60, 130, 246), "mission": (220, 50, 60), "ego": (20, 40, 140)}


class Painter:
    """Draws pictures of one road; the road's surface is drawn once."""

    def __init__(self, road: RoadMap) -> None:
        self._raster = rasterize_road(road)
        self._block = np.zeros((1, len(CHANNELS), VIEW.height, VIEW.width), np.uint8)

    def paint(self, s: Snapshot, vehicle: str | None) -> Bytes:
        """[160, 640, 3] RGB, centred on `vehicle` (missing or None: the first vehicle; blank without any)."""
        picture = np.empty((VIEW.height, VIEW.width, 3), np.uint8)
        picture[:] = GRASS
        if not s.n:
            return picture
        row = 0 if vehicle is None else s.row.get(vehicle, 0)
        all_seen = np.ones((1, s.n), np.bool_)
        draw_snapshot(self._block, np.zeros(1, np.int64), s, np.array([row]), all_seen, self._raster, VIEW)
        layers = dict(zip(CHANNELS, self._block[0], strict=True))
        picture[layers["road"] > 0] = SURFACE
        picture[layers["road"] == ROAD_LINE] = LINE
        for name, colour in COLOURS.items():
            if name != "ego" or vehicle in s.row:
                picture[layers[name] > 0] = colour
        return picture
