"""Reads a SUMO net as a stream: refuses faults that crash or mislead SUMO, keeps names to check routes."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from cosim.errors import BadInput
from cosim.files.xml_input import Progress, scan
from cosim.scenario.vet_hands import Hands
from cosim.scenario.vet_rules import NET, Reader, some
from cosim.scenario.vet_signals import PHASELESS, SignalReader, check_lengths

_CROSSING = re.compile(r":(.+)_c\d+")  # netconvert's name for the crossings of a junction


@dataclass(frozen=True, slots=True)
class Net:
    """The names and connections of a net, without geometry."""

    path: Path
    lanes: Mapping[str, int]  # edge -> number of lanes; internal edges (":...") included
    junctions: frozenset[str]
    links: frozenset[tuple[str, str]]  # (edge, edge) pairs joined by a connection
    ends: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # edge -> start and end junction
    signals: Mapping[str, int] = field(default_factory=dict)  # tlLogic -> number of needed signals
    warnings: tuple[str, ...] = ()

    def has_lane(self, lane: str) -> bool:
        """Whether "edge_2" is a lane of this net."""
        edge, _, index = lane.rpartition("_")
        return index.isdigit() and int(index) < self.lanes.get(edge, 0)


def read_net(path: Path, progress: Progress | None = None) -> Net:
    """Check the net `path`; `progress` in bytes.

    Raises:
        BadInput: a file that `cosim.files.xml_input.scan` refuses; no `version` (SUMO crashes); NaN, infinite
            or negative numbers; speed limits of 0; gaps in lane indices; connections to missing lanes;
            right-of-way tables that do not fit the connections of their junctions (SUMO crashes too);
            signals without a program or with a malformed one; lanes that contradict `lefthand`.
    """
    reader = _NetReader(path)
    scan(path, ("net",), reader.start, reader.end, progress=progress)
    return reader.finish()


class _NetReader(Reader):
    """The handlers of one pass over a net."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._lanes: dict[str, int] = {}
        self._origins: dict[str, str] = {}  # edge -> start junction, without internal edges
        self._ends: dict[str, str] = {}  # edge -> end junction
        self._junctions: dict[str, str] = {}  # junction -> type
        self._requests: Counter[str] = Counter()  # junction -> rows of its right-of-way table
        self._inside: dict[str, list[str]] = {}  # junction -> its internal lanes
        self._links: dict[tuple[str, str, str, str], tuple[int, str]] = {}  # -> line, via
        self._edge: str | None = None
        self._junction = ""
        self._signals = SignalReader(path)
        self._signalled: dict[str, dict[int, int]] = {}  # tlLogic -> its link indices -> line
        self._lit: set[str] = set()  # junctions with a signalled connection
        self._hands = Hands(path)
        self._opposite: list[str] = []  # edges that allow overtaking on the opposite side

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if tag == "net":
            self._check_version(attributes)
        self._check(tag, attributes, NET.get(tag, {}), attributes.get("id", ""), line)
        self._signals.start(tag, attributes, line)
        if tag == "net":
            self._hands.left = attributes.get("lefthand", "") in ("1", "true", "True")
        elif tag == "neigh" and self._edge is not None:
            self._opposite.append(self._edge)
        if tag == "request":
            self._request(attributes, line)
        elif tag == "lane":
            self._lane(attributes, line)
        elif tag == "edge":
            self._open_edge(attributes, line)
        elif tag == "junction":
            self._junction = self._need("junction", "id", attributes, line)
            kind = self._junctions[self._junction] = attributes.get("type", "")
            if self._junction.startswith(":") != (kind == "internal"):
                self._refuse(tag, "type", kind, "does not fit the junction's id", self._junction, line)
            self._inside[self._junction] = attributes.get("intLanes", "").split()
        elif tag == "connection":
            names = ("from", "to", "fromLane", "toLane")
            a, b, i, j = (self._need("connection", name, attributes, line) for name in names)
            self._links[a, b, i, j] = (line, attributes.get("via", ""))
            if "tl" in attributes:
                self._signal(a, attributes, line)

    def end(self, tag: str) -> None:
        self._signals.end(tag)
        if tag == "edge" and self._edge is not None:
            if not self._lanes[self._edge]:
                raise BadInput("has no lane", file=self._path, field="edge.id", value=self._edge)
            self._edge = None

    def finish(self) -> Net:
        """The net. Raises BadInput if a connection joins missing lanes."""
        net = Net(
            path=self._path,
            lanes=self._lanes,
            junctions=frozenset(self._junctions),
            links=frozenset((a, b) for a, b, _, _ in self._links),
            ends={edge: (start, self._ends[edge]) for edge, start in self._origins.items()},
            signals={name: max(indices) + 1 for name, indices in self._signalled.items()},
        )
        counts = Counter[str]()
        for (a, b, i, j), (line, via) in self._links.items():
            for end, edge, lane in (("from", a, i), ("to", b, j)):
                if edge not in self._lanes:
                    self._refuse("connection", end, edge, "no such edge in the net", "", line)
                if int(lane) >= self._lanes[edge]:
                    self._refuse("connection", f"{end}Lane", lane, f"edge {edge} has no such lane", "", line)
            if via and not net.has_lane(via):
                self._refuse("connection", "via", via, "no such lane in the net", "", line)
            if a in self._ends and not b.startswith(":"):  # ":J_w0" is a sidewalk
                counts[self._ends[a]] += 1
        self._check_ends()
        self._check_inside()
        self._check_junctions(counts, net)
        if not self._lanes:
            raise BadInput("holds no edge", file=self._path, field="net", value=0)
        self._check_signals(net)
        warnings = (*self._unlit(), *self._hands.warnings(net.ends), *self._overtaking())
        return replace(net, warnings=warnings)

    def _signal(self, edge: str, attributes: dict[str, str], line: int) -> None:
        index = int(float(self._need("connection", "linkIndex", attributes, line)))
        name = attributes["tl"]
        self._signalled.setdefault(name, {})[index] = line
        if edge in self._ends:
            self._lit.add(self._ends[edge])

    def _check_signals(self, net: Net) -> None:
        """Check that every signalled connection has a program with a signal for it in every phase."""
        known = {name for name, _ in self._signals.programs}
        for name, indices in self._signalled.items():
            if self._junctions.get(name) in PHASELESS:
                continue  # SUMO generates their programs
            lowest = min(indices)
            if name not in known:
                self._refuse("connection", "tl", name, "no such tlLogic in the net", "", indices[lowest])
            if lowest < 0:
                self._refuse(
                    "connection", "linkIndex", str(lowest), "must be at least 0", "", indices[lowest]
                )
        check_lengths(self._path, self._signals.programs, net.signals)

    def _unlit(self) -> Iterator[str]:
        """Warn of traffic-light junctions without signalled connections: SUMO applies right of way there."""
        through = {self._ends[a] for a, b, *_ in self._links if a in self._ends and not b.startswith(":")}
        kinds = {name for name, kind in self._junctions.items() if kind.startswith("traffic_light")}
        if dark := sorted((kinds & through) - self._lit):
            yield f"{self._path}: no signal at {some(dark)} of type traffic_light: right of way rules there"

    def _overtaking(self) -> Iterator[str]:
        if edges := sorted({edge for edge in self._opposite if not edge.startswith(":")}):
            yield (
                f"{self._path}: overtaking on the opposite side is allowed on {some(edges)}: vehicles there "
                "are taken to be on their own side"
            )

    def _check_version(self, attributes: dict[str, str]) -> None:
        version = attributes.get("version")
        if version is None:
            problem_ = "is missing (SUMO crashes on such a net): build it with netconvert"
            raise BadInput(problem_, file=self._path, field="net.version", value="")
        if not re.fullmatch(r"\d+(\.\d+)*", version) or int(version.split(".")[0]) > 1:
            raise BadInput(
                "is not a version that SUMO 1 reads", file=self._path, field="net.version", value=version
            )

    def _open_edge(self, attributes: dict[str, str], line: int) -> None:
        edge = self._need("edge", "id", attributes, line)
        if edge in self._lanes:
            self._refuse("edge", "id", edge, "is there twice", "", line)
        self._edge = edge
        self._lanes[edge] = 0
        if edge.startswith(":"):
            function = attributes.get("function", "")
            if function not in ("internal", "crossing", "walkingarea"):
                self._refuse("edge", "function", function, "must be internal", edge, line)
            return
        for name, ends in (("from", self._origins), ("to", self._ends)):
            ends[edge] = self._need("edge", name, attributes, line)

    def _lane(self, attributes: dict[str, str], line: int) -> None:
        lane = self._need("lane", "id", attributes, line)
        for name in ("index", "length", "speed", "shape"):
            self._need("lane", name, attributes, line)
        if self._edge is None:
            self._refuse("lane", "id", lane, "is outside every edge", "", line)
        expected = self._lanes[self._edge]
        internal = self._edge.startswith(":")  # netconvert itself repeats an index inside junctions
        if attributes["index"] != str(expected) and not (internal and int(attributes["index"]) < expected):
            gap = f"lane indices must run 0, 1, 2, ...: {expected} is due"
            self._refuse("lane", "index", attributes["index"], gap, lane, line)
        if lane != f"{self._edge}_{expected}":
            self._refuse("lane", "id", lane, f"must be {self._edge}_{expected}", "", line)
        if len(attributes["shape"].split()) < 2:
            self._refuse("lane", "shape", attributes["shape"], "needs at least two points", lane, line)
        self._lanes[self._edge] = expected + 1
        if not internal:
            self._hands.lane(self._edge, attributes["shape"])

    def _request(self, attributes: dict[str, str], line: int) -> None:
        """Check a row of the right-of-way table: SUMO uses its entries as indices."""
        due = self._requests[self._junction]
        self._requests[self._junction] += 1
        for name, allowed in (("index", (str(due),)), ("cont", ("0", "1", "false", "true"))):
            if attributes.get(name, allowed[0]) not in allowed:
                problem_ = f"must be {' or '.join(allowed)}"
                self._refuse("request", name, attributes[name], problem_, self._junction, line)

    def _check_ends(self) -> None:
        """Check that every edge begins and ends at an existing junction."""
        for place, ends in (("edge.from", self._origins), ("edge.to", self._ends)):
            for edge, junction in ends.items():
                if junction not in self._junctions:
                    problem_ = f"no such junction in the net (edge {edge})"
                    raise BadInput(problem_, file=self._path, field=place, value=junction)

    def _check_inside(self) -> None:
        """Check that every internal lane of a connection leads out of its junction; SUMO does not."""
        leaving = {link for link in self._links if link[0].startswith(":")}
        with_via = {self._ends[a] for (a, *_), (_, via) in self._links.items() if via and a in self._ends}
        for (a, b, _, j), (line, via) in self._links.items():
            edge, _, index = via.rpartition("_")
            if via and (edge, b, index, j) not in leaving:
                self._refuse("connection", "via", via, f"leads from {a} to nowhere near {b}_{j}", "", line)
            if via and a in self._ends and not via.startswith(f":{self._ends[a]}_"):
                self._refuse("connection", "via", via, f"is not in junction {self._ends[a]}", "", line)
            if via and a.startswith(":") and via not in self._junctions:
                self._refuse("connection", "via", via, "no such internal junction in the net", "", line)
            if not via and not b.startswith(":") and self._ends.get(a) in with_via:
                self._refuse("connection", "via", "", f"is missing, {a} to {b}", "", line)

    def _check_junctions(self, connections: Mapping[str, int], net: Net) -> None:
        """Check that a right-of-way table has one row per connection and crossing of its junction."""
        crossings = Counter(m[1] for m in map(_CROSSING.fullmatch, self._lanes) if m)
        for junction, rows in self._requests.items():
            wanted = connections.get(junction, 0) + crossings[junction]
            if rows != wanted:
                problem_ = (
                    f"has {rows} right-of-way rows for {wanted} connections: rebuild it with netconvert"
                )
                raise BadInput(problem_, file=self._path, field="junction.id", value=junction)
        for junction, lanes in self._inside.items():
            for lane in lanes:
                if not net.has_lane(lane):
                    problem_ = f"no such lane in the net (junction {junction})"
                    raise BadInput(problem_, file=self._path, field="junction.intLanes", value=lane)

    def _need(self, tag: str, name: str, attributes: dict[str, str], line: int) -> str:
        if name not in attributes:
            self._refuse(tag, name, "", "is missing", attributes.get("id", ""), line)
        return attributes[name]
