"""Human errors of an episode: one trial per driver and second or per manoeuvre, drawn from hashes."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.road import RoadMap
from cosim.scenario.human_errors import Errors
from cosim.scenario.tilt import Tilt
from cosim.seeding import subseed, uniforms
from cosim.simulation.backend import sumo
from cosim.simulation.convert import PERSON, Body
from cosim.simulation.driver_errors import crossing, driving
from cosim.simulation.driver_errors.kind import ErrorKind, UnderWay
from cosim.simulation.driver_errors.surroundings import Surroundings, leader
from cosim.simulation.driver_errors.tilted import Tilted
from cosim.simulation.drivers import Drivers
from cosim.types import ERROR_MEMORY, Collision, HumanError, Kind

# In the order of their trials: per second, per manoeuvre, then of persons.
KINDS: tuple[type[ErrorKind], ...] = (
    driving.Inattention,
    driving.HardBraking,
    driving.CutIn,
    driving.AbortedCutIn,
    driving.StalledCar,
    crossing.FailureToYield,
    crossing.RedLight,
    crossing.ForcedEntry,
    crossing.StepOut,
)


class HumanErrors:
    """The errors of one episode. `step`: s, of the simulation.

    A trial compares a number hashed from (root seed, kind, driver, second or manoeuvre) with the kind's rate.
    So draws are equal under every policy. An error begins if the trial succeeds and the driver is eligible.
    Eligibility never depends on the draw. No error begins before `begin`, so none in the warm-up.
    """

    def __init__(
        self, errors: Errors, road: RoadMap, drivers: Drivers, seed: int, step: float, tilt: Tilt | None
    ) -> None:
        around = Surroundings(road)
        self._around, self._drivers, self._seed = around, drivers, seed
        self._kinds = [
            kind(config, around, drivers, seed, step)
            for kind in KINDS
            if (config := getattr(errors.kinds, kind.name)) is not None
        ]
        self._every_second = [kind for kind in self._kinds if kind.every_second]
        self._step_out = next((kind for kind in self._kinds if isinstance(kind, crossing.StepOut)), None)
        others = (*self._every_second, self._step_out)
        self._per_manoeuvre = [kind for kind in self._kinds if kind not in others]
        self._rates = np.array([kind.config.rate for kind in self._every_second])  # [k]
        self._tilted = Tilted(tilt, seed)
        self._raised = np.array([self._tilted.raises(kind.name) for kind in self._every_second], bool)  # [k]
        self._avs: set[str] = set()
        self._streams: dict[str, Any] = {}  # HV on the road -> [k] random streams
        self._under_way: dict[str, tuple[ErrorKind, UnderWay]] = {}
        self._ended: dict[str, float] = {}  # driver -> end of the last error, s
        self._tried: set[tuple[str, str, str]] = set()  # kind, HV, `Trial.which`
        self._happened: list[HumanError] = []
        self._next: float | None = None  # s, time of the next trials

    # ---- calls of the simulator

    def begin(self, now: float) -> None:
        """The counted time begins; the first trials follow 1 s later."""
        self._next = now + 1.0

    def hold(self) -> None:
        """No further error begins."""
        self._next = None

    def depart(self, name: str, body: Body) -> None:
        """A vehicle has departed."""
        if body.kind == Kind.AV:
            self._avs.add(name)
        if body.kind == Kind.HV:
            streams = [subseed(self._seed, "error", kind.name, name) for kind in self._every_second]
            self._streams[name] = np.array(streams, np.uint64)

    def drop(self, name: str) -> None:
        """The vehicle left the road, crashed, or got another driver; its state is not restored."""
        self._avs.discard(name)
        self._streams.pop(name, None)
        self._forget(name)
        found = self._under_way.pop(name, None)
        if found is not None:
            self._ended[name] = min(found[1].error.until, sumo.simulation.getTime())
            self._drivers.resume(name)

    def step(self, now: float) -> None:
        """After a simulation step that ended at `now` (s)."""
        for name, (kind, under_way) in [*self._under_way.items()]:
            try:
                if kind.step(name, under_way, now):
                    self._end(name)
            except sumo.TraCIException:  # removed, neither arrived nor crashed
                self.drop(name)
        if self._next is not None and now >= self._next - 1e-6:
            self._next += 1.0
            self._trials(now)

    def take(self) -> tuple[HumanError, ...]:
        """The errors that began since the last call."""
        found = tuple(self._happened)
        self._happened.clear()
        return found

    def attribute(self, collisions: Sequence[Collision]) -> list[Collision]:
        """The collisions with `human_error_involved` set: whether collider, victim or a leader of either has
        an active error, or had one at most `ERROR_MEMORY` s before."""
        return [replace(c, human_error_involved=self._involves_error(c)) for c in collisions]

    @property
    def tilted(self) -> tuple[float, dict[str, list[float]]]:
        """The log likelihood ratio of the episode, and its weighted trials by case."""
        return self._tilted.log_ratio, self._tilted.weighed

    # ---- trials

    def _trials(self, now: float) -> None:
        """The trials of one second."""
        second, on_road = round(now), frozenset(sumo.vehicle.getIDList())
        for name in self._streams.keys() - on_road:
            self.drop(name)
        self._avs &= on_road
        names = [*self._streams]
        self._tilted.look(names, self._avs, self._under_way, self._ended, now)
        if names and self._every_second:
            drawn = uniforms(np.array([*self._streams.values()]), second)  # [n,k]
            looked_at = drawn < self._rates
            if self._tilted.active:
                looked_at |= np.outer([self._tilted.weighs(name) for name in names], self._raised)
            for row, k in np.argwhere(looked_at).tolist():
                self._run_trial(self._every_second[k], names[row], self._rates[k], drawn[row, k], now)
        if self._per_manoeuvre:
            for name in names:
                self._manoeuvres(name, now)
        if self._step_out is not None and sumo.person.getIDCount():
            for person in sumo.person.getIDList():
                if sumo.person.getWaitingTime(person) > 0.0:
                    kind, name = self._step_out, PERSON + person
                    self._run_trial(kind, name, kind.config.rate, kind.draw(name, f"{second}"), now)

    def _run_trial(self, kind: ErrorKind, name: str, rate: float, drawn: float, now: float) -> None:
        """One trial. Eligibility is checked only if the result depends on it."""
        if not (drawn < rate or self._tilted.weighs(name)) or name in self._under_way:
            return
        chance = kind.eligible(name, now)
        if chance is None:
            return
        meets_av = chance.other in self._avs or kind.other_unknown
        if drawn < self._tilted.probability(name, kind.name, rate, drawn, meets_av):
            under_way = kind.begin(name, now, chance)
            self._under_way[name] = kind, under_way
            self._happened.append(under_way.error)

    def _manoeuvres(self, name: str, now: float) -> None:
        """Trials at stop lines, signals and lane ends."""
        lane = self._around.lane_of(name)
        if not lane or lane[0] == ":":
            self._forget(name)
            return
        place = self._around.place(lane, name)
        if place is None:
            return
        for kind in self._per_manoeuvre:
            trial = kind.trial(name, place, now)
            if trial is None:
                continue
            if trial.once:
                key = kind.name, name, trial.which
                if key in self._tried:
                    continue
                self._tried.add(key)
            self._run_trial(kind, name, trial.rate, kind.draw(name, trial.which), now)

    # ---- inside

    def _forget(self, name: str) -> None:
        for kind in self._per_manoeuvre:
            kind.forget(name)

    def _end(self, name: str) -> None:
        kind, under_way = self._under_way.pop(name)
        self._ended[name] = sumo.simulation.getTime()
        kind.end(name, under_way)

    def _involves_error(self, collision: Collision) -> bool:
        now = collision.time
        pair = [collision.collider, collision.victim]
        return any(
            name in self._under_way or now - self._ended.get(name, -math.inf) <= ERROR_MEMORY
            for name in (*pair, *filter(None, map(leader, pair)))
        )
