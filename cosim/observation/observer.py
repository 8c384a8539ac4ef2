"""The observer: turns snapshots into one History per AV, the first step of every decision."""

from collections.abc import Callable, Mapping

import numpy as np

from cosim.geometry.raster import RoadRaster, draw_snapshot, rasterize_road
from cosim.observation.kinematics import choose_rows, fill_rows, never_left_out, perceived
from cosim.observation.past import KinematicPast, MapPast
from cosim.road import RoadMap
from cosim.road.rules import Moment, RuleBook
from cosim.types import KINEMATIC_FEATURES, Bools, History, Ints, Kind, ObservationConfig, Percept, Snapshot

RouteOf = Callable[[str], tuple[str, ...]]  # AV id -> edges ahead, the present one first
CommandOf = Callable[[str], tuple[float | None, int]]  # AV id -> target speed m/s, lane change under way


class Observer:
    """Holds the past of one episode. `add` once per frame, `histories` once per decision.

    Args:
        road: the net, for the road channel and the routes ahead.
        config: sizes and ranges; a History has N = `config.frames` frames and R = `config.rows` rows.
        decision_latency: s until a decision acts, for every History.

    Arrays inside a History are views or fresh copies that stay valid for at least N further frames.
    """

    def __init__(self, road: RoadMap, config: ObservationConfig, decision_latency: float = 0.0) -> None:
        self._road = road
        self._config = config
        self._decision_latency = decision_latency
        version = config.road_version
        self._raster: RoadRaster | None = rasterize_road(road, version) if config.maps else None
        self._rules = RuleBook(road)
        self._maps = MapPast(config) if config.maps else None
        self.reset()

    def reset(self) -> None:
        """Clear the past for a new episode."""
        self._past = KinematicPast(self._config.frames)
        self._pasts: dict[str, KinematicPast] = {}  # AV -> the past from its percepts
        if self._maps is not None:
            self._maps.clear()
        self._newest: Snapshot | None = None

    def add(self, snapshot: Snapshot) -> None:
        """Append one frame: the kinematics of all vehicles, the maps of every AV on the road."""
        self._newest = snapshot
        self._egos: Ints = np.flatnonzero(snapshot.kind == int(Kind.AV))
        if snapshot.percepts is None:
            self._past.add(snapshot)
        else:
            self._add_percepts(snapshot.percepts)
        if self._maps is None or self._raster is None:
            return
        block, slots = self._maps.next_frame(tuple(snapshot.ids[i] for i in self._egos))
        if snapshot.percepts is None:
            draw_snapshot(block, slots, snapshot, self._egos, self._perceived(), self._raster, self._config)
            return
        for name, slot in zip(snapshot.avs, slots, strict=True):
            world = snapshot.percepts[name].world
            here, seen = np.array([world.row[name]]), np.ones((1, world.n), np.bool_)
            draw_snapshot(block, np.array([slot]), world, here, seen, self._raster, self._config)

    def histories(self, route: RouteOf, commanded: CommandOf) -> dict[str, History]:
        """One History per AV on the road, at the newest frame (AVs off every lane are left out).

        Args:
            route: AV id -> the edges ahead of it (`Simulator.route`).
            commanded: AV id -> its target speed and lane change under way (`Simulator.commanded`).
        """
        s = self._newest
        if s is None or not len(self._egos):
            return {}
        if s.percepts is None:
            return self._histories(s, self._past, self._egos, self._perceived(), route, commanded)
        result = {}
        for name in s.avs:
            percept = s.percepts[name]
            world, past = percept.world, self._pasts[name]
            here, seen = np.array([world.row[name]]), np.ones((1, world.n), np.bool_)
            for history in self._histories(world, past, here, seen, route, commanded).values():
                rows = np.array([world.row.get(other, -1) for other in history.ids])
                result[name] = history._replace(
                    age=np.where(rows >= 0, percept.age[rows], 0.0),
                    source=np.where(rows >= 0, percept.source[rows], 0).astype(np.int8),
                    hears=percept.hears,
                )
        return result

    # ---- inside ----

    def _add_percepts(self, percepts: Mapping[str, Percept]) -> None:
        self._pasts = {name: self._pasts.get(name) or KinematicPast(self._config.frames) for name in percepts}
        for name, past in self._pasts.items():
            past.add(percepts[name].world)

    def _histories(
        self,
        s: Snapshot,
        past: KinematicPast,
        egos: Ints,  # [B]
        seen: Bools,  # [B,n]
        route: RouteOf,
        commanded: CommandOf,
    ) -> dict[str, History]:
        """Histories of the AVs `egos`, from the vehicles of `s` that they have `seen`."""
        c, count = self._config, len(egos)
        rows = np.empty((count, c.rows), np.int64)
        none = np.zeros((count, s.n), np.bool_)
        if choose_rows(s.x, s.y, egos, seen, c.row_range, none, rows):
            first = never_left_out(s, self._road.straight_on, egos, c.row_range)
            choose_rows(s.x, s.y, egos, seen, c.row_range, first, rows)
        kinematics = np.zeros((count, c.frames, c.rows, len(KINEMATIC_FEATURES)), np.float32)
        valid = np.zeros((count, c.frames, c.rows), np.bool_)
        fixed = np.stack([s.length, s.width, s.kind == int(Kind.AV), s.mission], axis=1).astype(np.float64)
        fill_rows(past.window, past.slots, rows, fixed, kinematics, valid)
        lanes = np.where(rows >= 0, s.lane[rows], -1).astype(np.int32)  # [B,R]
        positions = np.where(rows >= 0, s.lane_position[rows], 0.0)  # [B,R] m
        indicators = np.where(rows >= 0, s.indicator[rows], 0).astype(np.int8)  # [B,R]
        pose = np.stack([s.x, s.y, s.heading], axis=1)[egos]  # [B,3]
        no_maps = np.zeros((c.frames, len(c.channels), 0, 0), np.uint8)
        result = {}
        names = (*s.ids, "")
        now = self._moment(s, seen[0])
        for b, e in enumerate(egos):
            name = s.ids[e]
            if lanes[b, 0] < 0:  # off every lane: no command is possible
                continue
            target, change = commanded(name)
            place, length = float(positions[b, 0]), float(s.length[e])
            ahead = self._road.ahead(int(lanes[b, 0]), place, length, route(name))
            ahead = ahead._replace(speed_limit=s.limits.get(int(lanes[b, 0]), ahead.speed_limit))
            way = ahead.paths[1]
            assert way is not None
            if not c.share_perception and b:
                now = self._moment(s, seen[b])
            result[name] = History(
                velocity_map=no_maps if self._maps is None else self._maps.view(name),
                kinematics=kinematics[b],
                valid=valid[b],
                ids=tuple([names[j] for j in rows[b]]),
                lane=lanes[b],
                lane_position=positions[b],
                pose=pose[b],
                target_speed=float(s.speed[e]) if target is None else target,
                lane_changing=change,
                route=ahead,
                time=s.time,
                rules=self._rules.ahead(way, place * way.scale, now),
                signals=s.signals,
                indicator=indicators[b],
                decision_latency=self._decision_latency,
            )
        return result

    def _perceived(self) -> Bools:
        """[B,n] vehicles that each AV perceives in the newest frame."""
        assert self._newest is not None
        c = self._config
        return perceived(self._newest, self._egos, c.perception_range, c.share_perception)

    def _moment(self, s: Snapshot, seen: Bools) -> Moment:
        """The signals, the changed limits, and the persons among the `seen` [n] (with V2V: perceived by any
        AV)."""
        chosen = np.flatnonzero((s.kind == int(Kind.PERSON)) & seen)
        persons = np.stack([s.x, s.y, s.heading, s.speed], axis=1)[chosen] if len(chosen) else None
        told = self._config.signal_timing and len(s.switches)
        return Moment(s.signals, s.switches if told else None, persons, s.limits)
