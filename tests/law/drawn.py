"""Junctions drawn from a seed: arms, angles, lanes and traffic, of every type that SUMO has rules for."""

from __future__ import annotations

import math
import random
import subprocess
from collections.abc import Sequence
from pathlib import Path

import sumo

KINDS = (
    *("priority", "priority_stop", "allway_stop", "right_before_left", "left_before_right", "zipper"),
    *("traffic_light", "traffic_light_right_on_red", "roundabout", "left_hand", "two_junctions"),
)
END = 180.0  # s
NO_TURNAROUNDS = ("--no-turnarounds", "true")
ARM, RING = 130.0, 18.0  # m
TYPES = """<vType id="car"/><vType id="eager" tau="0.6" impatience="0.5"/>
<vType id="truck" vClass="truck" length="12" width="2.5" accel="1.2"/>
<vTypeDistribution id="mix" vTypes="car eager truck" probabilities="0.7 0.2 0.1"/>"""
CONFIG = """<configuration><net-file value="net.net.xml"/><route-files value="demand.rou.xml"/>
<begin value="0"/><end value="{end:g}"/></configuration>"""


def draw(folder: Path, kind: str, seed: int) -> Path:
    """The .sumocfg of a junction of this kind with saturated traffic over all its arms, in `folder`."""
    rng = random.Random(f"{kind}/{seed}")
    folder.mkdir(parents=True, exist_ok=True)
    nodes, edges, ends = _roads(kind, rng)
    left_hand = ("--lefthand", "true") if kind == "left_hand" else ()
    build_net(folder, nodes, edges, *NO_TURNAROUNDS, *left_hand)
    return configuration(folder, f"<routes>{TYPES}{''.join(_flows(kind, ends, rng))}</routes>", END)


def build_net(folder: Path, nodes: Sequence[str], edges: Sequence[str], *options: str) -> str:
    """The name of the net that netconvert makes in `folder` of nodes and edges, each in XML."""
    for kind, root, parts in (("nod", "nodes", nodes), ("edg", "edges", edges)):
        (folder / f"x.{kind}.xml").write_text(f"<{root}>{''.join(parts)}</{root}>")
    netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    files = ("-n", "x.nod.xml", "-e", "x.edg.xml", "-o", "net.net.xml")
    subprocess.run([netconvert, *files, *options], cwd=folder, check=True, capture_output=True)
    return "net.net.xml"


def configuration(folder: Path, routes: str, end: float) -> Path:
    """The .sumocfg in `folder` of its net and these routes, in XML; it ends at `end` (s)."""
    (folder / "demand.rou.xml").write_text(routes)
    config = folder / "run.sumocfg"
    config.write_text(CONFIG.format(end=end))
    return config


def _roads(kind: str, rng: random.Random) -> tuple[list[str], list[str], list[str]]:
    """Nodes and edges as XML; the names of the arms."""
    arms = rng.choice((3, 4, 4, 5)) if kind != "zipper" else 3
    slots = [2.0 * math.pi * (k + rng.uniform(-0.18, 0.18)) / arms for k in range(arms)]
    limit = rng.choice((8.33, 13.89, 16.67))  # m/s
    major = rng.sample(range(arms), 2)
    nodes, edges, names = [], [], []
    centres = _centres(kind, slots, nodes, edges, limit)
    for k, angle in enumerate(slots):
        x, y = ARM * math.cos(angle), ARM * math.sin(angle)
        nodes.append(f'<node id="n{k}" x="{x:.1f}" y="{y:.1f}"/>')
        priority, lanes = (4 if k in major else 2), rng.choice((1, 1, 2))
        entry, out = centres[k]
        lanes_in = 1 if kind == "roundabout" else lanes
        common = f'speed="{limit}" priority="{priority}"'
        edges.append(f'<edge id="in{k}" from="n{k}" to="{entry}" numLanes="{lanes_in}" {common}/>')
        edges.append(f'<edge id="out{k}" from="{out}" to="n{k}" numLanes="{lanes}" {common}/>')
        names.append(str(k))
    return nodes, edges, names


def _centres(
    kind: str, slots: list[float], nodes: list[str], edges: list[str], limit: float
) -> list[tuple[str, str]]:
    """For each arm the junctions at which it enters and leaves."""
    if kind == "roundabout":
        for k, angle in enumerate(slots):
            x, y = RING * math.cos(angle), RING * math.sin(angle)
            nodes.append(f'<node id="r{k}" x="{x:.1f}" y="{y:.1f}" type="priority"/>')
            then = (k + 1) % len(slots)
            edges.append(f'<edge id="ring{k}" from="r{k}" to="r{then}" numLanes="1" speed="8" priority="9"/>')
        return [(f"r{k}", f"r{k}") for k in range(len(slots))]
    named = "priority" if kind in ("left_hand", "two_junctions") else kind
    if kind != "two_junctions":
        nodes.append(f'<node id="j" x="0" y="0" type="{named}"/>')
        return [("j", "j")] * len(slots)
    for name, x in (("j", -20.0), ("k", 20.0)):
        nodes.append(f'<node id="{name}" x="{x}" y="0" type="priority"/>')
    for a, b in (("j", "k"), ("k", "j")):
        edges.append(f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="{limit}" priority="4"/>')
    return [("k", "k") if math.cos(angle) > 0.0 else ("j", "j") for angle in slots]


def _flows(kind: str, ends: list[str], rng: random.Random) -> list[str]:
    """A flow between any two arms (at a zipper from all to the last one), by the time at which it begins."""
    goals = ends[-1:] if kind == "zipper" else ends
    pairs = [(start, end) for start in ends for end in goals if start != end]
    period = 4.0 * len(ends), 16.0 * len(ends)  # s
    begins = sorted(rng.uniform(0.0, 10.0) for _ in pairs)
    return [
        f'<flow id="{start}{end}" type="mix" from="in{start}" to="out{end}" begin="{begin:.1f}" '
        f'end="{END}" period="{rng.uniform(*period):.1f}" departLane="best" departSpeed="max"/>'
        for begin, (start, end) in zip(begins, rng.sample(pairs, len(pairs)), strict=True)
    ]
