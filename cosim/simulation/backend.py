"""SUMO's calls as this process makes them: libsumo's, unless it joins a SUMO that somebody else started.

There is one simulation per process, so there is one such object, `sumo`. libsumo and traci have the same
calls with the same types and values.
"""

from collections.abc import Callable
from typing import Any

import libsumo

NAMES = (
    *("edge", "junction", "lane", "person", "polygon", "simulation", "trafficlight", "vehicle"),
    *("vehicletype", "simulationStep", "constants", "TraCIException", "FatalTraCIError"),
)


class Backend:
    """The domains by SUMO's names, and SUMO's exceptions; bound to libsumo at first."""

    edge: Any
    junction: Any
    lane: Any
    person: Any
    polygon: Any
    simulation: Any
    trafficlight: Any
    vehicle: Any
    vehicletype: Any
    simulationStep: Any
    constants: Any
    TraCIException: Any
    FatalTraCIError: Any

    def __init__(self) -> None:
        self.bind(libsumo)

    def bind(self, source: Any) -> None:
        """Call `source` from now on: libsumo, or a `cosim.simulation.client.Client`."""
        self.source = source
        for name in NAMES:
            setattr(self, name, getattr(source, name))

    @property
    def errors(self) -> tuple[type[Exception], ...]:
        """Everything that a call raises: the second of SUMO's two is not one of the first."""
        return self.TraCIException, self.FatalTraCIError

    def getter(self, domain: str, name: str) -> Callable[[str], Any]:
        """`DOMAIN.getNAME`: the compiled one, since libsumo's Python wrappers double the cost of a read."""
        if self.source is libsumo:
            found: Callable[[str], Any] = getattr(libsumo._libsumo, f"{domain}_get{name}")
        else:
            found = getattr(getattr(self, domain), f"get{name}")
        return found


sumo = Backend()
