"""The road as a JSON document beside the recordings, so that maps can be drawn without SUMO."""

import json
from pathlib import Path

import numpy as np

from cosim.errors import BadInput
from cosim.files import read_json
from cosim.road import ConflictZone, Lane, RoadMap

FORMAT = "cosim-road-1"


def text(road: RoadMap) -> str:
    """Everything a RoadMap holds as JSON: floats survive exactly, the same road gives the same text."""
    document = {
        "format": FORMAT,
        "lanes": [vars(lane) | {"shape": lane.shape.tolist()} for lane in road.lanes],
        "zones": [{"name": zone.name, "lanes": sorted(zone.lanes)} for zone in road.zones],
        "junctions": [outline.tolist() for outline in road.junctions],
    }
    return json.dumps(document, separators=(",", ":"), sort_keys=True)


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
