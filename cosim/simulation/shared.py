"""A simulation that other TraCI programs share: ours, which they connect to, or theirs, which we join."""

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

# Options that decide what figures mean, as `cosim run` sets them.
OURS = {
    "lanechange.duration": USUAL["lanechange.duration"],
    **FORCED,
    "random": "false",
}


class SharedSimulator(SumoSimulator):
    """What both ways have in common: it ends when somebody else says so."""

    _SHARED = True
    _LOST = ""  # what it means that SUMO fails; "": what the client says
    _over = False  # nothing more can be asked of SUMO

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
            self._commander.drop(name)  # another program has removed it

    def _end(self, why: str) -> NoReturn:
        self._over = True
        raise SimulationEnded(why) from None


class ServingSimulator(SharedSimulator):
    """SUMO in this process, which `clients` TraCI programs drive together with us at `port`.

    `reset` waits until all of them have connected: in a process that somebody watches.
    """

    _LOST = "a TraCI program broke its connection off"

    def __init__(self, scenario: Scenario, port: int, clients: int, **settings: Any) -> None:
        self._remote: tuple[str, ...] = ()
        self._serves = ("--remote-port", str(port), "--num-clients", str(clients))
        super().__init__(scenario, **settings)

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """As alone, once the others have come. Raises SimulationEnded when they leave in the warm-up."""
        self._stop()  # `libsumo.load` hangs where there are clients
        self._remote, self._over = self._serves, False
        return super().reset(seed)

    def _arguments(self, seed: int) -> list[str]:
        return [*super()._arguments(seed), *self._remote]

    def _variable(self) -> list[int]:
        """Other programs may change any of them."""
        return list(range(len(self.road.lanes)))

    def _explain(self, error: Exception, *, starting: bool = False) -> Exception:
        found = super()._explain(error, starting=starting)
        if "listening socket" in str(found):
            return BadInput("another program uses this port", field="--traci-port", value=self._serves[1])
        return found


class LentFleet(Fleet):
    """AVs that are given back as they were."""

    def __init__(self, *settings: Any) -> None:
        super().__init__(*settings)
        self._own: dict[str, tuple[str, float, dict[str, str]]] = {}  # AV -> type, speed factor, parameters

    def _take_av_type(self, vehicle: str) -> None:
        get = sumo.vehicle
        parameters = {key: get.getParameter(vehicle, key) for key in self._av_parameters}
        self._own[vehicle] = get.getTypeID(vehicle), get.getSpeedFactor(vehicle), parameters
        super()._take_av_type(vehicle)

    def hand_back(self) -> None:
        """Every AV on the road is again what it was when it departed."""
        give = sumo.vehicle
        for vehicle in self._own.keys() & set(give.getIDList()):
            kind, factor, parameters = self._own[vehicle]
            set_type(vehicle, kind)
            give.setSpeedFactor(vehicle, factor)
            for key, value in parameters.items():
                give.setParameter(vehicle, key, value)


class TraciSimulator(SharedSimulator):
    """A SUMO that somebody else started. One episode, from where it stands; `close` hands the AVs back.

    `leave` set to a reason ends it before the next step.
    """

    _FLEET = LentFleet

    def __init__(self, scenario: Scenario, client: Client, **settings: Any) -> None:
        self._client = client
        self.leave = ""
        super().__init__(scenario, **settings)

    def close(self) -> None:
        """Give every AV its own driver back, and leave."""
        if sumo.source is self._client:
            if not self._over:
                with contextlib.suppress(*sumo.errors, SimulationEnded):
                    self._hand_back()
            sumo.bind(libsumo)
        self._client.close()
        super().close()

    def write_outputs(self, files: Mapping[str, Path]) -> None:
        """They are the owner's to ask for."""
        raise BadInput("SUMO's outputs are written by who starts it", field="--output")

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
        """SUMO has its files."""
        return scenario

    def _open(self) -> None:
        reader = NetReader(self._scenario.net)  # in this process: over the socket each call takes 0.1 ms
        try:
            self._read_net()
        finally:
            reader.close()
        sumo.bind(self._client)

    def _load(self, seed: int) -> None:
        """It is loaded."""

    def _simulate(self) -> None:
        if self.leave:
            raise SimulationEnded(self.leave)
        super()._simulate()

    def _explain(self, error: Exception, *, starting: bool = False) -> Exception:
        return SimulationError(f"{self._client.place}: SUMO failed: {error}")


def lost(scenario: Scenario) -> list[str]:
    """What AVs of a joined SUMO are not as its files say: warnings, as far as these can be read here."""
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
    """As far as the files of a joined SUMO are found right: it is SUMO that judges them."""
    try:
        return vehicle_types(scenario)
    except BadInput:
        return VehicleTypes({}, {}, frozenset(), frozenset())


def theirs(client: Client, net: str | None = None) -> tuple[Scenario, int]:
    """What a joined SUMO simulates, as a scenario, and its seed; `net`: where its net lies on this machine.

    Files that cannot be read here are left out. Raises BadInput: no net to read, a step length that does not
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
