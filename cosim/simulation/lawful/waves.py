"""AVs wave vehicles through: SUMO's driver of a waved vehicle no longer waits for that AV at the junction.

SUMO's driver never goes before a vehicle with priority, even if that vehicle stands and waits for it. A waved
vehicle therefore ignores the AV, and the queue behind the AV, as foes (`junctionModel.ignoreIDs`,
https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html). All other foes count as before. An AV ignores
vehicles that it does not know of (`cosim.simulation.eyes`) in the same way.
"""

from collections.abc import Collection, Set

from cosim.simulation.backend import sumo

FOE_PARAMETER = "junctionModel.ignoreIDs"
LEADER_PARAMETER = "carFollowModel.ignoreIDs"  # of vehicles that a driver does not follow
EMPTY: frozenset[str] = frozenset()


class Waves:
    """The vehicles that each AV waves through now."""

    def __init__(self) -> None:
        self._waved: dict[str, frozenset[str]] = {}  # AV -> the vehicles that it waves through
        self._queues: dict[str, frozenset[str]] = {}  # AV -> the AV and the queue behind it
        self._unknown: dict[str, tuple[str, ...]] = {}  # AV -> the vehicles that it does not know of
        self._file_leaders: dict[str, str] = {}  # AV -> the leaders that the scenario makes it ignore
        self._ignored_leaders: dict[str, str] = {}  # AV -> the leaders that it ignores now
        self._file_foes: dict[str, list[str]] = {}  # waved vehicle -> foes that the scenario makes it ignore

    def waved(self, av: str) -> frozenset[str]:
        """The vehicles that `av` waves through."""
        return self._waved.get(av, EMPTY)

    def set(self, av: str, vehicles: Set[str], behind: Set[str] = EMPTY) -> None:
        """Let `av`, and the queue `behind` it, wave these vehicles through, and no others."""
        before, waits = self.waved(av), behind | {av}
        if vehicles == before and (not vehicles or waits == self._queues[av]):
            return
        if vehicles:
            self._waved[av], self._queues[av] = frozenset(vehicles), frozenset(waits)
        else:
            del self._waved[av], self._queues[av]
        for vehicle in before | vehicles:
            self._write_foes(vehicle)

    def hide(self, av: str, unknown: Collection[str]) -> None:
        """Make SUMO's driver of `av` ignore vehicles that are unknown to the AV."""
        if tuple(unknown) != self._unknown.get(av, ()):
            self._unknown[av] = tuple(unknown)
            self._write_foes(av)

    def ignore_leaders(self, av: str, leaders: Collection[str]) -> None:
        """Make SUMO's driver of `av` ignore `leaders`, which the AV follows itself, and unknown vehicles."""
        if av not in self._file_leaders:
            self._file_leaders[av] = sumo.vehicle.getParameter(av, LEADER_PARAMETER)
        ignored = " ".join([self._file_leaders[av], *self._unknown.get(av, ()), *leaders]).strip()
        if ignored != self._ignored_leaders.get(av, self._file_leaders[av]):
            self._ignored_leaders[av] = ignored
            sumo.vehicle.setParameter(av, LEADER_PARAMETER, ignored)

    def forget(self, av: str) -> None:
        """The AV has left the road."""
        for known in (self._unknown, self._file_leaders, self._ignored_leaders):
            known.pop(av, None)

    def _write_foes(self, vehicle: str) -> None:
        get = sumo.vehicle
        avs = {foe for av, vehicles in self._waved.items() if vehicle in vehicles for foe in self._queues[av]}
        foes = sorted(avs.union(self._unknown.get(vehicle, ())))
        try:
            own = self._file_foes.setdefault(vehicle, get.getParameter(vehicle, FOE_PARAMETER).split())
            get.setParameter(vehicle, FOE_PARAMETER, " ".join([*own, *foes]))
        except sumo.TraCIException:  # the vehicle has left the road
            foes = []
        if not foes:
            self._file_foes.pop(vehicle, None)
