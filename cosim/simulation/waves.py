"""AVs wave vehicles through: the driver of a waved vehicle no longer waits for that AV at the junction.

SUMO's driver never goes before a vehicle with the right of way, though that vehicle stands and waits for it.
A waved vehicle ignores the AV as a foe (`junctionModel.ignoreIDs`,
https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html); all other foes count as before.
"""

from collections.abc import Set

from cosim.simulation.backend import sumo

IGNORES = "junctionModel.ignoreIDs"
NOBODY: frozenset[str] = frozenset()


class Waves:
    """Which vehicles each AV waves through now."""

    def __init__(self) -> None:
        self._by: dict[str, frozenset[str]] = {}  # AV -> the vehicles that it waves through
        self._own: dict[str, list[str]] = {}  # waved vehicle -> the foes that its file lets it ignore

    def of(self, av: str) -> frozenset[str]:
        """The vehicles that `av` waves through."""
        return self._by.get(av, NOBODY)

    def set(self, av: str, vehicles: Set[str]) -> None:
        """From now on `av` waves these vehicles through, and no others."""
        before = self.of(av)
        if vehicles == before:
            return
        if vehicles:
            self._by[av] = frozenset(vehicles)
        else:
            del self._by[av]
        for vehicle in before ^ vehicles:
            self._tell(vehicle)

    def _tell(self, vehicle: str) -> None:
        get = sumo.vehicle
        try:
            own = self._own.setdefault(vehicle, get.getParameter(vehicle, IGNORES).split())
            waved_by = [av for av, vehicles in self._by.items() if vehicle in vehicles]
            get.setParameter(vehicle, IGNORES, " ".join([*own, *waved_by]))
        except sumo.TraCIException:  # it has left the road
            waved_by = []
        if not waved_by:
            self._own.pop(vehicle, None)
