"""AVs wave vehicles through: the driver of a waved vehicle no longer waits for that AV at the junction.

SUMO's driver never goes before a vehicle with the right of way, though that vehicle stands and waits for it.
A waved vehicle ignores the AV, and those who stand behind it, as foes (`junctionModel.ignoreIDs`,
https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html); all other foes count as before. In the same way an
AV ignores vehicles that it does not know of (`cosim.simulation.eyes`).
"""

from collections.abc import Collection, Set

from cosim.simulation.backend import sumo

IGNORES = "junctionModel.ignoreIDs"
LEADERS = "carFollowModel.ignoreIDs"  # a driver follows none of these
NOBODY: frozenset[str] = frozenset()


class Waves:
    """Which vehicles each AV waves through now."""

    def __init__(self) -> None:
        self._by: dict[str, frozenset[str]] = {}  # AV -> the vehicles that it waves through
        self._for: dict[str, frozenset[str]] = {}  # AV -> itself and those who cannot come past it
        self._unseen: dict[str, tuple[str, ...]] = {}  # AV -> the vehicles that it does not know of
        self._own_leaders: dict[str, str] = {}  # AV -> the leaders that its file lets it ignore
        self._leaders: dict[str, str] = {}  # AV -> those that it ignores now
        self._own: dict[str, list[str]] = {}  # waved vehicle -> the foes that its file lets it ignore

    def of(self, av: str) -> frozenset[str]:
        """The vehicles that `av` waves through."""
        return self._by.get(av, NOBODY)

    def set(self, av: str, vehicles: Set[str], behind: Set[str] = NOBODY) -> None:
        """From now on `av`, and those who stand `behind` it, let these vehicles through, and no others."""
        before, waits = self.of(av), behind | {av}
        if vehicles == before and (not vehicles or waits == self._for[av]):
            return
        if vehicles:
            self._by[av], self._for[av] = frozenset(vehicles), frozenset(waits)
        else:
            del self._by[av], self._for[av]
        for vehicle in before | vehicles:
            self._tell(vehicle)

    def blind(self, av: str, unseen: Collection[str]) -> None:
        """From now on the driver of `av` heeds none of these: the AV does not know of them."""
        if unseen or av in self._unseen:
            self._unseen[av] = tuple(unseen)
            self._tell(av)
            if not unseen:
                del self._unseen[av]

    def ignore(self, av: str, leaders: Collection[str]) -> None:
        """From now on the driver of `av` follows none of `leaders`: the AV does. Nor the unknown."""
        if av not in self._own_leaders:
            self._own_leaders[av] = sumo.vehicle.getParameter(av, LEADERS)
        ignored = " ".join([self._own_leaders[av], *self._unseen.get(av, ()), *leaders]).strip()
        if ignored != self._leaders.get(av, self._own_leaders[av]):
            self._leaders[av] = ignored
            sumo.vehicle.setParameter(av, LEADERS, ignored)

    def forget(self, av: str) -> None:
        """The AV has left the road, or drives by itself again."""
        for known in (self._unseen, self._own_leaders, self._leaders):
            known.pop(av, None)

    def _tell(self, vehicle: str) -> None:
        get = sumo.vehicle
        waving = {foe for av, vehicles in self._by.items() if vehicle in vehicles for foe in self._for[av]}
        foes = sorted(waving.union(self._unseen.get(vehicle, ())))
        try:
            own = self._own.setdefault(vehicle, get.getParameter(vehicle, IGNORES).split())
            get.setParameter(vehicle, IGNORES, " ".join([*own, *foes]))
        except sumo.TraCIException:  # it has left the road
            foes = []
        if not foes:
            self._own.pop(vehicle, None)
