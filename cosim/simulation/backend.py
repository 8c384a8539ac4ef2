"""SUMO's API for this process: libsumo, or a TraCI client when joining a running SUMO.

There is one simulation per process, hence one object, `sumo`. libsumo and traci have the same calls with the
same types and values.
"""

from collections.abc import Callable
from typing import Any

import libsumo

NAMES = (
    *("edge", "junction", "lane", "person", "polygon", "simulation", "trafficlight", "vehicle"),
    *("vehicletype", "simulationStep", "constants", "TraCIException", "FatalTraCIError"),
)


class Backend:
    """SUMO's domains and exceptions by their names; initially bound to libsumo."""

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
        """Direct all calls to `source`: libsumo, or a `cosim.simulation.client.Client`."""
        self.source = source
        for name in NAMES:
            setattr(self, name, getattr(source, name))

    @property
    def errors(self) -> tuple[type[Exception], ...]:
        """All exceptions of a call: FatalTraCIError is no subclass of TraCIException."""
        return self.TraCIException, self.FatalTraCIError

    def getter(self, domain: str, name: str) -> Callable[[str], Any]:
        """`DOMAIN.getNAME`, compiled if possible: libsumo's Python wrappers double the cost of a read."""
        if self.source is libsumo:
            found: Callable[[str], Any] = getattr(libsumo._libsumo, f"{domain}_get{name}")
        else:
            found = getattr(getattr(self, domain), f"get{name}")
        return found


sumo = Backend()
