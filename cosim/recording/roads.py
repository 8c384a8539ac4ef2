"""The road as a JSON document beside the recordings, so that maps can be drawn without SUMO."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.files import read_json
from cosim.road import ConflictZone, Lane, RoadMap

FORMAT = "cosim-road-1"


def document(road: RoadMap) -> dict[str, Any]:
    """Everything a RoadMap holds; floats survive exactly (JSON writes their shortest exact form)."""
    return {
        "format": FORMAT,
        "lanes": [
            {
                "id": lane.id,
                "edge": lane.edge,
                "index": lane.index,
                "shape": lane.shape.tolist(),
                "length": lane.length,
                "width": lane.width,
                "speed_limit": lane.speed_limit,
                "successors": list(lane.successors),
                "left": lane.left,
                "right": lane.right,
                "internal": lane.internal,
                "start": lane.start,
                "end": lane.end,
            }
            for lane in road.lanes
        ],
        "zones": [{"name": zone.name, "lanes": sorted(zone.lanes)} for zone in road.zones],
        "junctions": [outline.tolist() for outline in road.junctions],
    }


def text(road: RoadMap) -> str:
    """The document as it is written: the same road gives the same text."""
    return json.dumps(document(road), separators=(",", ":"), sort_keys=True)


def read_road(file: Path) -> RoadMap:
    """Raises BadInput when the file is not such a document."""
    found = read_json(file)
    try:
        if found["format"] != FORMAT:
            raise BadInput(f"not a road of format {FORMAT}", file=file, field="format")
        lanes = tuple(
            Lane(**{**lane, "shape": np.array(lane["shape"], float), "successors": tuple(lane["successors"])})
            for lane in found["lanes"]
        )
        zones = tuple(ConflictZone(zone["name"], frozenset(zone["lanes"])) for zone in found["zones"])
        return RoadMap(lanes, zones, tuple(np.array(outline, float) for outline in found["junctions"]))
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"not a recorded road: {error}", file=file) from None
