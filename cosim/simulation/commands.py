"""Translates commands into SUMO's calls; a receipt says whether SUMO carried a command out, or why not."""

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
# 513: SUMO's lane changes for the route unless they contradict the agent's; respects the gaps of others
LANE_CHANGE_MODE = {Preset.UNGUARDED: 0, Preset.GUARDED: 512, Preset.LAWFUL: 513}
SUMO_SPEED_MODE, SUMO_LANE_CHANGE_MODE = 31, 1621  # SUMO's defaults
SPEED_TOLERANCE = 1e-3  # m/s: closer to its target an AV needs no new command
OVERRIDE_TOLERANCE = 0.05  # m/s: at a larger deviation another program has set the speed


@dataclass(slots=True)
class Controlled:
    """The state of one commanded AV."""

    target: float  # m/s
    limit: float = math.inf  # m/s, of the law ahead
    lane_change: int = 0  # +1 left, -1 right, of the last lane change
    lane_change_until: float = -1.0  # s, the end of the last lane change
    wanted_lane: str = ""  # of the last commanded lane change
    requested: float = -1.0  # m/s, the last speed sent to SUMO
    target_accel: float | None = None  # m/s2, replaces the target speed

    def tracked_target(self, speed: float, time: float) -> float:
        """The target speed in m/s, for tracking with the time constant `time` (s) at `speed` (m/s)."""
        return self.target if self.target_accel is None else speed + self.target_accel * time

    @property
    def expected_speed(self) -> float:
        """The commanded maximum speed in m/s at the end of the last step; inf where SUMO drove the AV."""
        return self.requested

    def changing(self, now: float) -> int:
        """The lane change under way at `now` (s): +1 left, -1 right, 0 none."""
        return self.lane_change if now < self.lane_change_until - 1e-9 else 0


class Commander:
    """Drives every commanded AV at its target speed, step by step, and starts lane changes."""

    shared = False  # whether other programs command vehicles too

    def __init__(self, preset: str, step: float) -> None:
        self._preset = preset
        self._step = step  # s
        self.controlled: dict[str, Controlled] = {}
        self.lane_changes: dict[str, float] = {}  # AV -> s, start of its last lane change (for cut-ins)
        self._wrecks: set[str] = set()

    def take(self, command: Command, now: float) -> Receipt:
        """Start one command at `now` (s); the first command of a vehicle takes control of it."""
        name = command.vehicle
        if name in self._wrecks:
            return Receipt(name, False, "crashed")
        try:
            lane = sumo.vehicle.getLaneID(name)
        except sumo.TraCIException:
            return Receipt(name, False, "not on the road")
        state = self.controlled.get(name)
        if state is None:
            state = self.controlled[name] = self._take_control(name)
            sumo.vehicle.setSpeedMode(name, SPEED_MODE[self._preset])
            sumo.vehicle.setLaneChangeMode(name, LANE_CHANGE_MODE[self._preset])
        state.target = min(command.target_speed, sumo.vehicle.getMaxSpeed(name))
        state.limit, state.target_accel = command.limit, command.accel
        if command.lane_offset == 0:
            return Receipt(name, True)
        refusal = (
            "a lane change is under way"
            if state.changing(now)
            else self._refusal(name, lane, command.lane_offset)
        )
        if refusal is not None:
            return Receipt(name, False, refusal)
        sumo.vehicle.changeLaneRelative(name, command.lane_offset, command.hold)
        edge, _, index = lane.rpartition("_")
        state.wanted_lane = f"{edge}_{int(index) + command.lane_offset}"
        self._record_lane_change(name, state, command.lane_offset, now)
        return Receipt(name, True)

    def _release_control(self, name: str) -> None:
        """Undo `_take_control`."""
        sumo.vehicle.setDecel(name, AV_IDM["decel"])

    def _record_lane_change(self, name: str, state: Controlled, offset: int, now: float) -> None:
        state.lane_change = offset
        state.lane_change_until = now + LANE_CHANGE_TIME
        self.lane_changes[name] = now

    def default_target_speed(self, name: str) -> float | None:
        """The target speed in m/s of a vehicle without commands; None: unknown."""
        return None

    def _take_control(self, name: str) -> Controlled:
        """Let the vehicle brake as hard as commands may ask."""
        sumo.vehicle.setDecel(name, MAX_DECEL)
        return Controlled(0.0)

    def _refusal(self, name: str, lane: str, offset: int) -> str | None:
        """Why vehicle `name` on `lane` must not change by `offset` lanes; None if it may."""
        return _refusal(name, lane, offset)

    def release(self, commanded: Sequence[Command]) -> None:
        """Return AVs without a command to SUMO's own driver."""
        names = {c.vehicle for c in commanded}
        for name in [n for n in self.controlled if n not in names]:
            del self.controlled[name]
            return_to_sumo(name)
            self._release_control(name)

    def confirm(self, receipts: Sequence[Receipt], commands: Sequence[Command]) -> tuple[Receipt, ...]:
        """The receipts at the end of a decision. SUMO's safety checks refused a lane change that did not
        begin; another program set a speed other than the commanded one."""
        confirmed = list(receipts)
        if self.shared:
            confirmed = [self._check_override(receipt) for receipt in receipts]
        for k, (receipt, command) in enumerate(zip(receipts, commands, strict=True)):
            if not command.lane_offset or not receipt.executed:
                continue
            name, state = command.vehicle, self.controlled.get(command.vehicle)
            if not state or name not in sumo.vehicle.getIDList():
                continue
            there = sumo.vehicle.getLaneID(name) == state.wanted_lane  # a file's changes may take no time
            if not there and abs(sumo.vehicle.getLateralLanePosition(name)) < 0.05:
                state.lane_change, state.lane_change_until = 0, -1.0
                self.lane_changes.pop(name, None)
                confirmed[k] = Receipt(name, False, f"refused by SUMO's lane-change safety ({self._preset})")
        return tuple(confirmed)

    def _check_override(self, receipt: Receipt) -> Receipt:
        name, state = receipt.vehicle, self.controlled.get(receipt.vehicle)
        if not receipt.executed or not state or name not in sumo.vehicle.getIDList():
            return receipt
        excess = sumo.vehicle.getSpeed(name) - state.expected_speed  # m/s
        if excess > OVERRIDE_TOLERANCE or (self._preset == Preset.UNGUARDED and excess < -OVERRIDE_TOLERANCE):
            return Receipt(name, False, "another program set its speed")
        return receipt

    def drive(self) -> None:
        """Track the target speeds; called before every simulation step."""
        vehicle = sumo.vehicle
        for name, state in self.controlled.items():
            speed = vehicle.getSpeed(name)
            wanted = tracked_speed(speed, state.tracked_target(speed, TIME_CONSTANT), self._step)
            new = abs(wanted - state.requested) > SPEED_TOLERANCE
            if new:
                state.requested = wanted
            if new or self.shared:  # another program may have set a speed
                vehicle.setSpeed(name, state.requested)

    def update_percepts(self, snapshot: Snapshot) -> None:
        """Take a new frame, with the percept of every AV."""

    def find_interventions(self, now: float) -> list[Intervention]:
        """The interventions that began in the step that ended at `now` (s)."""
        return []

    def wreck(self, name: str) -> None:
        """The vehicle has crashed: it stands, and takes no more commands."""
        self.drop(name)
        self._wrecks.add(name)

    def drop(self, name: str) -> None:
        """The vehicle has left the road."""
        self.controlled.pop(name, None)
        self.lane_changes.pop(name, None)


def return_to_sumo(name: str) -> None:
    """Return a vehicle to SUMO's own driver."""
    sumo.vehicle.setSpeed(name, -1.0)
    sumo.vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
    sumo.vehicle.setLaneChangeMode(name, SUMO_LANE_CHANGE_MODE)


def _refusal(name: str, lane: str, offset: int) -> str | None:
    """Why the road forbids vehicle `name` on `lane` to change by `offset` lanes; None if it does not."""
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
