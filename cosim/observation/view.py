"""The observation of an agent outside the simulation's process, and its compact transfer.

A `History` contains the lane paths of its route: too much to pickle at every decision. A `View` holds the
needed part as plain arrays, and of the N maps only the new ones are sent (`Unpacker` keeps the rest).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.road.rules import RulesAhead
from cosim.types import LANE_OFFSET, Bools, Bytes, Floats, Floats32, History, MetaAction

LOOK_AHEAD = np.arange(0.0, 101.0, 10.0)  # [P] m ahead of the centre: 4 s at 25 m/s, the horizon
SIDES = ("left", "keep", "right")


class View(NamedTuple):
    """One AV's observation at one decision, as plain arrays (m, m/s, rad, s).

    Sides are left, keep, right. N frames are oldest first; R rows are vehicles; P = 11 points lie 0, 10, ...
    100 m ahead. Masks are advice: the receipt of a masked lane change gives the reason of its refusal.

    Attributes:
        velocity_map: [N,C,H,W] pixel * 255; [N,C,0,0] without maps.
        kinematics: [N,R,F] of `cosim.types.KINEMATIC_FEATURES`; row 0 is the AV itself.
        valid: [N,R] whether that row was perceived at that frame.
        ids: R names, "" for an empty row.
        pose: [3] x m, y m, heading rad in the world.
        target_speed: m/s, the present command (the speed while SUMO drives).
        lane_changing: +1 / -1 while a change to the left / right is under way, else 0.
        speed_limit: m/s.
        to_dead_end: [3] m to the dead end of the lane; inf: none, 0: there is no lane.
        conflict_distance: m to the conflict zone along the present lane; inf when none is ahead.
        lane_exists: [3] whether there is a lane.
        centre_lines: [3,P,2] m in the AV's frame (x ahead, y left); 0 where there is no lane.
        action_mask: [A] False for a lane change towards no lane, or while one is under way.
        time: s.
        rules: the law on its own route: signals, stop lines, crossings, limits.
        age: [R] s since the newest measurement of each row's vehicle; 0 with ideal sensing.
        source: [R] `cosim.types.Source` of that measurement.
        indicator: [R] turn indicator then: +1 left, -1 right, 0 off.
        decision_latency: s until an action given now acts; the command before holds until then.
    """

    velocity_map: Bytes
    kinematics: Floats32
    valid: Bools
    ids: tuple[str, ...]
    pose: Floats
    target_speed: float
    lane_changing: int
    speed_limit: float
    to_dead_end: Floats
    conflict_distance: float
    lane_exists: Bools
    centre_lines: Floats32
    action_mask: Bools
    time: float
    rules: RulesAhead
    age: Floats
    source: npt.NDArray[np.int8]
    indicator: npt.NDArray[np.int8]
    decision_latency: float

    @property
    def ego_speed(self) -> float:
        """The AV's speed in m/s."""
        return float(self.kinematics[-1, 0, 2])


class Packed(NamedTuple):
    """Views of B AVs as a few stacked arrays, for pickling."""

    avs: tuple[str, ...]  # B
    maps: Bytes  # [B - newcomers, k, C,H,W] the k new frames of AVs with earlier maps at the receiver
    new_maps: Bytes  # [newcomers, N, C,H,W]
    newcomers: tuple[str, ...]
    kinematics: Floats32  # [B,N,R,F]
    valid: Bools  # [B,N,R]
    ids: tuple[tuple[str, ...], ...]
    # [B,23] pose 3, target speed, change, limit, dead ends 3, conflict, time, latency; of `rules` the
    # signal's state (0: none), all other fields in their order, and how many rows of `limits`
    numbers: Floats
    limits: Floats  # [k,2] m, m/s: of all AVs, concatenated
    lanes: Bools  # [B,3]
    lines: Floats32  # [B,3,P,2]
    age: Floats  # [B,R]
    source: npt.NDArray[np.int8]  # [B,R]
    indicator: npt.NDArray[np.int8]  # [B,R]


class Packer:
    """The simulation's side: tracks the maps that the agent's side already holds."""

    def __init__(self) -> None:
        self._sent: frozenset[str] = frozenset()

    def pack(self, histories: Mapping[str, History], fresh: int | None) -> Packed:
        """The views of all AVs, for the agent's side.

        Args:
            histories: AV id -> its history at this decision.
            fresh: frames since the last packing; None sends whole histories (a new episode).
        """
        avs = tuple(histories)
        known = [name for name in avs if fresh is not None and name in self._sent]
        newcomers = tuple(name for name in avs if name not in known)
        self._sent = frozenset(avs)
        everyone = list(histories.values())
        empty = np.zeros((0, 0, 0, 0, 0), np.uint8)
        lines, exists = _lines(everyone)
        numbers = [
            (
                *(*h.pose, h.target_speed, h.lane_changing, h.route.speed_limit),
                *map(h.route.to_end, range(len(SIDES))),
                *(h.route.conflict_distance, h.time, h.decision_latency),
                *(ord(h.rules.signal or "\0"), *h.rules[1:-1], len(h.rules.limits)),
            )
            for h in everyone
        ]
        return Packed(
            avs=avs,
            maps=np.stack([histories[n].velocity_map[-(fresh or 0) :] for n in known]) if known else empty,
            new_maps=np.stack([histories[n].velocity_map for n in newcomers]) if newcomers else empty,
            newcomers=newcomers,
            kinematics=np.stack([h.kinematics for h in everyone]) if everyone else empty.astype(np.float32),
            valid=np.stack([h.valid for h in everyone]) if everyone else empty.astype(np.bool_),
            ids=tuple(h.ids for h in everyone),
            numbers=np.array(numbers, np.float64).reshape(-1, 23),
            limits=np.concatenate([h.rules.limits for h in everyone]) if everyone else np.zeros((0, 2)),
            lanes=exists,
            lines=lines,
            age=_by_row([h.age for h in everyone], everyone, np.float64),
            source=_by_row([h.source for h in everyone], everyone, np.int8),
            indicator=_by_row([h.indicator for h in everyone], everyone, np.int8),
        )


class Unpacker:
    """The agent's side: appends the new maps to the earlier ones."""

    def __init__(self) -> None:
        self._maps: dict[str, Bytes] = {}

    def unpack(self, packed: Packed) -> dict[str, View]:
        """AV id -> View; every array is the caller's own."""
        maps = dict(zip(packed.newcomers, packed.new_maps, strict=True))
        known = (name for name in packed.avs if name not in maps)
        for name, fresh in zip(known, packed.maps, strict=True):
            maps[name] = np.concatenate([self._maps[name][len(fresh) :], fresh])
        self._maps = maps
        limits = np.split(packed.limits, packed.numbers[:, -1].astype(int).cumsum()[:-1])
        return {name: self._view(packed, b, name, limits[b]) for b, name in enumerate(packed.avs)}

    def _view(self, packed: Packed, b: int, name: str, limits: Floats) -> View:
        own, law = packed.numbers[b, :12].tolist(), packed.numbers[b, 12:-1].tolist()
        x, y, heading, target, change, limit, left, keep, right, conflict, time, latency = own
        state, signal_distance, signal, switch, stop, all_way, give_way, link, crossing, person = law
        lanes = packed.lanes[b]
        mask = np.ones(len(MetaAction), np.bool_)
        for action, offset in LANE_OFFSET.items():
            mask[action] = not change and lanes[1 - offset]
        return View(
            velocity_map=self._maps[name],
            kinematics=packed.kinematics[b],
            valid=packed.valid[b],
            ids=packed.ids[b],
            pose=np.array([x, y, heading]),
            target_speed=target,
            lane_changing=int(change),
            speed_limit=limit,
            to_dead_end=np.array([left, keep, right]),
            conflict_distance=conflict,
            lane_exists=lanes,
            centre_lines=packed.lines[b],
            action_mask=mask,
            time=time,
            age=packed.age[b],
            source=packed.source[b],
            indicator=packed.indicator[b],
            decision_latency=latency,
            rules=RulesAhead(
                *(chr(int(state)).strip("\0"), signal_distance, int(signal), switch, stop, bool(all_way)),
                *(give_way, int(link), crossing, person, limits),
            ),
        )


def views(histories: Mapping[str, History]) -> dict[str, View]:
    """The views of an agent in the simulation's own process: AV id -> View."""
    return Unpacker().unpack(Packer().pack(histories, None))


def _by_row(columns: list[npt.NDArray[Any]], histories: list[History], dtype: Any) -> npt.NDArray[Any]:
    """[B,R] of columns [R] or, with ideal sensing, [0]: then all are 0."""
    if not histories:
        return np.zeros((0, 0), dtype)
    ideal = np.zeros(len(histories[0].ids), dtype)
    return np.array([column if len(column) else ideal for column in columns], dtype)


def _lines(histories: list[History]) -> tuple[Floats32, Bools]:
    """Centre lines ahead in each AV's frame [B,3,P,2] m, and existence of the lanes [B,3]."""
    lines = np.zeros((len(histories), len(SIDES), len(LOOK_AHEAD), 2), np.float32)
    exists = np.zeros((len(histories), len(SIDES)), np.bool_)
    for b, h in enumerate(histories):
        x0, y0, heading = h.pose
        c, s = np.cos(heading), np.sin(heading)
        arc = h.route.arc + LOOK_AHEAD
        for side, path in enumerate(h.route.paths):
            if path is None:
                continue
            exists[b, side] = True
            dx = np.interp(arc, path.arc, path.points[:, 0]) - x0  # a path repeats its last point
            dy = np.interp(arc, path.arc, path.points[:, 1]) - y0
            lines[b, side, :, 0] = c * dx + s * dy
            lines[b, side, :, 1] = c * dy - s * dx
    return lines, exists
