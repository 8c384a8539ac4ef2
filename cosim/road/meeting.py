"""Which lanes' vehicles can meet ahead: an entry and the exit beside it never do, however they bend."""

from functools import cached_property

from cosim.road import RoadMap
from cosim.road.contact import REACH
from cosim.road.too_close import heed_each_other


class Meeting:
    """Answers for pairs of lanes (indices into `RoadMap.lanes`; -1: off every lane, meets all).

    Vehicles on two lanes can meet when the ways ahead of both, up to `REACH` m beyond the lane's end and
    with all lanes of an edge, have an edge in common, or lead over lanes inside a junction that part, join or
    cross, or of which one gives way to the other (`heed_each_other`).
    """

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._ahead: dict[str, frozenset[str]] = {}
        self._known: dict[tuple[str, str], bool] = {}

    def meet(self, a: int, b: int) -> bool:
        if min(a, b) < 0:
            return True
        lanes = self._road.lanes
        pair = min(lanes[a].edge, lanes[b].edge), max(lanes[a].edge, lanes[b].edge)
        if pair not in self._known:
            self._known[pair] = self._edges_meet(*pair)
        return self._known[pair]

    def _edges_meet(self, a: str, b: str) -> bool:
        mine, theirs = self._edges_ahead(a), self._edges_ahead(b)
        if not mine.isdisjoint(theirs):
            return True
        inside, others = (
            [k for edge in edges for k in self._members[edge] if self._road.lanes[k].internal]
            for edges in (mine, theirs)
        )
        return any(
            self._road.lanes[k].start == self._road.lanes[m].start and heed_each_other(self._road, k, m)
            for k in inside
            for m in others
        )

    def _edges_ahead(self, edge: str) -> frozenset[str]:
        """The edge and those that one drives on to within `REACH` m of its end."""
        if edge not in self._ahead:
            begins = {edge: 0.0}  # edge -> m from the end of the first one to its beginning
            waiting = [edge]
            while waiting:
                here = waiting.pop()
                for k in self._members[here]:
                    lane = self._road.lanes[k]
                    at = begins[here] + (0.0 if here == edge else lane.length)
                    for following in lane.successors:
                        after = self._road.lanes[following].edge
                        if at < min(REACH, begins.get(after, REACH)):
                            begins[after] = at
                            waiting.append(after)
            self._ahead[edge] = frozenset(begins)
        return self._ahead[edge]

    @cached_property
    def _members(self) -> dict[str, list[int]]:
        """Edge -> its lanes."""
        found: dict[str, list[int]] = {}
        for k, lane in enumerate(self._road.lanes):
            found.setdefault(lane.edge, []).append(k)
        return found
