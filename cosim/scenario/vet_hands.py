"""Tell from a net's lanes on which side of the road its traffic drives, and whether all of it agrees."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from cosim.errors import BadInput
from cosim.scenario.vet_rules import some

BESIDE = 0.5  # m: lanes that are nearer do not lie beside one another
FEW, MANY = 0.02, 0.1  # shares of roads on the wrong side: odd shapes up to here; above, the net is refused

Ends = tuple[tuple[float, ...], tuple[float, ...]]  # x, y m and direction (not normalised) at begin and end


class Hands:
    """The lanes of every edge vote, and every pair of edges between two junctions."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.left = False  # what the net says: lane 0 and the road itself lie on the left
        self._outer: dict[str, Ends] = {}  # edge -> its lane 0
        self._wrong: dict[str, None] = {}  # edges
        self._fine = 0  # votes as the net says

    def lane(self, edge: str, shape: str) -> None:
        """The next lane of an edge, from its outer side inwards."""
        ends = _ends(shape)
        outer = self._outer.setdefault(edge, ends)
        if ends is not outer:
            self._vote(edge, outer, ends)

    def warnings(self, ends: Mapping[str, tuple[str, str]]) -> Iterator[str]:
        """Raises BadInput for a net whose lanes are not where its `lefthand` says; a few of them: a warning.

        `ends`: edge -> the junctions that it leaves and reaches.
        """
        back = {(start, end): edge for edge, (start, end) in ends.items()}
        for edge, (start, end) in ends.items():
            if start < end and (other := back.get((end, start))) is not None:
                begin, stop = self._outer[other]
                self._vote(edge, self._outer[edge], (stop, begin))
        wrong, hand, other_hand = [*self._wrong], *("left", "right")[:: 1 if self.left else -1]
        every = len(wrong) + self._fine
        where = f"{len(wrong)} of {every} roads lie as in {other_hand}-hand traffic ({some(wrong)})"
        if len(wrong) > MANY * every:
            problem = f"the net is {hand}-hand and {where}"
            raise BadInput(problem, file=self._path, field="net.lefthand", value=str(self.left).lower())
        if len(wrong) > FEW * every:
            yield f"{self._path}: mixed hand: the net is {hand}-hand and {where}"

    def _vote(self, edge: str, outer: Ends, inner: Ends) -> None:
        """`inner` must lie to the left of `outer` in right-hand traffic; it votes where both ends agree."""
        sides = set()
        for (x, y, dx, dy), (u, v, *_) in zip(outer, inner, strict=True):
            across, along = dx * (v - y) - dy * (u - x), dx * (u - x) + dy * (v - y)
            beside = abs(across) > max(abs(along), BESIDE * (dx * dx + dy * dy) ** 0.5)
            sides.add(across > 0.0 if beside else None)
        if len(sides) > 1 or None in sides:
            return
        if (True in sides) != self.left:
            self._fine += 1
        else:
            self._wrong[edge] = None


def _ends(shape: str) -> Ends:
    points = [[float(n) for n in point.split(",")[:2]] for point in shape.split()]
    (x, y), (u, v) = points[0], points[-1]
    (a, b), (c, d) = points[1], points[-2]
    return (x, y, a - x, b - y), (u, v, u - c, v - d)
