"""Reads a net with SUMO into a RoadMap, for trajectory files without a running simulation."""

from pathlib import Path

import libsumo

from cosim.errors import BadInput
from cosim.road import RoadMap
from cosim.simulation.convert import read_road
from cosim.simulation.stderr import SumoStderr


class NetReader:
    """Runs in a `cosim.workers.worker.Worker`, since a bad net can crash the process; vet the net first."""

    def __init__(self, net: Path) -> None:
        stderr = SumoStderr()
        try:
            with stderr:
                libsumo.start(
                    ["sumo", "--net-file", str(net), "--no-step-log", "true", "--no-warnings", "true"]
                )
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            words = " ".join((stderr.take() or str(error)).split())
            raise BadInput(f"SUMO refuses it: {words}", file=net) from None
        finally:
            stderr.close()
        self._net = net

    def road(self) -> RoadMap:
        """The map of every lane that is open to motor vehicles."""
        return read_road((), self._net)

    def close(self) -> None:
        """End SUMO."""
        libsumo.close()
