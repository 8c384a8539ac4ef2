"""Commands become SUMO's calls, each with a receipt that says whether it was carried out, and why not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cosim.control import LANE_CHANGE_TIME, MAX_DECEL, TIME_CONSTANT, tracked_speed
from cosim.simulation.backend import sumo
from cosim.simulation.convert import may_change
from cosim.simulation.fleet import AV_IDM
from cosim.types import Command, Intervention, Preset, Receipt, Snapshot

# SUMO's bit fields (https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html): 6 keeps only the physical
# acceleration limits, so the agent can crash; 31 and 512 let SUMO's own safety override the agent.
SPEED_MODE = {Preset.UNGUARDED: 6, Preset.GUARDED: 31, Preset.LAWFUL: 31}
# 513: SUMO's own changes for the route, if they do not contradict the agent's; the gaps of others respected
LANE_CHANGE_MODE = {Preset.UNGUARDED: 0, Preset.GUARDED: 512, Preset.LAWFUL: 513}
SUMO_SPEED_MODE, SUMO_LANE_CHANGE_MODE = 31, 1621  # SUMO's defaults
SETTLED = 1e-3  # m/s: closer to its target an AV needs no new command
OVERRULED = 0.05  # m/s: further from the commanded speed another program has set one


@dataclass(slots=True)
class Controlled:
    """The state of one commanded AV."""

    target: float  # m/s
    limit: float = math.inf  # m/s, of the law ahead
    change: int = 0  # the last lane change: +1 left, -1 right
    change_until: float = -1.0  # s, when it ends
    requested: float = -1.0  # m/s, the last speed handed to SUMO
    asks: float | None = None  # m/s2, in place of the target speed

    def goal(self, speed: float, time: float) -> float:
        """The speed in m/s to be tracked with the time constant `time` (s) at `speed` (m/s)."""
        return self.target if self.asks is None else speed + self.asks * time

    @property
    def asked(self) -> float:
        """The speed in m/s that the last step was to end with, at most; inf where SUMO drove it."""
        return self.requested

    def changing(self, now: float) -> int:
        """The lane change under way at time `now` (s): +1 left, -1 right, 0 none."""
        return self.change if now < self.change_until - 1e-9 else 0


class Commander:
    """Holds every commanded AV at its target speed, step by step, and starts lane changes."""

    shared = False  # whether other programs command vehicles too

    def __init__(self, preset: str, step: float) -> None:
        self._preset = preset
        self._step = step  # s
        self.controlled: dict[str, Controlled] = {}
        self.lane_changes: dict[str, float] = {}  # AV -> s, start of its last one (attribution of cut-ins)
        self._wrecks: set[str] = set()

    def take(self, command: Command, now: float) -> Receipt:
        """Start one command at time `now` (s). A vehicle is taken over from SUMO at its first command."""
        name = command.vehicle
        if name in self._wrecks:
            return Receipt(name, False, "crashed")
        try:
            lane = sumo.vehicle.getLaneID(name)
        except sumo.TraCIException:
            return Receipt(name, False, "not on the road")
        state = self.controlled.get(name)
        if state is None:
            state = self.controlled[name] = self._take_over(name)
            sumo.vehicle.setSpeedMode(name, SPEED_MODE[self._preset])
            sumo.vehicle.setLaneChangeMode(name, LANE_CHANGE_MODE[self._preset])
        state.target = min(command.target_speed, sumo.vehicle.getMaxSpeed(name))
        state.limit, state.asks = command.limit, command.accel
        if command.lane_offset == 0:
            return Receipt(name, True)
        why = (
            "a lane change is under way"
            if state.changing(now)
            else self._forbidden(name, lane, command.lane_offset)
        )
        if why is not None:
            return Receipt(name, False, why)
        sumo.vehicle.changeLaneRelative(name, command.lane_offset, command.hold)
        self._changes(name, state, command.lane_offset, now)
        return Receipt(name, True)

    def _hand_back(self, name: str) -> None:
        """Take back what `_take_over` gave."""
        sumo.vehicle.setDecel(name, AV_IDM["decel"])

    def _changes(self, name: str, state: Controlled, offset: int, now: float) -> None:
        state.change = offset
        state.change_until = now + LANE_CHANGE_TIME
        self.lane_changes[name] = now

    def heads_for(self, name: str) -> float | None:
        """The target speed in m/s of a vehicle that is not commanded yet; None: none is known."""
        return None

    def _take_over(self, name: str) -> Controlled:
        """Give the car what it needs to carry commands out."""
        sumo.vehicle.setDecel(name, MAX_DECEL)
        return Controlled(0.0)

    def _forbidden(self, name: str, lane: str, offset: int) -> str | None:
        """Why vehicle `name` on `lane` is not to change by `offset` lanes; None if it may."""
        return _forbidden(name, lane, offset)

    def release(self, commanded: Sequence[Command]) -> None:
        """AVs that got no command this time are handed back to SUMO's own driver."""
        names = {c.vehicle for c in commanded}
        for name in [n for n in self.controlled if n not in names]:
            del self.controlled[name]
            hand_back(name)
            self._hand_back(name)

    def confirm(self, receipts: Sequence[Receipt], commands: Sequence[Command]) -> tuple[Receipt, ...]:
        """After the hold: a lane change that did not begin was refused by SUMO's safety checks; a speed that
        is not the commanded one was set by another program."""
        confirmed = list(receipts)
        if self.shared:
            confirmed = [self._overruled(receipt) for receipt in receipts]
        for k, (receipt, command) in enumerate(zip(receipts, commands, strict=True)):
            if not command.lane_offset or not receipt.executed:
                continue
            name, state = command.vehicle, self.controlled.get(command.vehicle)
            if not state or name not in sumo.vehicle.getIDList():
                continue
            if abs(sumo.vehicle.getLateralLanePosition(name)) < 0.05:
                state.change, state.change_until = 0, -1.0
                self.lane_changes.pop(name, None)
                confirmed[k] = Receipt(name, False, f"refused by SUMO's lane-change safety ({self._preset})")
        return tuple(confirmed)

    def _overruled(self, receipt: Receipt) -> Receipt:
        name, state = receipt.vehicle, self.controlled.get(receipt.vehicle)
        if not receipt.executed or not state or name not in sumo.vehicle.getIDList():
            return receipt
        more = sumo.vehicle.getSpeed(name) - state.asked  # m/s
        if more > OVERRULED or (self._preset == Preset.UNGUARDED and more < -OVERRULED):
            return Receipt(name, False, "another program set its speed")
        return receipt

    def drive(self) -> None:
        """Before every simulation step: track the target speeds."""
        vehicle = sumo.vehicle
        for name, state in self.controlled.items():
            speed = vehicle.getSpeed(name)
            wanted = tracked_speed(speed, state.goal(speed, TIME_CONSTANT), self._step)
            news = abs(wanted - state.requested) > SETTLED
            if news:
                state.requested = wanted
            if news or self.shared:  # another program may have set one
                vehicle.setSpeed(name, state.requested)

    def see(self, snapshot: Snapshot) -> None:
        """A new frame, with what every AV knows of it."""

    def observe(self, now: float) -> list[Intervention]:
        """After every simulation step, at `now` (s): where the car began to drive otherwise than asked."""
        return []

    def wreck(self, name: str) -> None:
        """The vehicle crashed: it stands, and takes no more commands."""
        self.drop(name)
        self._wrecks.add(name)

    def drop(self, name: str) -> None:
        """The vehicle left the road."""
        self.controlled.pop(name, None)
        self.lane_changes.pop(name, None)


def hand_back(name: str) -> None:
    """Let SUMO's own driver drive a vehicle again."""
    sumo.vehicle.setSpeed(name, -1.0)
    sumo.vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
    sumo.vehicle.setLaneChangeMode(name, SUMO_LANE_CHANGE_MODE)


def force(name: str, accel: float, step: float) -> None:
    """For one step of `step` s the vehicle accelerates by `accel` m/s2, whatever its own safety says."""
    sumo.vehicle.setSpeedMode(name, SPEED_MODE[Preset.UNGUARDED])
    sumo.vehicle.setDecel(name, MAX_DECEL)
    sumo.vehicle.setSpeed(name, max(sumo.vehicle.getSpeed(name) + max(accel, -MAX_DECEL) * step, 0.0))


def _forbidden(name: str, lane: str, offset: int) -> str | None:
    """Why the road does not let vehicle `name` on `lane` change by `offset` lanes; None if it does."""
    if not lane:
        return "not on a lane"
    if lane.startswith(":"):
        return "inside a junction"
    edge, _, index = lane.rpartition("_")
    target = int(index) + offset
    if not 0 <= target < sumo.edge.getLaneNumber(edge):
        return "no lane on that side"
    kind = sumo.vehicle.getVehicleClass(name)
    allowed = sumo.lane.getAllowed(f"{edge}_{target}")
    if allowed and kind not in allowed:
        return "the lane is closed to this vehicle class"
    return None if may_change(lane, offset, kind) else "lane changes are forbidden here"
