"""An episode as plain JSON for the replay's page: whole numbers, differences of differences.

A track's positions are centimetres; their second difference is an acceleration of a few units, which gzip
packs to about a byte. `assets/data.js` is the way back.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.recording.recorder import Belief, Choice
from cosim.recording.replay_data import ReplayData, Track
from cosim.report.replay.shapes import LEAST, NAMES, SHAPES
from cosim.report.replay.signs import LAMPS, stop_lines
from cosim.road import RoadMap
from cosim.types import Actor, Bytes, Collision, Floats, Forecast, HumanError, Intervention, Offence

MARGIN = 500.0  # m around the traffic: roads further away are left out
FORECAST_EVERY = 2  # every second predicted frame is drawn


EVERYWHERE = (np.full(2, -np.inf), np.full(2, np.inf))  # an unlimited window
FACTS = (
    "scenario", "demand", "policy", "policy_label", "behavior", "driver_model", "preset", "errors", "sensing",
    "svo_deg", "seed", "steps", "trace_hash", "not_comparable_because", "mission_vehicle", "mission_guessed",
)  # fmt: skip


def document(replay: ReplayData) -> dict[str, Any]:
    """The episode as plain JSON; lengths in cm, times in ms, headings in mrad (see each line)."""
    r = replay
    names = Names(t.id for t in r.tracks)
    drawn = DrawnRoad(r.road, r.goal, r.signals.shape[1], _window(r))
    last = {t.id: t for t in r.tracks}
    return {
        "facts": facts(r.facts),
        "begin": ms(r.begin),
        "times": _differences(r.times * 1000.0),  # ms
        "vehicles": [
            vehicle(name, t.kind, t.mission, t.driver, t.length, t.width, t.actor)
            for name, t in ((name, last[name]) for name in names.vehicles)
        ],
        "tracks": [_track(t, names.vehicles, drawn.lanes) for t in r.tracks],
        **drawn.document,
        "signals": [_signal(r.signals[:, s]) for s in drawn.signals],
        "decided": [ms(t) for t in r.decided],
        "choices": [names.choices(choices) for choices in r.choices],
        "forecasts": [names.forecast(f) for f in r.forecasts],
        "beliefs": [names.beliefs(b) for b in r.beliefs],
        "forecast_interval": next((forecast_interval(f) for f in r.forecasts if f is not None), None),
        "collisions": [collision(c) for c in r.collisions],
        "shapes": shapes({t.actor for t in r.tracks}),
        "violations": names.violations(r.offences),
        "interventions": names.interventions(r.interventions),
        "errors": names.errors(r.errors),
        "words": [*names.words],
    }


class Names:
    """Numbers of vehicles and words, which are written once; word 0 is empty.

    Data of vehicles without a number are left out.
    """

    def __init__(self, vehicles: Iterable[str] = ()) -> None:
        self.vehicles = {name: k for k, name in enumerate(dict.fromkeys(vehicles))}
        self.words: dict[str | None, int] = {None: 0}

    def choices(self, choices: Mapping[str, Choice]) -> list[list[Any]]:
        """[vehicle, action, target cm/s, flags, blamed, blocked, q, score, ttc, unsafe] each; see data.js."""
        return [self._choice(self.vehicles[av], c) for av, c in choices.items() if av in self.vehicles]

    def forecast(self, f: Forecast | None) -> list[Any] | None:
        """Per vehicle [number, x dm, y dm, along dm, across dm], each in differences; None without one."""
        if f is None:
            return None
        at = slice(FORECAST_EVERY - 1, None, FORECAST_EVERY)
        columns = f.x, f.y, f.along_std, f.across_std
        return [
            [self.vehicles[name], *(_differences(column[k, at] * 10.0) for column in columns)]
            for k, name in enumerate(f.ids)
            if name in self.vehicles
        ]

    def beliefs(self, beliefs: Mapping[str, Belief] | None) -> list[list[Any]] | None:
        """[AV, [[vehicle, x dm, y dm, age ds, source], ...], [[vehicle, why unseen], ...]] each.

        None: ideal sensing. Positions are differences to the true ones.
        """
        known = self.vehicles
        if beliefs is None:
            return None
        return [
            [known[av], self._believed(b), [[known[n], int(w)] for n, w in b.unseen.items() if n in known]]
            for av, b in beliefs.items()
            if av in known
        ]

    def _believed(self, b: Belief) -> list[list[int]]:
        tenths = np.rint(np.stack([b.x, b.y, b.age], axis=1) * 10.0).astype(int).tolist()
        rows = zip(b.ids, tenths, b.source.tolist(), strict=True)
        return [[self.vehicles[n], *place, source] for n, place, source in rows if n in self.vehicles]

    def violations(self, offences: Iterable[Offence]) -> list[list[int]]:
        """[ms, vehicle, word] each."""
        known = self.vehicles
        return [[ms(o.time), known[o.vehicle], self._word(o.what)] for o in offences if o.vehicle in known]

    def interventions(self, interventions: Iterable[Intervention]) -> list[list[int]]:
        """[ms, vehicle, word] each."""
        known = self.vehicles
        return [
            [ms(i.time), known[i.vehicle], self._word(i.reason)] for i in interventions if i.vehicle in known
        ]

    def errors(self, errors: Iterable[HumanError]) -> list[list[int]]:
        """[ms, ms when it ends, vehicle, kind, what, near] each, the last three words."""
        return [
            [ms(e.time), ms(e.until), self.vehicles[e.who], *map(self._word, (e.kind, e.what, e.near))]
            for e in errors
            if e.who in self.vehicles
        ]

    def _word(self, text: str | None) -> int:
        return self.words.setdefault(text, len(self.words))

    def _choice(self, number: int, c: Choice) -> list[Any]:
        d = c.decision
        flags = int(d.vetoed) + 2 * int(d.fallback)
        row = [
            number,
            int(d.action),
            round(c.target * 100),
            flags,
            self._word(d.blamed),
            self._word(c.blocked),
        ]
        if d.q is None and d.safety_score is None and d.ttc is None and d.unsafe is None:
            return row
        unsafe = None if d.unsafe is None else [int(u) for u in d.unsafe]
        return [*row, _short(d.q, 4), _short(d.safety_score, 2), _short(d.ttc, 2), unsafe]


class DrawnRoad:
    """The part of a road that a window [2],[2] m shows: `lanes` and `signals` map their numbers to new ones.

    `signals`: how many a snapshot has.

    `document`: lanes, junctions, goal, zones; stop lines [lane, rule, signals], crossings [width cm, centre
    line, signal], and the colours of signals' states.
    """

    def __init__(
        self,
        road: RoadMap,
        goal: Collection[int],
        signals: int,
        window: tuple[Floats, Floats] = EVERYWHERE,
    ) -> None:
        shown = [k for k, lane in enumerate(road.lanes) if _overlaps(lane.shape, window)]
        place = self.lanes = {lane: k for k, lane in enumerate(shown)}
        lines = [line for line in stop_lines(road) if line.lane in place]
        crossings = [c for c in road.crossings if _overlaps(c.shape, window)]
        named = {s for line in lines for s in line.signals} | {c.signal for c in crossings}
        signal = self.signals = {s: k for k, s in enumerate(sorted(s for s in named if 0 <= s < signals))}
        self.document: dict[str, Any] = {
            "lanes": [_lane(road, k) for k in shown],
            "junctions": [_line(shape) for shape in road.junctions if _overlaps(shape, window)],
            "goal": [place[k] for k in sorted(goal) if k in place],
            "zones": sorted({place[k] for zone in road.zones for k in zone.lanes if k in place}),
            "stop_lines": [
                [place[line.lane], int(line.rule), [signal[s] for s in line.signals if s in signal]]
                for line in lines
            ],
            "crossings": [
                [round(c.width * 100), _line(c.shape), signal.get(c.signal, -1)] for c in crossings
            ],
            "lamps": {state: f"#{bytes(colour).hex()}" for state, colour in LAMPS.items()},
        }


def vehicle(
    name: str, kind: int, mission: bool, driver: str, length: float, width: float, actor: int
) -> list[Any]:
    """[id, kind, is mission, class, length cm, width cm, actor]; lengths given in m."""
    return [name, int(kind), int(mission), driver, round(length * 100), round(width * 100), int(actor)]


def collision(c: Collision) -> dict[str, Any]:
    """A collision's data for the list of events, and its position."""
    return {
        "t": ms(c.time), "collider": c.collider, "victim": c.victim, "kind": c.kind, "lane": c.lane,
        "x": _finite(c.x), "y": _finite(c.y), "av_caused": c.av_caused, "human_error": c.human_error_involved,
    }  # fmt: skip


def shapes(actors: Collection[int]) -> dict[int, list[Any]]:
    """Of these actors -> [name, [least length m, least width m], [[colour, [[x, y], ...]], ...]]."""
    every = (Actor(a) for a in sorted(actors))
    return {int(a): [NAMES[a], LEAST.get(a, (0.0, 0.0)), SHAPES[a]] for a in every}


def facts(result: Mapping[str, Any]) -> dict[str, Any]:
    """Data for the head of the page and its table of figures, from an `EpisodeResult.document`."""
    units = result.get("units", {})
    return {
        **{name: result.get(name) for name in FACTS},
        "metrics": [[name, result.get(name), units[name]] for name in units],
    }


def forecast_interval(f: Forecast) -> float:
    """s between the drawn predictions."""
    return f.interval * FORECAST_EVERY


def ms(seconds: float) -> int:
    """Whole ms."""
    return round(seconds * 1000)


# ---- inside ----


def _signal(states: Bytes) -> list[Any]:
    """[T] -> [states, frames in differences]"""
    begins = np.flatnonzero(np.diff(states.astype(np.int16), prepend=-1))
    return [states[begins].tobytes().decode("ascii"), _differences(begins)]


def _track(t: Track, number: dict[str, int], place: dict[int, int]) -> list[Any]:
    """[vehicle, first frame, x cm, y cm, heading mrad, speed cm/s, acceleration cm/s2, lane]"""
    lane = np.array([place.get(int(k), -1) for k in t.lane], np.int64)
    return [
        number[t.id],
        t.first,
        _differences(t.x * 100.0, 2),
        _differences(t.y * 100.0, 2),
        _differences(np.unwrap(t.heading) * 1000.0),
        _differences(t.speed * 100.0),
        _differences(t.accel * 100.0),
        _differences(lane),
    ]


def _window(r: ReplayData) -> tuple[Floats, Floats]:
    """The traffic's bounding box with a margin: lower left and upper right corner, [2] m each."""
    if not r.tracks:
        return EVERYWHERE
    points = np.hstack([(t.x, t.y) for t in r.tracks])  # [2,p]
    return points.min(1) - MARGIN, points.max(1) + MARGIN


def _overlaps(shape: Floats, window: tuple[Floats, Floats]) -> bool:
    """Whether the bounding box of a shape [p,2] m overlaps the window."""
    return bool((shape.max(0) >= window[0]).all() and (shape.min(0) <= window[1]).all())


def _lane(road: RoadMap, k: int) -> list[Any]:
    """[id, width cm, is internal, centre line]"""
    lane = road.lanes[k]
    return [lane.id, round(lane.width * 100), int(lane.internal), _line(lane.shape)]


def _line(shape: Floats) -> list[list[int]]:
    """A polyline [p,2] m as [x cm, y cm] in differences."""
    return [_differences(shape[:, 0] * 100.0), _differences(shape[:, 1] * 100.0)]


def _differences(values: npt.NDArray[Any], order: int = 1) -> list[int]:
    """Whole numbers; the first value, then the steps (`order` times)."""
    whole = np.rint(np.nan_to_num(values)).astype(np.int64)
    for _ in range(order):
        whole = np.diff(whole, prepend=0)
    return [int(v) for v in whole]


def _short(values: npt.NDArray[Any] | None, digits: int) -> list[float | None] | None:
    return None if values is None else [_finite(float(v), digits) for v in values]


def _finite(value: float, digits: int = 2) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
