"""Starts SUMO through libsumo and advances it one decision at a time: the only simulation of its process."""

import contextlib
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import libsumo
import numpy as np

import sumo_scenarios
from cosim.arrays import Floats
from cosim.errors import BadInput, SimulationError, SimulationInUse
from cosim.road import RoadMap
from cosim.scenario import Scenario
from cosim.scenario.behaviors import AS_IS
from cosim.scenario.disabled_outputs import NOWHERE, disable_outputs
from cosim.scenario.sensing import Parameters
from cosim.scenario.sumo_outputs import sumo_options
from cosim.scenario.sumocfg import time_of
from cosim.scenario.traffic import CHECKS_INSIDE, FORCED, USUAL, check
from cosim.scenario.vehicle_types import VehicleTypes, vehicle_types
from cosim.seeding import uniform
from cosim.sensing.perception import Perception
from cosim.simulation.backend import sumo
from cosim.simulation.collisions import CollisionDetector, Wrecks
from cosim.simulation.commands import Commander
from cosim.simulation.convert import Body, SnapshotReader, read_road, struggling_lanes
from cosim.simulation.derived_types import drivers
from cosim.simulation.driver_errors.trials import HumanErrors
from cosim.simulation.drivers import Drivers
from cosim.simulation.entries import EntryWatcher
from cosim.simulation.fleet import Fleet
from cosim.simulation.fork import forked
from cosim.simulation.lawful import Lawful
from cosim.simulation.stderr import SumoStderr
from cosim.simulation.xerces import keep_initialized
from cosim.types import (
    INSIDE,
    Collision,
    Command,
    Compensator,
    Due,
    Events,
    Kind,
    OnCollision,
    Preset,
    Receipt,
    Snapshot,
    Traffic,
)

ONE_SPEED = {"default.speeddev": "0"}  # `cosim.scenario.behaviors` draws the desired speeds instead
QUIET = {
    "no-step-log": "true",
    "no-warnings": "true",
    "duration-log.disable": "true",
    "xml-validation": "never",  # cosim.scenario.vet has read the files already
}
# SUMO's messages during a run, when it loads routes, about a vehicle that cannot depart as written.
WRONG_DEMAND = re.compile(
    r"[Ii]nvalid depart|Departure \w+ .*for vehicle|has no valid route|No connection between edge|[Pp]erson '"
)
NO_FILES = {"device.ssm.file": NOWHERE}  # a vType with this device would write a file per vehicle
GIVES_UP = "max-depart-delay"  # SUMO drops vehicles that waited longer, without a message
DERIVED = "types.add.xml"  # file of the derived vTypes

_in_use = False


class SumoSimulator:
    """`cosim.types.Simulator` on SUMO. Raises SimulationInUse when this process already holds one.

    `reset` returns `history` frames, so that an agent starts with a full history.
    """

    # set before the first `reset`:
    compensator: Compensator | None = None  # for sensing with latency compensation
    courtesy: float = 1.0  # share of commanded AVs that are courteous in preset `lawful`, 0 to 1
    _SHARED = False  # whether other TraCI clients control the simulation too
    _FLEET: type[Fleet] = Fleet

    def __init__(
        self, scenario: Scenario, *, av_parameters: Mapping[str, str] | None = None, history: int = 10
    ) -> None:
        global _in_use
        if _in_use or libsumo.isLoaded():
            raise SimulationInUse(
                "this process already runs a simulation, and libsumo would silently replace it: "
                "use one process per simulation (cosim.envs and cosim.open do)"
            )
        check(scenario)
        self._latency_steps = _latency_steps(scenario)
        self._types = self._types_of(scenario)
        fleet = scenario.fleet.type
        self._av_types = frozenset() if fleet is None else self._types.named(fleet)
        self._scratch = tempfile.TemporaryDirectory(prefix="cosim-")
        self._scenario = self._given(scenario, Path(self._scratch.name))
        self._av_parameters = dict(av_parameters or {})
        self._history = history
        self._stderr = SumoStderr()
        self._started = self._closed = False
        self._outputs: dict[str, Path] = {}
        self._checks_inside = CHECKS_INSIDE in {c.option for c in scenario.changed}  # not by the file
        _in_use = True
        timing = scenario.timing
        self._steps_per_frame = round(timing.frame / timing.step)
        self._steps_per_decision = round(timing.decision / timing.step)
        patience = time_of(dict(scenario.options).get(GIVES_UP, "-1"), scenario.config, GIVES_UP)  # s
        self._gives_up = 0.0 <= patience < scenario.warmup + scenario.duration
        self.road: RoadMap
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self._reader = SnapshotReader(self.road, self._variable())
        self._entries = EntryWatcher(self.road, scenario.timing.step, self._SHARED)

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """Load the episode of `seed` and drive the warm-up; return the last `history` frames, newest last."""
        self._load(seed)
        self._seed = seed
        self._drivers = Drivers(self._scenario.behavior, self._scenario.driver_model, seed)
        self._fleet = self._FLEET(self._scenario, self._drivers, self._av_parameters, self._av_types)
        preset, step = self._scenario.preset, self._scenario.timing.step
        self._commander = (
            Lawful(step, self.road, self._courteous) if preset == Preset.LAWFUL else Commander(preset, step)
        )
        self._commander.shared = self._SHARED
        self._bodies: dict[str, Body] = {}
        self._routes: dict[str, tuple[str, ...]] = {}
        self._detector = CollisionDetector()
        errors = self._scenario.errors
        # with human errors, human drivers collide too, and only an AV's collision ends the episode
        goes_on = self._scenario.on_collision == OnCollision.CONTINUE or errors is not None
        # in as-is traffic the file's collision.action decides what happens to crashed vehicles
        goes_on = goes_on and self._scenario.traffic == Traffic.CONTROLLED
        self._wrecks = Wrecks(self._commander, self._drivers) if goes_on else None
        self._errors = (
            None
            if errors is None
            else HumanErrors(errors, self.road, self._drivers, seed, step, self._scenario.tilt)
        )
        sensing = self._scenario.sensing
        self._perception = (
            None
            if sensing is None
            else Perception(
                *(self.road, sensing.parameters, self._scenario.timing, seed, self.compensator),
                buildings=_buildings(sensing.parameters),
            )
        )
        self._reader.bodies_changed()
        self._entries.reset()
        self._mission_found = not self._scenario.mission.guessed
        self._inserted = 0
        self._stopped: set[str] = set()  # vehicles at a <stop>
        self._waiting: dict[str, Due] = {}  # due but not inserted, including those dropped by SUMO
        self._acting: Sequence[Command] = ()
        self._receipts: tuple[Receipt, ...] = ()
        self._happened: list[tuple[Any, ...]] = []  # per step since the last frame: the fields of Events
        steps = round(self._scenario.warmup / self._scenario.timing.step)
        first_kept = steps - (self._history - 1) * self._steps_per_frame
        frames = []
        with self._stderr:
            for k in range(1, steps + 1):
                self._step()
                if k >= first_kept and (steps - k) % self._steps_per_frame == 0:
                    frames.append(self._snapshot())
        if self._errors is not None:
            self._errors.begin(sumo.simulation.getTime())
        return tuple(frames) or (self._snapshot(),)

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        """Apply the commands for one decision; one snapshot per frame. Raises SimulationError.

        With a `decision_latency` the commands act that much later. Until then the previous commands hold, and
        the receipts belong to those.
        """
        late = self._latency_steps
        with self._stderr:
            if not late:
                self._act(commands)
            frames = self._drive(late or self._steps_per_decision)
            receipts = self._commander.confirm(self._receipts, self._acting)
            if late:
                self._act(commands)
                frames += self._drive(self._steps_per_decision - late, driven=late)
        return receipts, frames

    def _act(self, commands: Sequence[Command]) -> None:
        """Apply these commands from now on."""
        now = sumo.simulation.getTime()
        self._commander.release(commands)
        self._acting = commands
        self._receipts = tuple(self._commander.take(c, now) for c in commands)

    def _drive(self, steps: int, *, driven: int = 0) -> tuple[Snapshot, ...]:
        """Advance; one snapshot per frame. `driven`: steps since the decision."""
        frames = []
        for k in range(driven + 1, driven + steps + 1):
            self._commander.drive()
            self._step()
            if k % self._steps_per_frame == 0:
                frames.append(self._snapshot())
        return tuple(frames)

    def ahead(self, frames: int, commands: Sequence[Command] = ()) -> tuple[Snapshot, ...]:
        """A counterfactual rollout of `frames` frames: the present commands hold, except for `commands`.

        SUMO continues in a copy of this process (`cosim.simulation.fork`); this process does not change.
        Active human errors continue, no new ones begin.

        Raises SimulationError. Raises BadInput if the copy would also write SUMO's outputs, or talk to other
        TraCI clients.
        """
        if self._outputs or self._SHARED:
            why = "other programs share it" if self._SHARED else "SUMO writes outputs of its own"
            raise BadInput(f"rollouts are impossible in this simulation: {why}", file=self._scenario.config)
        return forked(partial(self._drive_on, frames, commands))

    def _drive_on(self, frames: int, commands: Sequence[Command]) -> tuple[Snapshot, ...]:
        """The rollout, in the copy of the process."""
        if self._errors is not None:
            self._errors.hold()
        with self._stderr:
            now = sumo.simulation.getTime()
            for command in commands:
                self._commander.take(command, now)
            return self._drive(frames * self._steps_per_frame)

    def route(self, vehicle: str) -> tuple[str, ...]:
        """The remaining edges of the route, the present one first."""
        index = max(sumo.vehicle.getRouteIndex(vehicle), 0)
        edges = self._routes.get(vehicle)
        if edges is None:
            edges = self._routes[vehicle] = tuple(sumo.vehicle.getRoute(vehicle))
        return edges[index:] if index else edges

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        """Target speed in m/s (None: unknown) and the lane change under way."""
        state = self._commander.controlled.get(vehicle)
        if state is None:
            return self._commander.default_target_speed(vehicle), 0
        return state.target, state.changing(sumo.simulation.getTime())

    @property
    def tilted(self) -> tuple[float, dict[str, list[float]]]:
        """Of this episode's errors: log(q / p); case -> number begun near AVs, and the sum of p."""
        return (0.0, {}) if self._errors is None else self._errors.tilted

    def counts(self) -> dict[str, int]:
        """Vehicle counts: `inserted` since the start, and `waiting` at the last frame. Waiting vehicles are
        due but not inserted, including those dropped by SUMO (`max-depart-delay`)."""
        return {"inserted": self._inserted, "waiting": len(self._waiting)}

    def write_outputs(self, files: Mapping[str, Path]) -> None:
        """SUMO's own outputs (name -> file, `cosim.scenario.sumo_outputs`) from the next episode on."""
        self._outputs = dict(files)

    def finish_outputs(self) -> None:
        """End SUMO, which completes its files; the next `reset` starts SUMO without outputs."""
        self._outputs = {}
        self._stop()

    def _stop(self) -> None:
        if self._started:
            self._started = False
            with self._stderr:
                libsumo.close()

    def driver_classes(self) -> dict[str, str]:
        """Each HV's Table II class (empty in as-is traffic): for drawing, not for policies."""
        return dict(self._drivers.classes)

    def close(self) -> None:
        """End SUMO and free the process for another simulation."""
        global _in_use
        if self._closed:
            return
        self._closed = True
        self.finish_outputs()
        self._stderr.close()
        self._scratch.cleanup()
        _in_use = False

    def _types_of(self, scenario: Scenario) -> VehicleTypes:
        """The types that the scenario's files define."""
        return vehicle_types(scenario)

    def _given(self, scenario: Scenario, folder: Path) -> Scenario:
        """The scenario passed to SUMO, with edited copies of some files in `folder`."""
        ours = drivers(scenario, self._av_types)
        if not scenario.ships:
            # a user's detectors would write beside the scenario, and workers would overwrite the files
            scenario = disable_outputs(scenario, folder, partial(self._types.also, drivers=ours))
        if not ours:
            return scenario
        derived = folder / DERIVED
        self._types.write(derived, ours)
        return replace(scenario, additional=(*scenario.additional, derived))

    def _variable(self) -> list[int]:
        """The lanes whose speed limit may change while SUMO drives."""
        may = self._types.variable
        return [k for k, lane in enumerate(self.road.lanes) if lane.id in may or lane.edge in may]

    def _open(self) -> None:
        """Read the parts that are equal in all episodes."""
        self._load(seed=0)
        self._read_net()

    def _read_net(self) -> None:
        self.road = read_road(self._scenario.zones, self._scenario.config)
        self.goal_lanes, self._struggling = self._goal()

    def _courteous(self, av: str) -> bool:
        return uniform(self._seed, "courtesy", av) < self.courtesy

    def _load(self, seed: int) -> None:
        arguments = self._arguments(seed)
        try:
            with self._stderr:
                if self._started:
                    libsumo.load(arguments)
                else:
                    libsumo.start(["sumo", *arguments])
                    self._started = True
                    keep_initialized()
        except sumo.errors as error:
            self._started = libsumo.isLoaded()
            raise self._explain(error, starting=True) from None

    def _arguments(self, seed: int) -> list[str]:
        s = self._scenario
        controlled = s.traffic == Traffic.CONTROLLED
        without = not controlled or (s.built_in and s.preset != Preset.LAWFUL)
        types = () if without else (sumo_scenarios.TYPES,)
        additional = (*s.additional, *types)
        settings, files = sumo_options(self._outputs, s)
        options = {
            "net-file": str(s.net),
            "route-files": ",".join(map(str, s.demand)),
            "additional-files": ",".join(map(str, additional)),
            "begin": f"{s.begin:.12g}",
            "step-length": f"{s.timing.step:.12g}",
            "seed": str(seed % (2**31 - 1)),
            **(USUAL if controlled else {}),
            **(ONE_SPEED if s.ships or s.behavior != AS_IS else {}),
            **({} if s.ships else NO_FILES),
            **settings,
            **dict(s.options),
            **(FORCED if controlled else {}),
            **QUIET,
            **files,
        }
        return [text for key, value in options.items() if value for text in (f"--{key}", value)]

    def _explain(self, error: Exception, *, starting: bool = False) -> Exception:
        words = " ".join((self._stderr.take() or str(error)).split())
        if starting:  # an error before the first step is wrong input
            return BadInput(f"SUMO refuses it: {words}", file=self._scenario.config)
        warned = "".join(f"; found before: {warning}" for warning in self._scenario.warnings)
        if WRONG_DEMAND.search(words):
            files = ", ".join(map(str, self._scenario.demand)) or self._scenario.config
            return BadInput(f"SUMO refuses it: {words}{warned}", file=files)
        return SimulationError(f"{self._scenario.config}: SUMO failed: {words}{warned}")

    def _simulate(self) -> None:
        """One simulation step of SUMO."""
        try:
            sumo.simulationStep()
        except sumo.errors as error:
            raise self._explain(error) from None

    def _step(self) -> None:
        simulation = sumo.simulation
        self._simulate()
        departed = simulation.getDepartedIDList()
        self._inserted += len(departed)
        for name in departed:
            self._waiting.pop(name, None)
            self._bodies[name] = self._fleet.depart(name, self._seed)
            if self._errors is not None:
                self._errors.depart(name, self._bodies[name])
        arrived = simulation.getArrivedIDList()
        for name in arrived:
            self._commander.drop(name)
            self._routes.pop(name, None)
            if self._errors is not None:
                self._errors.drop(name)
        if self._SHARED or simulation.getDepartedPersonNumber() or simulation.getArrivedPersonNumber():
            self._reader.persons_changed()
        now = simulation.getTime()
        self._detector.inserted((*departed, *simulation.getEndingTeleportIDList()), now)
        collisions = self._detector.from_sumo(self._bodies, self._commander.lane_changes, now)
        collisions = self._crashed(collisions)
        if self._wrecks is not None and self._wrecks.remove(now):
            self._reader.persons_changed()
        self._happened.append(
            (
                collisions,
                departed,
                arrived,
                simulation.getStartingTeleportIDList(),
                simulation.getEmergencyStoppingVehiclesIDList(),
                self._entries.step(now, [i for i in departed if self._bodies[i].kind == Kind.AV]),
                self._commander.find_interventions(now),
                [sumo.vehicle.getDepartDelay(name) for name in departed],
            )
        )
        self._stopped.update(simulation.getStopStartingVehiclesIDList())
        self._stopped.difference_update(simulation.getStopEndingVehiclesIDList())
        if self._gives_up:
            self._update_waiting()
        self._drivers.step(now)
        if self._errors is not None:
            self._errors.step(now)

    def _update_waiting(self) -> None:
        """Update the vehicles waiting for insertion, including those that SUMO has given up."""
        pending = sumo.simulation.getPendingVehicles()
        if not self._gives_up and self._waiting:
            self._waiting = {name: self._waiting[name] for name in pending if name in self._waiting}
        for name in pending:
            if name not in self._waiting:
                with contextlib.suppress(sumo.TraCIException):  # another program has removed it
                    since = sumo.simulation.getTime() - sumo.vehicle.getDepartDelay(name)
                    self._waiting[name] = Due(since, self._fleet.is_av(name, self._seed))

    def _crashed(self, collisions: list[Collision]) -> list[Collision]:
        """Attribute the collisions to human errors; in a continuing episode their vehicles become wrecks."""
        if self._errors is not None and collisions:
            collisions = self._errors.attribute(collisions)
        if self._wrecks is not None:
            for name in self._wrecks.add([c for c in collisions if not self._overlooked(c)]):
                if self._errors is not None:
                    self._errors.drop(name)
        return collisions

    def _overlooked(self, collision: Collision) -> bool:
        """Whether two HVs collided inside a junction, which the user's file does not have SUMO check.

        Many nets have lanes there that lie too close. Both HVs drive on, as they would without AVs.
        """
        avs = collision.collider_is_av or collision.victim_is_av
        return self._checks_inside and collision.kind == INSIDE and not avs and self._errors is None

    def _snapshot(self) -> Snapshot:
        happened = (tuple(chain.from_iterable(field)) for field in zip(*self._happened, strict=True))
        events = replace(Events(*happened), stopped=tuple(sorted(self._stopped)))
        self._happened.clear()
        self._update_waiting()
        snapshot = self._reader.read(self._bodies, events, dict(self._waiting))
        if not self._mission_found:
            snapshot = self._find_mission(snapshot)
        self._detector.lane_changes(snapshot, self.road, self._commander)
        extra = self._detector.from_boxes(snapshot, self.road, self._bodies, self._commander.lane_changes)
        wrecked: tuple[str, ...] = ()
        removed: tuple[str, ...] = ()
        extra = self._crashed(extra)
        overlaps = self._detector.overlaps()
        if self._wrecks is not None:
            wrecked, removed = self._wrecks.take()
        errors = () if self._errors is None else self._errors.take()
        if extra or wrecked or removed or errors or overlaps:
            events = replace(
                snapshot.events,
                collisions=(*snapshot.events.collisions, *extra),
                wrecked=wrecked,
                wrecks_removed=removed,
                errors=errors,
                overlaps=overlaps,
            )
            snapshot = replace(snapshot, events=events)
        if self._perception is not None:
            snapshot = replace(snapshot, percepts=self._perception.perceive(snapshot))
            self._commander.update_percepts(snapshot)
        return snapshot

    def _goal(self) -> tuple[frozenset[int], frozenset[int]]:
        """Goal lanes of the mission, and lanes on which an HV becomes the mission vehicle."""
        mission, lanes = self._scenario.mission, self.road.lanes
        if mission.kind == "auto":
            struggling = struggling_lanes(self.road)
            return frozenset(i for i, lane in enumerate(lanes) if not lane.internal) - struggling, struggling
        missing = [e for e in mission.goal if not any(lane.edge == e for lane in lanes)]
        if missing:
            raise BadInput(
                "the net has no such edge",
                file=self._scenario.config,
                field="mission.goal",
                value=missing[0],
            )
        return frozenset(i for i, lane in enumerate(lanes) if lane.edge in mission.goal), frozenset()

    def _find_mission(self, snapshot: Snapshot) -> Snapshot:
        """Guess the mission vehicle: the first HV (by id) on a lane that ends or must yield."""
        humans = np.flatnonzero(snapshot.kind == Kind.HV)
        row = next((k for k in humans if snapshot.lane[k] in self._struggling), None)
        if row is None:
            return snapshot
        name = snapshot.ids[row]
        self._bodies[name] = replace(self._bodies[name], mission=True, guessed=True)
        self._mission_found = True
        self._reader.bodies_changed()
        return self._reader.read(self._bodies, snapshot.events, snapshot.waiting)


def _latency_steps(scenario: Scenario) -> int:
    """Steps from a decision to its effect. Raises BadInput if that exceeds the decision period."""
    if scenario.sensing is None:
        return 0
    latency, timing = scenario.sensing.parameters.decision_latency, scenario.timing
    if latency > timing.decision + 1e-9:
        problem = f"must be at most the {timing.decision:g} s between decisions"
        raise BadInput(problem, field="--sensing.decision_latency", value=latency)
    return round(scenario.decision_latency / timing.step)


def _buildings(level: Parameters) -> list[Floats]:
    """The outlines [.,2] m of the polygons that occlude sensors."""
    if not level.line_of_sight:
        return []
    shapes, wanted = sumo.polygon, level.buildings
    found = [(name, shapes.getType(name)) for name in sorted(shapes.getIDList())]
    hiding = [name for name, kind in found if kind == wanted or kind.startswith(f"{wanted}.")]
    return [np.array(shapes.getShape(name), np.float64)[:, :2] for name in hiding]
