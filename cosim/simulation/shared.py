"""A simulation shared with other TraCI clients: started by cosim, or started elsewhere and joined."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import libsumo

import sumo_scenarios
from cosim.errors import BadInput, SimulationEnded, SimulationError
from cosim.files.xml_input import is_there, regular_file
from cosim.scenario import FOREIGN_DURATION, Scenario, file_name
from cosim.scenario.sumocfg import time_of
from cosim.scenario.traffic import FORCED, USUAL, check_timing
from cosim.scenario.vehicle_types import VehicleTypes, vehicle_types
from cosim.scenario.vet_net import read_net
from cosim.scenario.vet_rules import some
from cosim.simulation.backend import sumo
from cosim.simulation.client import Client
from cosim.simulation.derived_types import IDM_TYPE, drivers, not_derived
from cosim.simulation.fleet import Fleet, set_type
from cosim.simulation.net import NetReader
from cosim.simulation.sumo import GIVES_UP, SumoSimulator
from cosim.types import OnCollision, Snapshot, Timing

# SUMO options on which the figures depend, with the values that `cosim run` sets.
OURS = {
    "lanechange.duration": USUAL["lanechange.duration"],
    **FORCED,
    "random": "false",
}


class SharedSimulator(SumoSimulator):
    """The common part of both ways: another client or SUMO's owner may end the simulation."""

    _SHARED = True
    _LOST = ""  # message for a failure of SUMO; "": the client's own message
    _over = False  # SUMO answers no more calls

    def _simulate(self) -> None:
        before = sumo.simulation.getTime()
        try:
            sumo.simulationStep()
        except SimulationEnded:
            self._over = True
            raise
        except sumo.FatalTraCIError as error:
            self._end(self._LOST or str(error))
        except sumo.TraCIException as error:
            raise self._explain(error) from None
        if sumo.simulation.getTime() <= before:
            self._end("the last TraCI program has left")
        here = set(sumo.vehicle.getIDList())
        for name in [name for name in self._commander.controlled if name not in here]:
            self._commander.drop(name)  # removed by another client

    def _end(self, why: str) -> NoReturn:
        self._over = True
        raise SimulationEnded(why) from None


class ServingSimulator(SharedSimulator):
    """SUMO in this process, controlled together with `clients` other TraCI clients at `port`.

    `reset` blocks until all clients have connected, so another process has to supervise it.
    """

    _LOST = "a TraCI program broke its connection off"

    def __init__(self, scenario: Scenario, port: int, clients: int, **settings: Any) -> None:
        self._remote: tuple[str, ...] = ()
        self._serves = ("--remote-port", str(port), "--num-clients", str(clients))
        super().__init__(scenario, **settings)

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """Reset after all clients have connected. Raises SimulationEnded if they leave in the warm-up."""
        self._stop()  # `libsumo.load` hangs with clients
        self._remote, self._over = self._serves, False
        return super().reset(seed)

    def _arguments(self, seed: int) -> list[str]:
        return [*super()._arguments(seed), *self._remote]

    def _variable(self) -> list[int]:
        """All lanes: another client may change any speed limit."""
        return list(range(len(self.road.lanes)))

    def _explain(self, error: Exception, *, starting: bool = False) -> Exception:
        found = super()._explain(error, starting=starting)
        if "listening socket" in str(found):
            return BadInput("another program uses this port", field="--traci-port", value=self._serves[1])
        return found


class LentFleet(Fleet):
    """A fleet whose AVs get their original vTypes back at the end."""

    def __init__(self, *settings: Any) -> None:
        super().__init__(*settings)
        self._own: dict[str, tuple[str, float, dict[str, str]]] = {}  # AV -> type, speed factor, parameters

    def _take_av_type(self, vehicle: str) -> None:
        get = sumo.vehicle
        parameters = {key: get.getParameter(vehicle, key) for key in self._av_parameters}
        self._own[vehicle] = get.getTypeID(vehicle), get.getSpeedFactor(vehicle), parameters
        super()._take_av_type(vehicle)

    def hand_back(self) -> None:
        """Restore vType, speed factor and parameters of every AV on the road."""
        give = sumo.vehicle
        for vehicle in self._own.keys() & set(give.getIDList()):
            kind, factor, parameters = self._own[vehicle]
            set_type(vehicle, kind)
            give.setSpeedFactor(vehicle, factor)
            for key, value in parameters.items():
                give.setParameter(vehicle, key, value)


class TraciSimulator(SharedSimulator):
    """A SUMO that cosim did not start. One episode, from its present time; `close` restores the AVs.

    A reason set in `leave` ends the episode before the next step.
    """

    _FLEET = LentFleet

    def __init__(self, scenario: Scenario, client: Client, **settings: Any) -> None:
        self._client = client
        self.leave = ""
        super().__init__(scenario, **settings)

    def close(self) -> None:
        """Restore the AVs and disconnect."""
        if sumo.source is self._client:
            if not self._over:
                with contextlib.suppress(*sumo.errors, SimulationEnded):
                    self._hand_back()
            sumo.bind(libsumo)
        self._client.close()
        super().close()

    def write_outputs(self, files: Mapping[str, Path]) -> None:
        """Refused: outputs belong to SUMO's owner."""
        raise BadInput("a joined SUMO writes outputs only for its owner", field="--output")

    def _hand_back(self) -> None:
        fleet = getattr(self, "_fleet", None)
        if fleet is None:  # nothing has begun
            return
        self._commander.release(())
        if self._wrecks is not None:
            self._wrecks.release()
        fleet.hand_back()

    def _types_of(self, scenario: Scenario) -> VehicleTypes:
        return _readable_types(scenario)

    def _given(self, scenario: Scenario, folder: Path) -> Scenario:
        """The scenario unchanged: SUMO has already read its files."""
        return scenario

    def _open(self) -> None:
        reader = NetReader(self._scenario.net)  # in this process, as a call over the socket takes 0.1 ms
        try:
            self._read_net()
        finally:
            reader.close()
        sumo.bind(self._client)

    def _load(self, seed: int) -> None:
        """Nothing to do: the joined SUMO is loaded."""

    def _simulate(self) -> None:
        if self.leave:
            raise SimulationEnded(self.leave)
        super()._simulate()

    def _explain(self, error: Exception, *, starting: bool = False) -> Exception:
        return SimulationError(f"{self._client.place}: SUMO failed: {error}")


def lost(scenario: Scenario) -> list[str]:
    """Warnings about vType attributes that AVs of a joined SUMO lose, as far as its files are readable."""
    found, fleet = _readable_types(scenario), scenario.fleet
    if not drivers(scenario, frozenset()):
        return []
    meant = found.types if fleet.type is None else found.named(fleet.type)
    missing = {
        f"{name}: {', '.join(words)}"
        for name, kind in found.types.items()
        if name in meant and (words := sorted(not_derived(kind)))
    }
    decided = {name for name in found.listed if not found.named(name).isdisjoint(meant)}
    words = [*sorted(missing), *(f"what is decided by type {name!r}" for name in sorted(decided))]
    return [f"AVs lose what only a type's file can say ({some(words)})"] if words else []


def _readable_types(scenario: Scenario) -> VehicleTypes:
    """The vTypes of a joined SUMO's files; none if a file is invalid here, since SUMO has accepted it."""
    try:
        return vehicle_types(scenario)
    except BadInput:
        return VehicleTypes({}, {}, frozenset(), frozenset())


def theirs(client: Client, net: str | None = None) -> tuple[Scenario, int]:
    """The scenario and seed of a joined SUMO; `net`: path of its net on this machine.

    Files that cannot be read here are left out. Raises BadInput: no readable net, a step length that does not
    divide a frame, a sublane model, AV types not loaded, vehicles on the road already.
    """
    place, option = client.place, client.simulation.getOption

    def readable(name: str) -> tuple[Path, ...]:
        named = (Path(part.strip()) for part in option(name).split(",") if part.strip())
        return tuple(path.absolute() for path in named if is_there(path))

    files = (Path(net),) if net is not None else readable("net-file")
    if not files:
        problem = "cannot be read here: SUMO runs in another folder or on another machine (--net FILE)"
        raise BadInput(problem, file=place, field="net-file", value=option("net-file"))
    found = read_net(regular_file(files[0].absolute(), file=None, field="--net"))
    if float(option("lateral-resolution")) > 0.0:
        problem = "LC2013, which is what AVs drive by, has no sublane model"
        raise BadInput(problem, file=place, field="lateral-resolution", value=option("lateral-resolution"))
    if IDM_TYPE not in client.vehicletype.getIDList():
        problem = f"AVs need cosim's vehicle types: start SUMO with {sumo_scenarios.TYPES} among these files"
        raise BadInput(problem, file=place, field="additional-files", value=option("additional-files"))
    if client.vehicle.getIDList():
        raise BadInput("vehicles are on the road already", file=place, field="load-state")
    begin, end, step = (time_of(option(name), place, name) for name in ("begin", "end", "step-length"))
    timing = replace(Timing(), step=step)
    check_timing(timing, place, "step-length", option("step-length"))
    own = {name: option(name) for name in (*OURS, GIVES_UP)}
    differ = [f"{name} is {own[name]}, not {value}" for name, value in OURS.items() if own[name] != value]
    if client.version != (version := libsumo.getVersion()[1]):
        differ.append(f"{client.version} drives, not {version}")
    configuration = readable("configuration-file")
    scenario = Scenario(
        name=file_name(configuration[0]) if configuration else found.path.name.partition(".")[0],
        config=(*configuration, found.path)[0],
        net=found.path,
        demand=readable("route-files"),
        additional=readable("additional-files"),
        options=tuple(own.items()),
        begin=begin,
        duration=end - begin if end > begin else FOREIGN_DURATION,
        timing=timing,
        on_collision=OnCollision.CONTINUE,
        warnings=(*found.warnings, *(f"{place}: {words}" for words in differ)),
    )
    return scenario, int(option("seed"))
