"""The road as a JSON document beside the recordings, so that maps can be drawn without SUMO."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.files import read_json
from cosim.road import ConflictZone, Crossing, Lane, Link, RoadMap, Rule

FORMAT = "cosim-road-1"


def text(road: RoadMap) -> str:
    """A RoadMap as JSON, with exact floats; equal roads give equal text."""
    document = {
        "format": FORMAT,
        "lanes": [vars(lane) | {"shape": lane.shape.tolist()} for lane in road.lanes],
        "closed": [vars(lane) | {"shape": lane.shape.tolist()} for lane in road.closed],
        "zones": [{"name": zone.name, "lanes": sorted(zone.lanes)} for zone in road.zones],
        "junctions": [outline.tolist() for outline in road.junctions],
        "links": [asdict(link) for link in road.links],
        "signals": road.signals,
        "crossings": [asdict(c) | {"shape": c.shape.tolist()} for c in road.crossings],
    }
    return json.dumps(document, separators=(",", ":"), sort_keys=True)


def read_road(file: Path) -> RoadMap:
    """Raises BadInput when the file is not such a document."""
    found = read_json(file)
    try:
        if found["format"] != FORMAT:
            raise BadInput(f"not a road of format {FORMAT}", file=file, field="format")
        lanes = tuple(_read(Lane, lane) for lane in found["lanes"])
        zones = tuple(ConflictZone(zone["name"], frozenset(zone["lanes"])) for zone in found["zones"])
        links = (_read(Link, k | {"rule": Rule(k["rule"])}) for k in found["links"])
        crossings = (_read(Crossing, c) for c in found["crossings"])
        outlines = tuple(np.array(outline, float) for outline in found["junctions"])
        signals = tuple((light, index) for light, index in found["signals"])
        closed = tuple(_read(Lane, lane) for lane in found["closed"])
        return RoadMap(lanes, zones, outlines, tuple(links), signals, tuple(crossings), closed)
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"not a recorded road: {error}", file=file) from None


def _read(kind: type[Any], values: Mapping[str, Any]) -> Any:
    """An object of `kind`; sequences become tuples, the shape an array."""
    tuples = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    shape = {"shape": np.array(values["shape"], float)} if "shape" in values else {}
    return kind(**{**values, **tuples, **shape})
