"""Writes roads as scenario folders: `python -m sumo_scenarios.road_folders` writes the six named roads.

Demands are shares of the capacities in `open/capacity.yaml`, measured by `python -m benchmarks.capacity`.
netconvert comes with the `eclipse-sumo` package (extra `tools`).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import yaml

from sumo_scenarios import ROOT
from sumo_scenarios.build import build
from sumo_scenarios.roads import NAMED, Road, Timing

OPEN = ROOT / "open"
CAPACITY = OPEN / "capacity.yaml"
LEVELS: Mapping[str, float] = {"below": 0.85, "near": 1.0, "over": 1.1}  # of the human-only capacity
DEFAULT = "near"
DEMAND_TIME = 900.0  # s, period of departures
DURATION = 1500.0  # s, counted time, with ten minutes for the traffic to drain
SIGNALS = "signals.add.xml"
HOUR = 3600.0  # s

CONFIGURATION = """<?xml version="1.0" encoding="UTF-8"?>
<!-- Runs under plain `sumo -c {name}.sumocfg` too; cosim adds the fleet, the behaviour classes and the seed.
     No max-depart-delay: a vehicle without room waits for it, and is counted. -->
<configuration>
    <input>
        <net-file value="net.net.xml"/>
        <route-files value="demand/{demand}.rou.xml"/>{additional}
    </input>
    <time>
        <begin value="0"/>
        <end value="{duration:g}"/>
        <step-length value="0.1"/>
    </time>
    <processing>
        <lanechange.duration value="2"/>
        <collision.action value="warn"/>
        <collision.check-junctions value="true"/>
        <collision.mingap-factor value="0"/>
        <time-to-teleport value="-1"/>
    </processing>
</configuration>
"""
SCENARIO = """name: {name}
title: {title}
duration: {duration:g}
warmup: 0
timing: {{step: 0.1, frame: 0.2, decision: 0.4}}
preset: lawful
behavior: moderate
on_collision: continue
demand: {demand}
fleet: {{penetration: 0.2}}
mission: {{kind: none}}
conflict_zones: []
"""


def write(road: Road, folder: Path, name: str, demands: Mapping[str, str], default: str) -> None:
    """Write the scenario folder of `road`: sources, net, signals, `demands` (name -> XML), configuration.

    Raises:
        BadInput: netconvert is missing.
    """
    (folder / "plain").mkdir(parents=True, exist_ok=True)
    (folder / "demand").mkdir(exist_ok=True)
    for suffix, text in road.sources().items():
        _write(folder / "plain" / f"{road.kind}.{suffix}.xml", text)
    net = build(folder)
    if road.timing is not None:
        _write(folder / SIGNALS, signals(net, road.timing))
    for level, text in demands.items():
        _write(folder / "demand" / f"{level}.rou.xml", text)
    more = f'\n        <additional-files value="{SIGNALS}"/>' if road.timing is not None else ""
    words = {"demand": default, "duration": DURATION, "additional": more, "title": road.title}
    _write(folder / f"{folder.name}.sumocfg", CONFIGURATION.format(name=folder.name, **words))
    _write(folder / "scenario.yaml", SCENARIO.format(name=name, **words))


def demand(road: Road, per_hour: float, about: str, until: float = DEMAND_TIME) -> str:
    """A route file: `per_hour` vehicles at random headways until `until` (s)."""
    said = f"<!-- {per_hour:,.0f} vehicles/h for {until / 60.0:g} minutes, at random headways: {about}. -->"
    return _routes(said, _flows(road, per_hour, 0.0, until))


def ramp(road: Road, steps: Mapping[float, float], step: float) -> str:
    """A route file with a time-varying demand: start (s) -> vehicles/h, each for `step` s."""
    lines = [
        line for begin, per_hour in steps.items() for line in _flows(road, per_hour, begin, begin + step)
    ]
    return _routes(f"<!-- vehicles/h by time: {dict(steps)} -->", lines)


def signals(net: Path, timing: Timing) -> str:
    """An additional file with the signal programs of a net for this timing.

    Green of the arterial's links lasts `timing.main`, other green `timing.side`; yellow is not changed.
    """
    lines = []
    for number, logic in enumerate(ElementTree.parse(net).getroot().iter("tlLogic")):
        states = [
            (phase.get("state", ""), float(phase.get("duration", "0"))) for phase in logic.iter("phase")
        ]
        mains = _links_of_the_arterial(net, logic.get("id", ""))
        offset = f'type="static" offset="{timing.offset * number:g}"'
        lines.append(f'    <tlLogic id="{logic.get("id")}" programID="timed" {offset}>')
        for state, duration in states:
            if "y" not in state.lower():
                duration = timing.main if any(state[k] == "G" for k in mains) else timing.side
            lines.append(f'        <phase duration="{duration:g}" state="{state}"/>')
        lines.append("    </tlLogic>")
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', "<additional>", *lines, "</additional>", ""])


def named(name: str, capacity: float) -> dict[str, str]:
    """Level -> route file of the open road `name`, from its `capacity` (vehicles/h)."""
    return {
        level: demand(NAMED[name], share * capacity, f"{share:g} of the human-only capacity")
        for level, share in LEVELS.items()
    }


def capacities() -> dict[str, float]:
    """Open road -> capacity with human drivers, vehicles/h."""
    found: dict[str, float] = yaml.safe_load(CAPACITY.read_text(encoding="utf-8"))
    return found


def keep(found: Mapping[str, float]) -> None:
    """Write `capacities`."""
    said = "# Vehicles/h that human drivers bring through each open road: python -m benchmarks.capacity\n"
    _write(CAPACITY, said + "".join(f"{name}: {flow:g}\n" for name, flow in found.items()))


def main() -> None:
    """Write the six named roads."""
    for name, capacity in capacities().items():
        write(NAMED[name], OPEN / name, f"open/{name}", named(name, capacity), DEFAULT)
        print(OPEN / name, file=sys.stderr)


# ---- inside ----


def _links_of_the_arterial(net: Path, light: str) -> list[int]:
    """Indices of a traffic light's links along the arterial."""
    links = ElementTree.parse(net).getroot().iter("connection")
    mains = [link for link in links if link.get("tl") == light and link.get("dir") == "s"]
    return [int(m.get("linkIndex", "")) for m in mains if m.get("from", "").startswith(("east", "west"))]


def _flows(road: Road, per_hour: float, begin: float, end: float) -> list[str]:
    lines = []
    for number, flow in enumerate(road.flows()):
        way = f'from="{flow.origin}" to="{flow.destination}"'
        rate = f'begin="{begin:g}" end="{end:g}" period="exp({flow.share * per_hour / HOUR:.6f})"'
        departs = f'departLane="{flow.lane}" departSpeed="max"'
        lines.append(f'    <flow id="f{number}_{begin:g}" {way} {rate} {departs}/>')
    return lines


def _routes(comment: str, lines: list[str]) -> str:
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', comment, "<routes>", *lines, "</routes>", ""])


def _write(file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
