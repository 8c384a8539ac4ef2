"""Lets human drivers and persons err: one trial per driver and second or per manoeuvre, drawn from hashes."""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cosim.control import LANE_CHANGE_TIME
from cosim.road import RoadMap
from cosim.scenario.human_errors import KINDS, Errors, ForcedEntry, Span
from cosim.scenario.tilt import Tilt, case, log_ratio
from cosim.seeding import subseed, uniform, uniforms
from cosim.simulation.backend import sumo
from cosim.simulation.convert import PERSON, Body, may_change
from cosim.simulation.drivers import Drivers
from cosim.simulation.mobil import LEFT, RIGHT, route_allows
from cosim.types import REMEMBERED, Bools, Collision, HumanError, Kind

# SUMO's speed mode (Change_Vehicle_State): what an erring driver no longer heeds.
SAFE_SPEED, MAX_ACCEL, MAX_DECEL, RIGHT_OF_WAY, RED_LIGHT = 1, 2, 4, 8, 16
IGNORES_JUNCTION = 32  # also those who are inside the junction already
BLIND = 0  # neither speed nor lane-change mode heeds anybody; its own lane changes are off

MOVES = 1.0  # m/s: slower than that nobody errs by driving on
SLOW = 3.0  # m/s, at most, of who waits at a line
AT_LINE = 15.0  # m before the line within which it waits
APPROACHES = 30.0  # m before the line within which it looks who has the right of way
SEES_SIGNAL = 150.0  # m before the line
LEAST_GAP = 1.0  # m, bumper to bumper, ahead and behind: less is beside, where nobody changes lanes
HARDEST = 9.0  # m/s2: it does not change lanes to where it cannot stop itself
WITHIN = 100.0  # m, in which others are looked for
PASSES = 10.0  # s at most for driving through a junction
HOLDS = 4.0  # s that a forced lane change may take
NEAR = 60.0  # m: within that of an AV errors may be tilted
MEET_ANYBODY = ("red_light", "step_out")  # kinds of which nobody knows before whom they meet

# Kinds drawn every second for every driver; the others belong to a manoeuvre.
EVERY_SECOND = ("inattention", "hard_braking", "cut_in", "aborted_cut_in", "stalled_car")
# what a person who steps out has, and what holds where its type does not say
IGNORE = {
    "jmDriveAfterRedTime": ("1000", "-1"),
    "jmIgnoreFoeProb": ("1", "0"),
    "jmIgnoreFoeSpeed": ("100", "0"),
}


# A trial whose error can begin yields whom it would meet ("": nobody); resumed, it begins.
Trial = Generator[str, None, "Erring | None"]


class Gap(NamedTuple):
    """A place to enter, as somebody who comes leaves it."""

    asked: float  # m/s2, the deceleration with which that one can still avoid a contact
    lag: float  # s until it would be there at its speed
    whom: str = ""  # who comes; "": nobody


NOBODY = Gap(0.0, math.inf)


@dataclass(slots=True)
class Erring:
    """One error under way, and what is given back when it ends."""

    error: HumanError
    modes: tuple[int, int] = (0, 0)  # speed mode and lane-change mode before
    deceleration: float | None = None  # m/s2, of a driver who holds (0) or lowers its speed
    swerves: tuple[float, int] | None = None  # s, when it changes back, and to which side
    leaves: str = ""  # it ends when the vehicle has left this edge and the junction behind it
    heeds: dict[str, str] | None = None  # what `IGNORE` names, of a person, before


class HumanErrors:
    """The errors of one episode. `step`: of the simulation, s.

    A trial holds a number hashed from (root seed, kind, who, second or manoeuvre) against the kind's rate, so
    draws are equal under every policy. An error begins where it was drawn and can begin; whether it can
    never depends on the draw. Nobody errs before `begin`: the warm-up is as without errors.
    """

    def __init__(
        self, errors: Errors, road: RoadMap, drivers: Drivers, seed: int, step: float, tilt: Tilt | None
    ) -> None:
        self._kinds = {name: kind for name in KINDS if (kind := getattr(errors.kinds, name)) is not None}
        self._road, self._drivers, self._seed, self._step = road, drivers, seed, step
        names = "LaneID", "LanePosition", "Speed"
        self._lane_of, self._position_of, self._speed_of = (sumo.getter("vehicle", name) for name in names)
        self._every_second = [name for name in EVERY_SECOND if name in self._kinds]
        self._rates = np.array([self._kinds[name].rate for name in self._every_second])  # [k]
        self._tilt = tilt
        self._tilted = tilt is not None and tilt.drawn(seed)
        raised = [tilt is not None and tilt.raises(kind) for kind in self._every_second]
        self._raised = np.array(raised, bool)  # [k]
        self.log_ratio = 0.0  # of the trials so far
        self._avs: set[str] = set()
        self._near: frozenset[str] = frozenset()  # whose trials are weighed
        self._during: frozenset[str] = frozenset()  # of these, near somebody who errs
        self._begun = 0  # errors from raised probabilities
        self.weighed: dict[str, list[float]] = {}  # `case` -> errors begun, sum of p of its trials
        self._streams: dict[str, Any] = {}  # HV on the road -> [k] its streams of draws
        self._erring: dict[str, Erring] = {}
        self._ended: dict[str, float] = {}  # who erred before -> s, when that ended
        self._waited: dict[str, int] = {}  # HV -> s that it has waited for a gap
        self._tried: set[tuple[str, str, str]] = set()  # manoeuvres: kind, HV, edge
        self._wants: dict[tuple[str, str], tuple[int, float]] = {}  # route, lane -> `_needed_change`
        self._happened: list[HumanError] = []
        self._next: float | None = None  # s, of the next trials
        lanes = road.lanes
        self._gives_way = frozenset(lanes[k.origin].id for k in road.links if k.foes)
        self._signals = frozenset(lanes[k.origin].id for k in road.links if k.signal >= 0)

    # ---- what the simulator tells

    def begin(self, now: float) -> None:
        """The counted time begins: the first trials are a second later."""
        self._next = now + 1.0

    def hold(self) -> None:
        """No further error begins."""
        self._next = None

    def depart(self, name: str, body: Body) -> None:
        """A vehicle has departed."""
        if body.kind == Kind.AV:
            self._avs.add(name)
        if body.kind == Kind.HV:
            kinds = self._every_second
            self._streams[name] = np.array([subseed(self._seed, "error", k, name) for k in kinds], np.uint64)

    def drop(self, name: str) -> None:
        """It has left the road, crashed, or is driven by somebody else from now on; it is left as it is."""
        self._avs.discard(name)
        self._streams.pop(name, None)
        self._waited.pop(name, None)
        erring = self._erring.pop(name, None)
        if erring is not None:
            self._ended[name] = min(erring.error.until, sumo.simulation.getTime())
            self._drivers.resume(name)

    def restore(self) -> None:
        """End every error under way now; everybody drives as before it."""
        for name in [*self._erring]:
            self._end(name)

    def step(self, now: float) -> None:
        """After a simulation step that ended at `now` (s)."""
        for name in [*self._erring]:
            try:
                self._go_on(name, now)
            except sumo.TraCIException:  # taken off the road, neither arrived nor crashed
                self.drop(name)
        if self._next is not None and now >= self._next - 1e-6:
            self._next += 1.0
            self._trials(now)

    def take(self) -> tuple[HumanError, ...]:
        """The errors that began since this was asked last."""
        found = tuple(self._happened)
        self._happened.clear()
        return found

    def attribute(self, collisions: Sequence[Collision]) -> list[Collision]:
        """The same, each with `human_error_involved`: whether the collider, the victim, or the vehicle just
        ahead of either is erring, or was so at most `REMEMBERED` s before."""
        return [replace(c, human_error_involved=self._had_a_part(c)) for c in collisions]

    # ---- trials

    def _trials(self, now: float) -> None:
        """Those of one second."""
        second, on_road = round(now), frozenset(sumo.vehicle.getIDList())
        for name in self._streams.keys() - on_road:
            self.drop(name)
        self._avs &= on_road
        names = [*self._streams]
        if self._tilt is not None and self._begun < 2:
            self._near, self._during = self._beside_avs(names, now)
        if names and self._every_second:
            drawn = uniforms(np.array([*self._streams.values()]), second)  # [n,k]
            looked_at = drawn < self._rates
            if self._near and self._begun < 2:
                looked_at |= np.outer([self._is_weighed(name) for name in names], self._raised)
            for row, k in np.argwhere(looked_at).tolist():
                self._try(self._every_second[k], names[row], self._rates[k], drawn[row, k], now)
        if self._kinds.keys() & {"forced_entry", "failure_to_yield", "red_light"}:
            for name in names:
                self._manoeuvres(name, now)
        if "step_out" in self._kinds and sumo.person.getIDCount():
            rate = self._kinds["step_out"].rate
            for person in sumo.person.getIDList():
                if sumo.person.getWaitingTime(person) > 0.0:
                    who = PERSON + person
                    self._try("step_out", who, rate, self._draw("step_out", who, f"{second}"), now)

    def _try(self, kind: str, who: str, rate: float, drawn: float, now: float) -> None:
        """One trial. Whether the error can begin is looked at only where that decides."""
        weighed = self._is_weighed(who)
        if not (drawn < rate or weighed) or who in self._erring:
            return
        trial: Trial = getattr(self, f"_{kind}")(who, now)
        whom = next(trial, None)
        if whom is None or not drawn < (self._weighed(who, kind, rate, drawn, whom) if weighed else rate):
            return
        try:
            next(trial)
        except StopIteration as end:
            self._erring[who] = end.value
            self._happened.append(end.value.error)

    def _weighed(self, who: str, kind: str, p: float, drawn: float, whom: str) -> float:
        """The probability that holds for a trial near an AV; `log_ratio` and `weighed` take it in."""
        assert self._tilt is not None
        if not self._is_weighed(who):
            return p
        meets_av, second = whom in self._avs or kind in MEET_ANYBODY, self._begun > 0
        q = self._tilt.rate(kind, p, meets_av, second)
        held = q if self._tilted else p
        begins = bool(drawn < held)
        self.log_ratio += log_ratio(p, q, begins)
        counted = self.weighed.setdefault(case(kind, meets_av, second), [0, 0.0])
        counted[0] += begins
        counted[1] += float(p)
        self._begun += begins and q > p
        return held

    def _is_weighed(self, who: str) -> bool:
        """Near an AV the first error is tilted, and a second one near whoever errs then; no further ones."""
        return who in (self._near, self._during, ())[min(self._begun, 2)]

    def _beside_avs(self, names: Sequence[str], now: float) -> tuple[frozenset[str], frozenset[str]]:
        """Who drives within `NEAR` of an AV, so that its errors may be tilted; and of those who does so of
        somebody else who is erring, or was until `REMEMBERED` s ago."""
        if not (self._avs and names):
            return frozenset(), frozenset()
        recent = {who for who, end in self._ended.items() if now - end <= REMEMBERED}
        erring = [name for name in names if name in self._erring or name in recent]
        places = {name: sumo.vehicle.getPosition(name) for name in (*names, *self._avs)}

        def close(to: Sequence[str]) -> Bools:
            """[n,t]"""
            here, there = (np.array([places[k] for k in group]).reshape(-1, 2) for group in (names, to))
            return np.asarray(np.abs(here[:, None] - there).max(2) < NEAR)

        def those(mask: Bools) -> frozenset[str]:
            return frozenset(name for name, is_so in zip(names, mask.tolist(), strict=True) if is_so)

        near = np.asarray(close([*self._avs]).any(1))
        others = np.array(names)[:, None] != np.array(erring, str)
        return those(near), those(near & (close(erring) & others).any(1))

    def _draw(self, kind: str, who: str, *which: str) -> float:
        """In [0, 1)."""
        return uniform(self._seed, "error", kind, who, *which)

    def _drawn(self, span: Span, kind: str, who: str, now: float, what: str) -> float:
        """A magnitude of an error that begins now."""
        low, high = span
        return low + (high - low) * self._draw(kind, who, f"{round(now)}", what)

    def _manoeuvres(self, name: str, now: float) -> None:
        """Where it must give way, is at a signal, or its lane does not go on."""
        lane = self._lane_of(name)
        if not lane or lane[0] == ":":
            self._waited.pop(name, None)
            return
        number = self._road.index.get(lane, -1)
        if number < 0:
            return
        to_line = self._road.lanes[number].length - self._position_of(name)
        edge = self._road.lanes[number].edge
        gives_way = lane in self._gives_way
        looks = gives_way and to_line < APPROACHES and "failure_to_yield" in self._kinds
        if looks and self._yields(name):
            self._once("failure_to_yield", name, edge, now)
        if lane in self._signals and to_line < SEES_SIGNAL and "red_light" in self._kinds:
            self._at_signal(name, edge, now)
        if "forced_entry" in self._kinds:
            waits = gives_way and to_line < AT_LINE and self._speed_of(name) < SLOW and self._yields(name)
            self._waits(name, waits or self._at_end_of_lane(name, lane), now)

    def _once(self, kind: str, name: str, manoeuvre: str, now: float) -> None:
        """The one trial of a manoeuvre."""
        trial = kind, name, manoeuvre
        if trial not in self._tried:
            self._tried.add(trial)
            self._try(kind, name, self._kinds[kind].rate, self._draw(kind, name, manoeuvre), now)

    def _waits(self, name: str, waits: bool, now: float) -> None:
        """A forced entry becomes the likelier the longer it has waited."""
        if not waits:
            self._waited.pop(name, None)
            return
        waited = self._waited[name] = self._waited.get(name, 0) + 1
        rate = hazard(self._kinds["forced_entry"], waited)
        self._try("forced_entry", name, rate, self._draw("forced_entry", name, f"{round(now)}"), now)

    def _at_signal(self, name: str, edge: str, now: float) -> None:
        ahead = sumo.vehicle.getNextTLS(name)
        if not ahead or ahead[0][3] not in "yY":
            return
        light, _, away, _ = ahead[0]
        red = sumo.trafficlight.getNextSwitch(light)
        arrives = now + away / max(self._speed_of(name), 0.1)
        if red < arrives <= red + self._kinds["red_light"].late:
            self._once("red_light", name, f"{edge}/{red:.1f}", now)

    def _at_end_of_lane(self, name: str, lane: str) -> bool:
        zone = self._kinds["forced_entry"].zone
        return self._needed_change(name, lane)[0] != 0 and self._left(name, lane) < zone

    def _needed_change(self, name: str, lane: str) -> tuple[int, float]:
        """To which side its route wants it to change (0: it need not), and m that its lane serves it."""
        key = sumo.vehicle.getRouteID(name), lane
        found = self._wants.get(key)
        if found is None:
            here = next((k for k in sumo.vehicle.getBestLanes(name) if k[0] == lane), None)
            offset, length = (0, math.inf) if here is None else (here[3], here[1])
            found = self._wants[key] = (offset > 0) - (offset < 0), length
        return found

    def _left(self, name: str, lane: str) -> float:
        """m until its lane serves its route no more."""
        return self._needed_change(name, lane)[1] - float(self._position_of(name))

    # ---- the kinds: each yields whom it would meet where it can begin, and begins when it is resumed

    def _inattention(self, who: str, now: float) -> Trial:
        leader = sumo.vehicle.getLeader(who, WITHIN)
        speed = self._speed_of(who)
        if not leader or not leader[0] or speed < MOVES:
            return None
        yield leader[0]
        length = self._drawn(self._kinds["inattention"].duration, "inattention", who, now, "duration")
        erring = self._begins("inattention", who, now, length, f"sees nobody for {length:.1f} s", leader[0])
        self._take(who, erring, BLIND, BLIND)
        erring.deceleration = 0.0
        self._slow(who, 0.0)
        return erring

    def _hard_braking(self, who: str, now: float) -> Trial:
        kind = self._kinds["hard_braking"]
        if self._speed_of(who) < MOVES:
            return None
        follower = _follower(who)
        yield follower
        hard = self._drawn(kind.deceleration, "hard_braking", who, now, "deceleration")
        length = self._drawn(kind.duration, "hard_braking", who, now, "duration")
        what = f"brakes with {hard:.1f} m/s2 for {length:.1f} s for no reason"
        erring = self._begins("hard_braking", who, now, length, what, follower)
        return self._slows(who, erring, hard)

    def _stalled_car(self, who: str, now: float) -> Trial:
        kind = self._kinds["stalled_car"]
        speed = self._speed_of(who)
        if speed < MOVES or self._lane_of(who).startswith(":"):
            return None
        follower = _follower(who)
        yield follower
        slows = self._drawn(kind.deceleration, "stalled_car", who, now, "deceleration")
        stands = self._drawn(kind.duration, "stalled_car", who, now, "duration")
        erring = self._begins("stalled_car", who, now, speed / slows + stands, "stops in its lane", follower)
        return self._slows(who, erring, slows)

    def _slows(self, who: str, erring: Erring, deceleration: float) -> Erring:
        """It still sees its leader and the signals, and may brake harder for them."""
        self._take(who, erring, sumo.vehicle.getSpeedMode(who) & ~(MAX_ACCEL | MAX_DECEL), BLIND)
        erring.deceleration = deceleration
        self._slow(who, deceleration)
        return erring

    def _slow(self, who: str, deceleration: float) -> None:
        """One step slower; 0 holds the speed."""
        sumo.vehicle.setSpeed(who, max(self._speed_of(who) - deceleration * self._step, 0.0))

    def _cut_in(self, who: str, now: float, kind: str = "cut_in") -> Trial:
        low, high = self._kinds[kind].deceleration
        lane = self._lane_of(who)
        if self._speed_of(who) < MOVES or self._changing(who) or not lane or lane[0] == ":":
            return None
        found = []
        for side in (LEFT, RIGHT):
            beside = self._beside(who, lane, side)
            if beside is not None and low <= beside.asked <= high and route_allows(who, side):
                found.append((beside, side))
        if not found:
            return None
        (asked, _, whom), side = min(found)
        yield whom
        again = kind == "aborted_cut_in"
        length = (2 if again else 1) * LANE_CHANGE_TIME + self._step
        what = f"cuts in before {whom}, who must brake with {asked:.1f} m/s2" + ", and swerves back" * again
        erring = self._begins(kind, who, now, length, what, whom)
        self._take(who, erring, None, BLIND)
        if again:
            erring.swerves = now + LANE_CHANGE_TIME, -side
        sumo.vehicle.changeLaneRelative(who, side, LANE_CHANGE_TIME)
        return erring

    def _aborted_cut_in(self, who: str, now: float) -> Trial:
        return self._cut_in(who, now, "aborted_cut_in")

    def _forced_entry(self, who: str, now: float) -> Trial:
        refuses = self._kinds["forced_entry"].lag
        lane, waited = self._lane_of(who), self._waited[who]
        if self._at_end_of_lane(who, lane):
            side, _ = self._needed_change(who, lane)
            beside = None if self._changing(who) else self._beside(who, lane, side)
            if beside is None or beside.lag < refuses:
                return None
            yield beside.whom
            erring = self._begins("forced_entry", who, now, HOLDS, _forces(waited, beside), beside.whom)
            self._take(who, erring, None, BLIND)
            sumo.vehicle.changeLaneRelative(who, side, HOLDS)
            return erring
        met = self._foes(who)
        if not met or any(foe.lag < refuses for foe in met):
            return None
        yield met[0].whom
        return self._drives_on("forced_entry", who, now, RIGHT_OF_WAY, _forces(waited, met[0]), met[0].whom)

    def _failure_to_yield(self, who: str, now: float) -> Trial:
        met = self._foes(who)
        whom = met[0].whom if met else ""
        yield whom
        what = f"does not see {whom}, who has the right of way" if whom else "does not look who comes"
        return self._drives_on("failure_to_yield", who, now, RIGHT_OF_WAY, what, whom)

    def _red_light(self, who: str, now: float) -> Trial:
        yield ""
        return self._drives_on("red_light", who, now, RIGHT_OF_WAY | RED_LIGHT, "does not stop for red", "")

    def _step_out(self, who: str, now: float) -> Trial:
        yield ""
        person = who.removeprefix(PERSON)
        length = self._drawn(self._kinds["step_out"].duration, "step_out", who, now, "duration")
        erring = self._begins("step_out", who, now, length, "walks onto the crossing without waiting", "")
        sumo.person.setMinGap(person, sumo.person.getMinGap(person))  # a type of its own
        erring.heeds = _crosses_by(person, {name: on for name, (on, _) in IGNORE.items()})
        return erring

    def _begins(self, kind: str, who: str, now: float, length: float, what: str, near: str) -> Erring:
        return Erring(HumanError(now, who, kind, now + length, what, near))

    def _drives_on(self, kind: str, who: str, now: float, ignored: int, what: str, near: str) -> Erring:
        """Until it is through the junction ahead."""
        erring = self._begins(kind, who, now, PASSES, what, near)
        mode = sumo.vehicle.getSpeedMode(who) & ~ignored | IGNORES_JUNCTION
        self._take(who, erring, mode, BLIND)
        erring.leaves = sumo.vehicle.getRoadID(who)
        return erring

    def _take(self, who: str, erring: Erring, speed_mode: int | None, lane_mode: int) -> None:
        """Take the vehicle from its driver model as far as the error asks for it (None: not its speed)."""
        vehicle = sumo.vehicle
        erring.modes = vehicle.getSpeedMode(who), vehicle.getLaneChangeMode(who)
        if speed_mode is not None:
            vehicle.setSpeedMode(who, speed_mode)
        vehicle.setLaneChangeMode(who, lane_mode)
        self._drivers.pause(who)

    # ---- errors under way

    def _go_on(self, name: str, now: float) -> None:
        erring = self._erring[name]
        over = now >= erring.error.until - 1e-6
        if erring.leaves and not over:
            edge = sumo.vehicle.getRoadID(name)
            over = bool(edge) and edge != erring.leaves and edge[0] != ":"
        if over:
            self._end(name)
            return
        if erring.deceleration:
            self._slow(name, erring.deceleration)
        if erring.swerves is not None and now >= erring.swerves[0] - 1e-6:
            sumo.vehicle.changeLaneRelative(name, erring.swerves[1], LANE_CHANGE_TIME)
            erring.swerves = None

    def _end(self, name: str) -> None:
        """Give back what was taken."""
        erring = self._erring.pop(name)
        self._ended[name] = sumo.simulation.getTime()
        if erring.heeds is not None:
            person = name.removeprefix(PERSON)
            if person in sumo.person.getIDList():
                _crosses_by(person, erring.heeds)
            return
        if erring.deceleration is not None:
            sumo.vehicle.setSpeed(name, -1.0)
        sumo.vehicle.setSpeedMode(name, erring.modes[0])
        sumo.vehicle.setLaneChangeMode(name, erring.modes[1])
        self._drivers.resume(name)

    def _had_a_part(self, collision: Collision) -> bool:
        now = collision.time
        pair = [collision.collider, collision.victim]
        ahead = [found[0] for name in pair if (found := _leader(name)) is not None]
        return any(
            who in self._erring or now - self._ended.get(who, -math.inf) <= REMEMBERED
            for who in (*pair, *ahead)
        )

    # ---- what is around

    def _changing(self, who: str) -> bool:
        return bool(sumo.vehicle.getLateralSpeed(who) != 0.0)

    def _beside(self, who: str, lane: str, side: int) -> Gap | None:
        """The gap in the lane to that side, as the follower there leaves it; None where there is no such
        lane, or somebody in it beside, or just ahead and much slower."""
        edge, _, index = lane.rpartition("_")
        there = int(index) + side
        if not 0 <= there < sumo.edge.getLaneNumber(edge):
            return None
        if not may_change(lane, side, sumo.vehicle.getVehicleClass(who)):
            return None
        bits = 0 if side == LEFT else 1  # of getNeighbors: bit 0 right, bit 1 ahead
        behind, ahead = (
            min(sumo.vehicle.getNeighbors(who, bits | way), key=lambda v: v[1], default=None)
            for way in (0, 2)
        )
        speed = self._speed_of(who)
        if ahead is not None:
            gap = ahead[1] + sumo.vehicle.getMinGap(who)
            if gap < LEAST_GAP or _asked(speed - self._speed_of(ahead[0]), gap) > HARDEST:
                return None
        if behind is None:
            return NOBODY
        gap, comes = behind[1] + sumo.vehicle.getMinGap(behind[0]), self._speed_of(behind[0])
        if gap < LEAST_GAP:
            return None
        slows = max(-sumo.vehicle.getAcceleration(who), 0.0)  # and will go on to, behind its leader
        return Gap(_asked(comes - speed, gap) + slows, _time(gap, comes), behind[0])

    def _yields(self, name: str) -> bool:
        """Whether it must give way at the next line, and the signal there lets it go."""
        links = sumo.vehicle.getNextLinks(name)
        return bool(links) and links[0][5] in "mswZ=go"

    def _foes(self, who: str) -> list[Gap]:
        """Who has the right of way at the next line, and is not gone when `who` is there, driving on; `lag`
        is counted from then. Who must brake hardest comes first."""
        vehicle, found = sumo.vehicle, []
        links = vehicle.getNextLinks(who)
        speed, gains = self._speed_of(who), vehicle.getAccel(who)
        for foe, away, to, _, beyond, via, _, goes_first, _ in vehicle.getJunctionFoes(who, WITHIN):
            if not goes_first or via != links[0][4]:
                continue
            arrives = (math.sqrt(speed**2 + 2.0 * gains * max(away, 0.0)) - speed) / gains  # s
            comes = self._speed_of(foe)
            if _time(beyond + vehicle.getLength(foe), comes) > arrives:
                asked = _asked(comes, to) if to > 0.0 else math.inf
                found.append(Gap(asked, _time(to, comes) - arrives, foe))
        return sorted(found, reverse=True)


def hazard(kind: ForcedEntry, waited: int) -> float:
    """The probability that a driver who has waited so many s forces its way in in the next one."""
    return min(kind.rate * max(waited - kind.patience, 0.0), 1.0)


def _asked(closing: float, gap: float) -> float:
    """The deceleration (m/s2) with which a speed difference (m/s) is gone when a gap (m) is used up."""
    return max(closing, 0.0) ** 2 / (2.0 * gap)


def _time(distance: float, speed: float) -> float:
    """s in which somebody is there."""
    return distance / max(speed, 0.1)


def _forces(waited: int, gap: Gap) -> str:
    whom = f"{gap.whom} must brake with {gap.asked:.1f} m/s2" if gap.whom else "nobody comes"
    return f"forces its way in after {waited} s; {whom}"


def _follower(who: str) -> str:
    found = sumo.vehicle.getFollower(who, WITHIN)
    return found[0] if found else ""


def _leader(name: str) -> tuple[str, float] | None:
    try:
        found = sumo.vehicle.getLeader(name, WITHIN)
    except sumo.TraCIException:  # a person, or it has left the road
        return None
    return found if found and found[0] else None


def _crosses_by(person: str, values: Mapping[str, str]) -> dict[str, str]:
    """Set what a person heeds at crossings, parameters of its own type; returns them as they were."""
    kind, before = sumo.person.getTypeID(person), {}
    for name, value in values.items():
        full = f"junctionModel.{name}"
        before[name] = sumo.vehicletype.getParameter(kind, full) or IGNORE[name][1]
        sumo.vehicletype.setParameter(kind, full, value)
    return before
