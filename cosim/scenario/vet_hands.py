"""Checks a net's lanes against its declared driving side (`lefthand`)."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from cosim.errors import BadInput
from cosim.scenario.vet_rules import some

MIN_LATERAL_OFFSET = 0.5  # m; nearer lanes do not count as adjacent
WARNING_SHARE, ERROR_SHARE = 0.02, 0.1  # of roads on the wrong side, above which to warn or to refuse

Ends = tuple[tuple[float, ...], tuple[float, ...]]  # x, y m and direction (not normalised) at begin and end


class Hands:
    """A vote on the driving side, by the lanes of every edge and by every pair of opposite edges."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.left = False  # declared by the net: lane 0 and the road itself lie on the left
        self._outer: dict[str, Ends] = {}  # edge -> its lane 0
        self._wrong: dict[str, None] = {}  # edges
        self._fine = 0  # votes for the declared side

    def lane(self, edge: str, shape: str) -> None:
        """The next lane of an edge, from its outer side inwards."""
        ends = _ends(shape)
        outer = self._outer.setdefault(edge, ends)
        if ends is not outer:
            self._vote(edge, outer, ends)

    def warnings(self, ends: Mapping[str, tuple[str, str]]) -> Iterator[str]:
        """Raises BadInput if many lanes contradict the net's `lefthand`; warns about few.

        `ends`: edge -> its start and end junction.
        """
        back = {(start, end): edge for edge, (start, end) in ends.items()}
        for edge, (start, end) in ends.items():
            if start < end and (other := back.get((end, start))) is not None:
                begin, stop = self._outer[other]
                self._vote(edge, self._outer[edge], (stop, begin))
        wrong, hand, other_hand = [*self._wrong], *("left", "right")[:: 1 if self.left else -1]
        every = len(wrong) + self._fine
        where = f"{len(wrong)} of {every} roads lie as in {other_hand}-hand traffic ({some(wrong)})"
        if len(wrong) > ERROR_SHARE * every:
            problem = f"the net is {hand}-hand and {where}"
            raise BadInput(problem, file=self._path, field="net.lefthand", value=str(self.left).lower())
        if len(wrong) > WARNING_SHARE * every:
            yield f"{self._path}: mixed hand: the net is {hand}-hand and {where}"

    def _vote(self, edge: str, outer: Ends, inner: Ends) -> None:
        """Vote: in right-hand traffic `inner` lies to the left of `outer`. No vote if the ends disagree."""
        sides = set()
        for (x, y, dx, dy), (u, v, *_) in zip(outer, inner, strict=True):
            across, along = dx * (v - y) - dy * (u - x), dx * (u - x) + dy * (v - y)
            beside = abs(across) > max(abs(along), MIN_LATERAL_OFFSET * (dx * dx + dy * dy) ** 0.5)
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
