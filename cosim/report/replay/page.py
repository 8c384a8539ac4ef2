"""The replay as one self-contained HTML file: no network, no library, a plain canvas.

The episode is packed as whole numbers, differences of differences, then gzip and base64. A track's positions
are centimetres; their second difference is an acceleration of a few units, which gzip packs to about a byte.
`assets/data.js` is the way back.
"""

import base64
import gzip
import html
import json
import math
from importlib import resources
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.recording.recorder import Choice
from cosim.recording.replay_data import ReplayData, Track
from cosim.report.replay.shapes import LEAST, NAMES, SHAPES
from cosim.report.replay.signs import LAMPS, stop_lines
from cosim.types import Bytes, Floats, Forecast

MARGIN = 500.0  # m around the traffic: roads further away are left out
SCRIPTS = ("data.js", "view.js", "draw.js", "panel.js", "main.js")
FORECAST_EVERY = 2  # every second predicted frame is drawn


def page(replay: ReplayData) -> str:
    """The whole page as text."""
    assets = resources.files(__package__).joinpath("assets")
    facts = replay.facts
    text = json.dumps(document(replay), separators=(",", ":"), allow_nan=False)
    title = " / ".join(str(facts.get(name, "")) for name in ("scenario", "demand", "policy"))
    scripts = [assets.joinpath(name).read_text("utf-8") for name in SCRIPTS]
    return Template(assets.joinpath("page.html").read_text("utf-8")).substitute(
        title=html.escape(f"{title}, seed {facts.get('seed', '')}"),
        style=assets.joinpath("style.css").read_text("utf-8"),
        script="\n".join(scripts),
        data=base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode(),
    )


def document(replay: ReplayData) -> dict[str, Any]:
    """The episode as plain JSON; lengths in cm, times in ms, headings in mrad (see each line)."""
    r = replay
    number = {name: k for k, name in enumerate(dict.fromkeys(t.id for t in r.tracks))}
    words: dict[str | None, int] = {None: 0}  # names and reasons, each written once; number 0 is nobody
    window = _window(r)
    lanes = [k for k, lane in enumerate(r.road.lanes) if _meets(lane.shape, window)]
    place = {lane: k for k, lane in enumerate(lanes)}
    return {
        "facts": _facts(r),
        "begin": _ms(r.begin),
        "times": _differences(r.times * 1000.0),  # ms
        "vehicles": _vehicles(r, number),
        "tracks": [_track(t, number, place) for t in r.tracks],
        "lanes": [_lane(r, k) for k in lanes],
        "junctions": [_line(shape) for shape in r.road.junctions if _meets(shape, window)],
        "goal": [place[k] for k in sorted(r.goal) if k in place],
        "zones": sorted({place[k] for zone in r.road.zones for k in zone.lanes if k in place}),
        "decided": [_ms(t) for t in r.decided],
        "choices": [
            [_choice(number[name], c, words) for name, c in choices.items() if name in number]
            for choices in r.choices
        ],
        "forecasts": [_forecast(f, number) for f in r.forecasts],
        "forecast_interval": _forecast_interval(r),
        "collisions": [
            {
                "t": _ms(c.time), "collider": c.collider, "victim": c.victim, "kind": c.kind, "lane": c.lane,
                "x": _finite(c.x), "y": _finite(c.y), "av_caused": c.av_caused,
                "human_error": c.human_error_involved,
            }
            for c in r.collisions
        ],
        "shapes": _shapes(r),
        **_signs(r, place, window),
        "violations": [
            [_ms(one.time), number[one.vehicle], words.setdefault(one.what, len(words))]
            for one in r.offences
            if one.vehicle in number
        ],
        "interventions": [
            [_ms(one.time), number[one.vehicle], words.setdefault(one.reason, len(words))]
            for one in r.interventions
            if one.vehicle in number
        ],
        "errors": [
            [_ms(one.time), _ms(one.until), number[one.who],
             *(words.setdefault(text, len(words)) for text in (one.kind, one.what, one.near))]
            for one in r.errors
            if one.who in number
        ],
        "words": [*words],
    }  # fmt: skip


def _shapes(r: ReplayData) -> dict[int, list[Any]]:
    """Of the actors there are -> [name, [least length m, least width m], [[colour, [[x, y], ...]], ...]]."""
    return {
        int(a): [NAMES[a], LEAST.get(a, (0.0, 0.0)), SHAPES[a]] for a in sorted({t.actor for t in r.tracks})
    }


def _signs(r: ReplayData, place: dict[int, int], window: tuple[Floats, Floats]) -> dict[str, Any]:
    """Stop lines [lane, rule, signals], crossings [width cm, centre line, signal], and each signal they name.

    A signal is [states, frames]: its states one after the other, and the frames in which they begin, in
    differences. Signals change seldom.
    """
    lines = [line for line in stop_lines(r.road) if line.lane in place]
    crossings = [c for c in r.road.crossings if _meets(c.shape, window)]
    named = {s for line in lines for s in line.signals} | {c.signal for c in crossings}
    shown = {s: k for k, s in enumerate(sorted(s for s in named if 0 <= s < r.signals.shape[1]))}
    return {
        "stop_lines": [
            [place[line.lane], int(line.rule), [shown[s] for s in line.signals if s in shown]]
            for line in lines
        ],
        "crossings": [[round(c.width * 100), _line(c.shape), shown.get(c.signal, -1)] for c in crossings],
        "signals": [_signal(r.signals[:, s]) for s in shown],
        "lamps": {state: f"#{bytes(colour).hex()}" for state, colour in LAMPS.items()},
    }


def _signal(states: Bytes) -> list[Any]:
    """[T] -> [states, frames in differences]"""
    begins = np.flatnonzero(np.diff(states.astype(np.int16), prepend=-1))
    return [states[begins].tobytes().decode("ascii"), _differences(begins)]


def _facts(r: ReplayData) -> dict[str, Any]:
    """What stands at the head of the page and in its table of figures."""
    units = r.facts.get("units", {})
    names = (
        "scenario demand policy policy_label behavior driver_model preset errors svo_deg seed steps "
        "trace_hash not_comparable_because mission_vehicle mission_guessed"
    )
    return {
        **{name: r.facts.get(name) for name in names.split()},
        "metrics": [[name, r.facts.get(name), units[name]] for name in units],
        "frame": _ms(r.interval),
    }


def _vehicles(r: ReplayData, number: dict[str, int]) -> list[list[Any]]:
    """[id, kind, is mission, class, length cm, width cm, actor] by number."""
    last = {t.id: t for t in r.tracks}
    return [
        [
            t.id,
            int(t.kind),
            int(t.mission),
            t.driver,
            round(t.length * 100),
            round(t.width * 100),
            int(t.actor),
        ]
        for t in (last[name] for name in number)
    ]


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


def _choice(vehicle: int, c: Choice, words: dict[str | None, int]) -> list[Any]:
    """[vehicle, action, target cm/s, flags, blamed, blocked, q, score, ttc, unsafe]; see data.js."""
    d = c.decision
    flags = int(d.vetoed) + 2 * int(d.fallback)
    row = [
        vehicle,
        int(d.action),
        round(c.target * 100),
        flags,
        words.setdefault(d.blamed, len(words)),
        words.setdefault(c.blocked, len(words)),
    ]
    if d.q is None and d.safety_score is None and d.ttc is None and d.unsafe is None:
        return row
    unsafe = None if d.unsafe is None else [int(u) for u in d.unsafe]
    return [*row, _short(d.q, 4), _short(d.safety_score, 2), _short(d.ttc, 2), unsafe]


def _forecast(f: Forecast | None, number: dict[str, int]) -> list[Any] | None:
    """Per vehicle [number, x dm, y dm, along dm, across dm], each in differences; None without one."""
    if f is None:
        return None
    at = slice(FORECAST_EVERY - 1, None, FORECAST_EVERY)
    return [
        [number[name], *(_differences(a[k, at] * 10.0) for a in (f.x, f.y, f.along_std, f.across_std))]
        for k, name in enumerate(f.ids)
        if name in number
    ]


def _forecast_interval(r: ReplayData) -> float | None:
    first = next((f for f in r.forecasts if f is not None), None)
    return None if first is None else first.interval * FORECAST_EVERY


def _window(r: ReplayData) -> tuple[Floats, Floats]:
    """The traffic's bounding box with a margin: lower left and upper right corner, [2] m each."""
    if not r.tracks:
        return np.full(2, -np.inf), np.full(2, np.inf)
    points = np.hstack([(t.x, t.y) for t in r.tracks])  # [2,p]
    return points.min(1) - MARGIN, points.max(1) + MARGIN


def _meets(shape: Floats, window: tuple[Floats, Floats]) -> bool:
    """Whether a shape [p,2] m reaches into the window."""
    return bool((shape.max(0) >= window[0]).all() and (shape.min(0) <= window[1]).all())


def _lane(r: ReplayData, k: int) -> list[Any]:
    """[id, width cm, is internal, centre line]"""
    lane = r.road.lanes[k]
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


def _ms(seconds: float) -> int:
    return round(seconds * 1000)
