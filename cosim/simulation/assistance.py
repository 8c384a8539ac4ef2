"""The driver assistance of preset `lawful`: SUMO's own driver keeps the law, the agent wishes within it.

In every step the car drives the slower of two speeds: what the agent wishes, comfortably, and what SUMO's
driver (speed mode 31) allows for signals, right of way, limits, persons and whoever drives ahead. Where that
is slower, SUMO drives by itself, so that it brakes as hard as it must. Between AVs gaps are asked for and
given (V2V), because SUMO's cooperation ends where a speed is commanded. Who has waited long at a line judges
its gap itself (`gaps.py`).

A human close behind may not be looking: the car then keeps a longer headway, and as soon as the one behind
closes in without braking it uses that room up, later and harder on its own brakes, until he brakes. AVs
ahead of it are told (V2V), and make room before the end of their queue has used its own up.
"""

import math
from collections.abc import Set
from dataclasses import dataclass
from functools import partial

from cosim.control import COMFORT, COMFORT_TIME, MAX_DECEL, wished_accel
from cosim.road import RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.commands import SPEED_MODE, Commander, Controlled
from cosim.simulation.derived_types import LATE_TYPE, LAWFUL_TYPE, derive, is_known, own_type, suffix
from cosim.simulation.eyes import Eyes
from cosim.simulation.fleet import set_type
from cosim.simulation.gaps import Gaps
from cosim.simulation.inside import FREE, SWERVES, Ahead, Inside
from cosim.simulation.waves import NOBODY, Waves
from cosim.types import Intervention, Preset, Snapshot

CORRECTED = 1.0  # m/s2 more braking than asked for: from there on the car drives otherwise than commanded
STALLED = 0.2, 1.5  # m/s2, or so little acceleration where so much was asked for
RESPITE = 2.0  # s without a correction: the next one is a new one
HARD = 3.5  # m/s2: harder braking is an emergency's
STARTS = 0.1  # m/s: who is slower inside a junction stands, and looks whether somebody is in its way
STOPS_FOR = 2.5, 1.0  # m/s2, and m that are left, before who stands inside
LOOKS_IN = 25.0  # m before a line: from there on it looks who stands behind it
ENTERS = 1.0  # s before a line: so near to it no lane change is begun
KEEPS_MOVING = 3.0  # m/s: no slower wish is followed inside a junction, nor for longer than `PATIENCE`
CROSSES = 5.0  # s behind a junction in which it had to give way: inside and so long it takes its gap swiftly
NOTICE = 150.0  # m: signals and stop lines further ahead are no reason yet
SERVES = 60.0, 100.0  # m that a lane must serve the route at least, and more for every lane to change back
LOOKS = 0.4  # s between looks at right of way and blocked lane changes
GAP = 2.0, 1.0  # m and s: the gap given to who changes lanes
STOOD = 1.0  # m more of it for who has stood for `PATIENCE` and cannot change lanes
STOPS_SHORT = 0.5  # m before its line
YIELDING = 2.0, 1.0  # m/s2 and m/s: how hard, and down to what, an AV slows for who asked
PATIENCE = 10.0  # s
DECIDES = 30.0  # m before a line at which it gives way: from there on it looks who comes
COMES = 100.0  # m from which they come, however many edges that are
AT_LINE = 5.0  # m: who is further away stands in a queue
WAITS = 15.0  # s of waiting at a line; from then on it judges and takes its gap, whatever the agent asks for
GOES_FIRST = SPEED_MODE[Preset.LAWFUL] - 8  # heeds nobody outside the junction
GOES_ON = 32  # with it, of those inside nobody either: `Inside` looks who is in its way
BRAKES_WITHIN = 4  # bit of a speed mode: a commanded speed asks for no more than the driver's `decel`
HOLDS = 10.0, 2.6  # m before a line, m/s2: from there on it goes before no AV that would brake harder
LETS = 1.0  # s for which an AV that is asked lets another one in
# where AVs alone come, and where humans do: SUMO adds a share of 180 s stood, which makes humans brake hard
IMPATIENCE = 0.8, -1.0
CLOSE = 60.0  # m behind
HEADWAY = 0.8, 1.8  # s to the leader; with a human that close behind
STANDS = 2.0, 5.0  # m to a standing leader; with the longer headway
CLOSES = 3.0, 0.5  # s to contact, and the share of the braking that would avoid it of who heeds
ASKED = 2.0, 0.5  # m/s2 that would avoid it: from there on the car makes room; goes on doing so
ROOM = (1.5, 0.2), (3.0, 0.5)  # s to contact, s to the leader that it makes do with; between them linear
FLEES = 1.0  # s that this lasts at least
TOLD = 8.0, 30.0  # s to contact of the AVs ahead that are told, m between one vehicle and the next up to them
STOPS = 0.3  # s to the leader at walking pace and below
RETURNS = 0.1, 0.2  # s of headway won back per s, below and above `HEADWAY`

STRATEGIC, BLOCKED = 8, 512 + 1024 + 2048 + 4096 + 8192  # bits of SUMO's lane-change state


@dataclass(slots=True)
class Assisted(Controlled):
    """The state of one commanded AV."""

    wish: float = math.inf  # m/s, at the end of the step that is driven
    accel: float = 0.0  # m/s2, the wish's
    speed: float = 0.0  # m/s, before the last step
    raw: float = 0.0  # m/s2, what the target alone asks for
    ours: bool = False  # whether the last step was driven by the wish
    lateral: float = 0.0  # m, on its lane
    corrected: float = -math.inf  # s, when the car last drove otherwise
    gap_for: str = ""  # who asked for a gap
    stopped: float = 0.0  # s, for which it has stood while somebody asked for one
    gives_way: bool = False  # at the next junction, or in this one
    waited: float = 0.0  # s, to give way
    impatience: float = 0.0
    crosses: float = 0.0  # s left of `CROSSES`
    headway: float = HEADWAY[0]  # s
    tau: float = HEADWAY[0]  # s, its driver's, shorter at low speed
    stands: float = STANDS[0]  # m, its driver's
    late: bool = False  # whether it brakes late
    flees: float = -math.inf  # s, until when it makes room for who does not brake behind it
    idled: float = 0.0  # s, for which the agent has asked for less than `KEEPS_MOVING`
    stays: bool = False  # inside a junction, for somebody in its way
    held: float = 0.0  # s, for which it has done so in this one
    goes: str = ""  # the lane from which it takes its gap
    lets: float = -math.inf  # s, until when it stops before its line for who takes one
    has_let: float = 0.0  # s, for which it has done so at this one
    side: float = 0.0  # m to the left of its lane's centre, where it drives
    led: bool = False  # whether the leader that it sees limited the last step
    mode: int = SPEED_MODE[Preset.LAWFUL]  # SUMO's, but for `brakes_hard`
    brakes_hard: bool = False  # for that leader, harder than its driver's comfort
    holds: bool = False  # for an AV that would have to brake hard

    @property
    def asked(self) -> float:
        """As of every commanded AV."""
        return self.wish if self.ours else math.inf


class Assistance(Commander):
    """Drives every commanded AV of preset `lawful`."""

    controlled: dict[str, Assisted]  # type: ignore[assignment]  # `_take_over` makes all of them

    def __init__(self, step: float, road: RoadMap) -> None:
        super().__init__(Preset.LAWFUL, step)
        self._eyes = Eyes(road)
        self._junctions = Inside(road, self._eyes)
        self._gaps = Gaps(road, self._junctions, self._eyes)
        self._waves = Waves()
        self._looked = -math.inf  # s
        self._begun: list[Intervention] = []
        self._standing_gaps: dict[str, float] = {}  # human -> m
        self._ways: dict[str, tuple[frozenset[str], frozenset[str]]] = {}  # edge -> `_ways_beside`
        # AV -> s until somebody further behind, who does not brake, would be there
        self._told: dict[str, float] = {}
        self._heard = self._told  # in the step before

    def drive(self) -> None:
        """Before every simulation step: the agent's wish where it is the slower one, else SUMO's driver."""
        get = sumo.vehicle
        now = sumo.simulation.getTime()
        self._heard, self._told = self._told, {}
        for name, state in self.controlled.items():
            speed = get.getSpeed(name)
            self._mind_follower(name, speed, state, now)
            flees = now < state.flees
            # what SUMO's driver did in the last step, or would have done
            allowed = get.getSpeedWithoutTraCI(name) if state.ours or state.led else speed
            slower = allowed < state.wish - 1e-3
            if not state.ours or state.led:
                state.accel = (speed - state.speed) / self._step
            target = min(state.goal(speed, COMFORT_TIME), state.limit)
            state.idled = state.idled + self._step if state.target < KEEPS_MOVING else 0.0
            lane = get.getLaneID(name)
            inside = lane.startswith(":")
            swift = inside and state.gives_way  # as SUMO's driver, whose acceleration its gap was judged by
            state.crosses = CROSSES if swift else state.crosses - self._step
            if flees:
                target = math.inf
            elif state.crosses > 0.0 or state.waited > WAITS:
                target = state.limit
            elif inside or state.idled > PATIENCE:
                target = max(target, min(KEEPS_MOVING, state.limit))
            target = min(target, get.getAllowedSpeed(name))
            state.raw, state.accel = wished_accel(speed, target, state.accel, self._step)
            if speed >= KEEPS_MOVING:
                state.stopped = 0.0
            if state.gap_for and not flees:
                state.accel = min(state.accel, self._yielding(name, speed, state))
                state.stopped += self._step * (speed < STARTS)
            if inside:
                state.has_let = 0.0
            elif lane and (now < state.lets or state.holds):
                left = sumo.lane.getLength(lane) - get.getLanePosition(name) - STOPS_SHORT
                stops = -speed * speed / (2.0 * max(left, 0.1))
                state.accel = min(state.accel, max(stops, -COMFORT))
                state.has_let += self._step * (now < state.lets)
            self._mind_inside(name, lane, speed, state)
            state.wish, state.speed = max(speed + state.accel * self._step, 0.0), speed
            ours = not (slower or flees or swift) or (state.stays and not (slower and speed >= STARTS))
            behind = self._follow(name, speed)
            led = behind < min(state.wish if ours else math.inf, allowed)
            self._allow_hard_braking(name, led and behind < speed - get.getDecel(name) * self._step, state)
            if led:
                get.setSpeed(name, behind)
            elif ours:
                get.setSpeed(name, state.wish)
            elif state.ours or state.led:
                get.setSpeed(name, -1.0)
            state.ours, state.led = ours, led

    def see(self, snapshot: Snapshot) -> None:
        """A new frame, with what every AV knows of it."""
        self._eyes.open(snapshot)
        if not self._eyes.ideal:
            for name in self.controlled:
                self._blind(name)

    def observe(self, now: float) -> list[Intervention]:
        """After every simulation step, at `now` (s): where the car began to drive otherwise than asked."""
        get, begun = sumo.vehicle, self._begun
        self._begun = []
        for name, state in self.controlled.items():
            speed = get.getSpeed(name)
            accel = (speed - state.speed) / self._step
            if accel < min(state.raw, 0.0) - CORRECTED or (state.raw > STALLED[1] and accel < STALLED[0]):
                if now - state.corrected > RESPITE:
                    begun.append(Intervention(now, name, _reason(name, accel, state, now)))
                state.corrected = now
            lateral = get.getLateralLanePosition(name)
            drift, state.lateral = lateral - state.lateral, lateral
            if 0.05 < abs(drift) < 1.0 and not state.changing(now):  # SUMO changes lanes for the route
                self._changes(name, state, 1 if drift > 0.0 else -1, now)
        if now - self._looked > LOOKS - 1e-6:
            self._looked = now
            self._look()
        return begun

    def heads_for(self, name: str) -> float | None:
        """SUMO's driver heads for the limit."""
        return float(sumo.vehicle.getAllowedSpeed(name))

    # ---- inside ----

    def _take_over(self, name: str) -> Assisted:
        get = sumo.vehicle
        _drive_as(name, LAWFUL_TYPE)
        self._blind(name)
        get.setSpeedFactor(name, min(get.getSpeedFactor(name), 1.0))
        return Assisted(0.0, speed=get.getSpeed(name), lateral=get.getLateralLanePosition(name))

    def _hand_back(self, name: str) -> None:
        """It keeps its comfortable driver."""
        self._waves.set(name, NOBODY)
        self._waves.blind(name, (), ())
        _drive_as(name, LAWFUL_TYPE)

    def drop(self, name: str) -> None:
        """Also of one that crashed."""
        super().drop(name)
        self._waves.set(name, NOBODY)
        self._waves.forget(name)

    def _forbidden(self, name: str, lane: str, offset: int) -> str | None:
        why = super()._forbidden(name, lane, offset)
        if why is None:
            why = _at_junction(name, lane)
        if why is None:
            why = _leaves_route(name, lane, offset)
            if why is not None:
                self._begun.append(Intervention(sumo.simulation.getTime(), name, why))
        return why

    def _blind(self, name: str) -> None:
        """SUMO's driver heeds no vehicle at junctions that the AV does not know of, and no leader at all:
        `_follow` does, as far as the AV knows of one."""
        everybody, unseen = self._eyes.unseen(name)
        self._waves.blind(name, unseen, everybody)

    def _follow(self, name: str, speed: float) -> float:
        """The speed in m/s for the end of the step that the driver model has behind the leader as the AV
        sees it; inf without one, and where SUMO's driver sees to it."""
        get = sumo.vehicle
        leader, gap = (not self._eyes.ideal and get.getLeader(name, NOTICE)) or ("", 0.0)
        if not leader or not self._eyes.known(name, [leader]):
            return math.inf
        seen = self._eyes.of(name)
        gap -= seen.behind_by(leader, math.radians(90.0 - get.getAngle(name)))
        wanted = get.getFollowSpeed(name, speed, gap, seen.getSpeed(leader), get.getDecel(leader), leader)
        return float(max(wanted, speed - MAX_DECEL * self._step, 0.0))

    def _allow_hard_braking(self, name: str, hard: bool, state: Assisted) -> None:
        """Let SUMO carry out a commanded speed that asks for more than its driver's own deceleration, or no
        longer."""
        if hard != state.brakes_hard:
            state.brakes_hard = hard
            sumo.vehicle.setSpeedMode(name, state.mode - BRAKES_WITHIN * hard)

    def _is_human(self, name: str, other: str) -> bool:
        """Whether the AV `name` takes `other` for no AV."""
        return not self._eyes.is_av(name, other, self.controlled)

    def _mind_follower(self, name: str, speed: float, state: Assisted, now: float) -> None:
        """Keep a headway by who follows; use it up while he closes in and does not brake."""
        get = sumo.vehicle
        follower, gap = get.getFollower(name, CLOSE)
        human = bool(follower) and self._is_human(name, follower)
        if human and not self._eyes.known(name, [follower]):
            follower, gap, human = "", 0.0, False
        if human:
            gap += self._standing_gap(follower)
            if not self._eyes.ideal:
                gap += self._eyes.of(name).behind_by(follower, math.radians(90.0 - get.getAngle(name)))
        least = ASKED[now < state.flees]
        contact = self._contact(name, speed, follower, max(gap, 0.1), least) if human else math.inf
        if contact < math.inf:
            self._tell(name, follower, gap)
        contact = min(contact, self._heard.get(name, math.inf))
        if contact < math.inf:
            if now >= state.flees:
                self._begun.append(Intervention(now, name, "emergency: vehicle behind"))
            state.flees = now + FLEES
            (soon, shortest), (later, most) = ROOM
            left = min(max((contact - soon) / (later - soon), 0.0), 1.0)
            headway = min(shortest + left * (most - shortest), state.headway)
        elif now < state.flees:
            return
        else:
            short = state.headway < HEADWAY[0]
            own = HEADWAY[human and gap < CLOSE]
            headway = min(state.headway + RETURNS[not short] * self._step, own)
        state.headway, late = headway, headway < HEADWAY[0]
        # an IDM nears a line with speed = distance / headway: so it stops, and does not creep there
        tau = min(headway, max(STOPS, speed / COMFORT))
        stands = STANDS[headway > HEADWAY[0]]
        if late != state.late:
            state.late, state.stands = late, STANDS[0]
            _drive_as(name, LATE_TYPE if late else LAWFUL_TYPE, state.impatience)
        elif tau == state.tau and stands == state.stands:
            return
        state.tau = tau
        get.setTau(name, tau)
        if stands != state.stands and not late:
            state.stands = stands
            get.setMinGap(name, stands)

    def _contact(self, name: str, speed: float, follower: str, gap: float, least: float) -> float:
        """s until a follower `gap` m behind is here; inf where he brakes, or need not by `least` m/s2."""
        get = self._eyes.of(name)
        closing = get.getSpeed(follower) - speed
        if closing <= 0.0 or gap >= CLOSES[0] * closing:
            return math.inf
        asked = closing**2 / (2.0 * gap) + max(-get.getAcceleration(name), 0.0)
        heeds = -get.getAcceleration(follower) > CLOSES[1] * asked
        return math.inf if asked < least or heeds else gap / closing

    def _tell(self, name: str, follower: str, gap: float) -> None:
        """The AVs ahead hear of a follower `gap` m behind `name`, whoever drives between."""
        get, (soon, apart) = sumo.vehicle, TOLD
        fast, away = self._eyes.of(name).getSpeed(follower), gap  # m/s, m
        told_by = name
        while ahead := get.getLeader(name, apart):
            leader, free = ahead
            if not leader or free > apart:
                return
            # SUMO's gap to a leader is less by the follower's minGap
            away += get.getLength(name) + get.getMinGap(name) + free
            closing = fast - get.getSpeed(leader)
            if away > soon * closing:
                return
            if self._eyes.hears(leader, told_by):
                self._told[leader] = min(away / closing, self._told.get(leader, math.inf))
            name = leader

    def _standing_gap(self, name: str) -> float:
        """m, which SUMO takes off a follower's gap."""
        found = self._standing_gaps.get(name)
        if found is None:
            found = self._standing_gaps[name] = float(sumo.vehicle.getMinGap(name))
        return found

    def _look(self) -> None:
        """Who has to give way; and who must change lanes and cannot asks the AV behind to make room (V2V)."""
        get = sumo.vehicle
        for state in self.controlled.values():
            state.gap_for = ""
        for name, state in self.controlled.items():
            lane = get.getLaneID(name)
            if not lane:  # it is parked, or SUMO carries it elsewhere
                continue
            red, via = False, ""
            if not lane.startswith(":"):
                links = get.getNextLinks(name)
                state.gives_way = bool(links) and not links[0][1]
                red = bool(links) and links[0][5] in RED + YELLOW
                via = links[0][4] if links else ""
            self._wait(name, lane, state, red)
            self._take_gap(name, lane, via, state)
            state.holds = state.gives_way and not (red or state.goes) and self._holds(name, lane, via)
            for side in (1, -1):
                wanted = get.getLaneChangeState(name, side)[0]
                if wanted & STRATEGIC and wanted & BLOCKED:
                    # of two that block one another the one that asks first goes first
                    asked = [other for other, _ in get.getNeighbors(name, 0 if side > 0 else 1)]
                    if get.getWaitingTime(name) > PATIENCE:  # the nearest may always be too near
                        asked += [get.getFollower(other, CLOSE)[0] for other in asked]
                    self._give(asked, name)

    def _wait(self, name: str, lane: str, state: Assisted, red: bool) -> None:
        """Before humans it waits for a gap that nobody brakes for; AVs see it, and brake comfortably.

        Inside a junction too: there those wait who turn across others. At a red light nobody waits for a gap.
        """
        get = sumo.vehicle
        away = sumo.lane.getLength(lane) - get.getLanePosition(name)
        waits = state.gives_way and not red and away < AT_LINE and get.getSpeed(name) < KEEPS_MOVING
        state.waited = state.waited + LOOKS if waits else 0.0
        humans = state.gives_way and away <= DECIDES and self._meets_humans(name)
        impatience = IMPATIENCE[humans]
        if impatience != state.impatience:
            state.impatience = impatience
            # its type is its own since `set_type`
            sumo.vehicletype.setImpatience(get.getTypeID(name), impatience)

    def _take_gap(self, name: str, lane: str, via: str, state: Assisted) -> None:
        """Who has waited long at a line without a signal, or in the junction behind it, judges its gap
        itself; AVs let it in."""
        inside = lane.startswith(":")
        if state.goes and inside and lane != state.goes:  # until it has left the junction
            return
        goes = False
        if state.waited > WAITS:
            goes, asked = self._gaps.take(name, lane, via, partial(self._lets_in, name))
            for other in asked:
                self.controlled[other].lets = sumo.simulation.getTime() + LETS
        if goes != bool(state.goes):
            state.goes = lane if goes else ""
            mode = GOES_FIRST + inside * GOES_ON if goes else SPEED_MODE[Preset.LAWFUL]
            state.mode, state.brakes_hard = mode, False
            sumo.vehicle.setSpeedMode(name, mode)

    def _holds(self, name: str, lane: str, via: str) -> bool:
        """Whether one that gives way there waits for AVs that would have to brake hard for it (V2V)."""
        get, (near, hard) = sumo.vehicle, HOLDS
        away, speed = sumo.lane.getLength(lane) - get.getLanePosition(name), get.getSpeed(name)
        if away > near or speed * speed > 2.0 * COMFORT * max(away - STOPS_SHORT, 0.1):
            return False
        return self._gaps.brakes(name, lane, via, self._step, partial(self._comes, name)) > hard

    def _comes(self, asks: str, name: str) -> bool:
        """Whether it is an AV that lets nobody in, as far as the one that `asks` hears of it."""
        state = self.controlled.get(name)
        heard = self._eyes.hears(asks, name)
        return state is not None and heard and state.lets < sumo.simulation.getTime()

    def _lets_in(self, asks: str, name: str, before: float) -> bool | None:
        """Whether it is an AV that can stop comfortably so many m before its line, and has not for long; None
        for an AV that takes its own gap. It and the one that `asks` must hear one another."""
        state = self.controlled.get(name)
        if not (self._eyes.hears(asks, name) and self._eyes.hears(name, asks)):
            return False
        if state is not None and state.goes:
            return None
        if state is None or state.has_let >= PATIENCE or state.flees > sumo.simulation.getTime():
            return False
        needs = sumo.vehicle.getSpeed(name) ** 2 / (2.0 * YIELDING[0])  # m
        return bool(needs <= max(before - 2.0 * STOPS_SHORT, 0.0))

    def _meets_humans(self, name: str) -> bool:
        """Whether anybody but AVs comes to the junction that it is at, from elsewhere.

        `getJunctionFoes` leaves out some who have priority.
        """
        get = sumo.vehicle
        own = get.getRoute(name)[max(get.getRouteIndex(name), 0)]
        if own not in self._ways:
            self._ways[own] = _ways_beside(own)
        near, further = self._ways[own]
        for edges, comes in ((near, True), (further, False)):
            for edge in edges:
                for other in self._eyes.known(name, sumo.edge.getLastStepVehicleIDs(edge)):
                    if self._is_human(name, other) and (comes or near & set(_route_ahead(other))):
                        return True
        return False

    def _mind_inside(self, name: str, lane: str, speed: float, state: Assisted) -> None:
        """An AV passes vehicles that stand in its way inside a junction within its lane, or stops for them:
        before its line, as long as it can stop there, else before their way out of the junction. One that
        stands inside stays there while somebody is in its way, or for at most `PATIENCE` may soon be.

        So that nobody waits for ever, the AV that has stopped waves the vehicle in its way through.
        """
        inside, waved = lane.startswith(":"), self._waves.of(name)
        line = math.inf
        if inside and speed < STARTS:
            ahead = self._junctions.blocked(name, lane, state.held >= PATIENCE, waved)
            state.stays = state.holds or ahead.room < math.inf
        else:
            brakes, left = STOPS_FOR
            needs = speed * speed / (2.0 * brakes) + left  # m
            ahead, line = self._room(name, lane, inside, waved)
            state.stays = ahead.room < needs or (ahead.room < math.inf and needs - left < line < needs)
        waves = set()
        if state.stays:
            state.accel = -COMFORT
            state.held += self._step
            if speed < STARTS:
                waves = {one for one in ahead.standing if one in waved or self._junctions.can_pass(one, name)}
                waves |= {one for one in waved if self._junctions.inside(one)}
        elif not inside and speed >= KEEPS_MOVING:
            state.held = 0.0
        self._waves.set(name, waves, self._junctions.behind(name, lane) if waves else NOBODY)
        self._move_aside(name, speed, state, ahead.side)

    def _room(self, name: str, lane: str, inside: bool, waved: Set[str]) -> tuple[Ahead, float]:
        """Its way through the junction that it is in, or comes to; m to its line, or inf."""
        if inside:
            return self._junctions.room(name, lane, waved), math.inf
        away = sumo.lane.getLength(lane) - sumo.vehicle.getLanePosition(name) if lane else math.inf
        links = sumo.vehicle.getNextLinks(name) if away < LOOKS_IN else ()
        if not links or not links[0][4] or links[0][5] in RED + YELLOW:
            return FREE, away
        ahead = self._junctions.room(name, links[0][4], waved, 0.0, away)
        return ahead._replace(room=away + ahead.room), away

    def _move_aside(self, name: str, speed: float, state: Assisted, side: float) -> None:
        """Drive `side` m to the left of the lane's centre, reached by and by."""
        if side == state.side or state.changing(sumo.simulation.getTime()):
            return
        most = SWERVES * speed * self._step
        moved = min(max(side - state.side, -most), most)
        if moved:
            state.side += moved
            state.lateral += moved  # it is no change of lanes
            sumo.vehicle.setLateralLanePosition(name, state.side)

    def _give(self, asked: list[str], name: str) -> None:
        for other in asked:
            heard = other in self.controlled and self._eyes.hears(other, name)
            if heard and not self.controlled[name].gap_for:
                self.controlled[other].gap_for = name

    def _yielding(self, name: str, speed: float, state: Assisted) -> float:
        """The acceleration in m/s2 that opens a gap for who asked for one."""
        get, (brakes, least) = self._eyes.of(name), YIELDING
        if not self._eyes.known(name, [state.gap_for]):
            return COMFORT
        try:
            ahead = get.getLanePosition(state.gap_for) - get.getLength(state.gap_for)
            gap = ahead - get.getLanePosition(name)
            theirs = get.getSpeed(state.gap_for)
        except sumo.TraCIException:  # it has left
            return COMFORT
        room, headway = GAP
        near = max(speed**2 - theirs**2, 0.0) / (2.0 * brakes)  # m
        # the first that can stops for who has stood for long, but not for ever: other things may keep him
        if get.getWaitingTime(state.gap_for) > PATIENCE and state.stopped < PATIENCE:
            room, least = room + STOOD, 0.0
            near += room
        if gap < near:
            return COMFORT  # it is beside, or too near: it goes first, whoever follows it gives way
        slower = max(theirs + 0.5 * (gap - room - headway * speed), least)  # m/s
        return float(max(slower - speed, -brakes))


def _lawful(own: str, base: str) -> str:
    """The type of a commanded AV whose present one is this, driving as `base`; outputs name it."""
    av = own.removesuffix(suffix(LAWFUL_TYPE)).removesuffix(suffix(LATE_TYPE))
    name = f"{av}{suffix(base)}"
    if not is_known(name):
        derive(name, own, base)
    return name


def _drive_as(name: str, kind: str, impatience: float = 0.0) -> None:
    """Give an AV another driver; how impatient it is no type decides."""
    set_type(name, _lawful(own_type(name), kind))
    sumo.vehicletype.setImpatience(sumo.vehicle.getTypeID(name), impatience)


def _ways_beside(own: str) -> tuple[frozenset[str], frozenset[str]]:
    """The edges that lead to the junction at the end of `own`, its inner ones too, but for `own`; and those
    before them from which it is at most `COMES`."""
    junction = sumo.edge.getToJunction(own)
    near = frozenset(sumo.junction.getIncomingEdges(junction)) - {own}
    further: set[str] = set()
    waiting = [(edge, 0.0) for edge in near if not edge.startswith(":")]
    while waiting:
        edge, away = waiting.pop()
        away += float(sumo.lane.getLength(f"{edge}_0"))
        before = sumo.edge.getFromJunction(edge)
        if away >= COMES or before == junction:
            continue
        new = set(sumo.junction.getIncomingEdges(before)) - near - further - {own}
        further |= new
        waiting += [(edge, away) for edge in new if not edge.startswith(":")]
    return near, frozenset(further)


def _route_ahead(name: str) -> tuple[str, ...]:
    """The edges that a vehicle still comes to."""
    return tuple(sumo.vehicle.getRoute(name))[max(sumo.vehicle.getRouteIndex(name), 0) + 1 :]


def _at_junction(name: str, lane: str) -> str | None:
    """Why a vehicle on `lane` is too near to a junction to change lanes; None if it is not.

    SUMO draws whoever changes lanes along the lane, and so turns at once a rear that still stands in a
    junction: a bus into those beside it. And a change that is asked for before a line may begin behind it.
    """
    get = sumo.vehicle
    place = get.getLanePosition(name)
    if place < get.getLength(name):
        return "still leaving a junction"
    if sumo.lane.getLength(lane) - place < get.getSpeed(name) * ENTERS:
        return "about to enter a junction"
    return None


def _leaves_route(name: str, lane: str, offset: int) -> str | None:
    """Why the lane at `offset` does not serve the route long enough to change to it; None if it does."""
    best = sumo.vehicle.getBestLanes(name)
    here = int(lane.rpartition("_")[2])
    if not 0 <= here + offset < len(best):
        return None
    now, then = best[here], best[here + offset]
    at = sumo.vehicle.getLanePosition(name)
    least, more = SERVES
    away = abs(then[3])
    if away <= abs(now[3]) or then[1] - at > least + more * away:
        return None
    return "the lane leaves the route"


def _reason(name: str, accel: float, state: Assisted, now: float) -> str:
    """Why the car drives slower at `now` (s) than the agent wishes, or brakes harder (`accel` m/s2)."""
    get = sumo.vehicle
    words = "emergency: " if accel < -HARD else ""
    if state.holds or now < state.lets:
        return f"{words}lets an AV in"
    if state.stays:
        return f"{words}vehicle in the way"
    speed = get.getSpeed(name)
    reach = min(0.5 * speed * speed + 2.0 * speed + 10.0, NOTICE)  # m, from where an IDM begins to brake
    leader = get.getLeader(name, reach)
    gap = leader[1] if leader and leader[0] else math.inf
    for _, _, distance, light in get.getNextTLS(name)[:1]:
        if distance < min(reach, gap) and light in RED + YELLOW:
            return words + ("red light" if light in RED else "yellow light")
    if gap < reach:
        return f"{words}vehicle ahead"
    links = get.getNextLinks(name)
    for link in links[:1]:
        at = sumo.lane.getLength(get.getLaneID(name)) - get.getLanePosition(name)
        if at < reach and not link[1]:
            return words + ("stop sign" if link[5] in "sw" else "right of way")
        if at < reach and link[4] and sumo.lane.getMaxSpeed(link[4]) < speed + 1.0:
            return f"{words}speed limit"
    return f"{words}lane ends" if not links else f"{words}junction or speed limit"
