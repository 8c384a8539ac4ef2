"""The replay as an MP4 or a GIF: a strip of road that follows one vehicle, and an AV's decisions.

Several episodes (for example the same seed with other policies) are drawn one above the other at equal
elapsed times, each with its own camera.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from cosim.files import whole
from cosim.recording.recorder import Choice
from cosim.recording.replay_data import ReplayData, Track
from cosim.report.replay.shapes import NAMES
from cosim.report.replay.signs import stop_lines
from cosim.report.replay.strip import (
    AV,
    BAD,
    CORRECTION,
    ERROR,
    LAW,
    OTHER,
    PERSON,
    TEXT,
    WARN,
    Colour,
    Pose,
    Strip,
    colour_of,
    font,
    icon,
    poses_at,
)  # fmt: skip
from cosim.types import Actor, Kind, MetaAction
from cosim.workers.tasks import Progress

WIDTH, HEIGHT = 1280, 400  # pixels
PANEL = 140  # pixels of text beneath the road
RATE = 10  # pictures a second
SMALL, LOW, CAPTION = 800, 112, 24  # pixels: width of a GIF, height of its road and of the line beneath
STEP, SHOWN = 0.4, 0.2  # s between pictures of a GIF, and s that each is shown: twice real time
COLOURS = 64  # of a GIF
SHOWN_CRASH = 4.0  # s that a collision stays marked
SHOWN_EVENT = 2.0  # s that a correction or an offence stays marked
SPLIT = 470  # pixel: the episode left of it, one AV's decision right of it
QUIET, GOOD = (95, 107, 122), (21, 128, 61)
ACTIONS = {
    MetaAction.LANE_LEFT: "lane left",
    MetaAction.IDLE: "idle",
    MetaAction.LANE_RIGHT: "lane right",
    MetaAction.ACCELERATE: "accelerate",
    MetaAction.DECELERATE: "decelerate",
}


def film(
    episodes: Sequence[ReplayData], path: Path, *, follow: str | None = None, progress: Progress | None = None
) -> None:
    """Write the MP4. `follow`: a vehicle's id (default: the mission vehicle, else the first AV).

    The file is written atomically. Raises OSError when it cannot be written.
    """
    fast = {"movflags": "faststart"}
    with whole(path) as draft, av.open(str(draft), "w", format="mp4", options=fast) as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT * len(episodes), "yuv420p"
        stream.options = {"crf": "23", "preset": "veryfast"}
        for picture in _pictures(episodes, follow, RATE, progress):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def animation(
    episodes: Sequence[ReplayData], path: Path, *, follow: str | None = None, progress: Progress | None = None
) -> None:
    """Write a small GIF for a page or a slide: roads and outcomes without explanations, twice as fast.

    `follow`, the file and errors as in `film`.
    """
    first, *rest = (
        Image.fromarray(picture).quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        for picture in _pictures(episodes, follow, 1.0 / STEP, progress, small=True)
    )
    times = round(1000 * SHOWN)  # ms
    with whole(path) as draft:
        first.save(draft, "GIF", save_all=True, append_images=rest, duration=times, loop=0)


def _pictures(
    episodes: Sequence[ReplayData],
    follow: str | None,
    rate: float,
    progress: Progress | None,
    *,
    small: bool = False,
) -> Iterator[npt.NDArray[np.uint8]]:
    """`rate` pictures [height,width,3] a second, all episodes one above the other.

    Episodes that ended earlier show their last picture.
    """
    cameras = [_Camera(r, follow) for r in episodes]
    count = round(rate * max(float(r.times[-1] - r.times[0]) for r in episodes)) + 1
    for k in range(count):
        times = [min(float(r.times[0]) + k / rate, float(r.times[-1])) for r in episodes]
        shots = zip(episodes, times, cameras, strict=True)
        yield np.vstack([np.asarray(picture_at(*shot, small=small)) for shot in shots])
        if progress is not None:
            progress(k + 1, count)


class _Camera:
    """The camera: the followed vehicle, and the view while that vehicle is off the road."""

    def __init__(self, replay: ReplayData, follow: str | None) -> None:
        def rank(t: Track) -> tuple[bool, bool, bool, int]:
            return t.id != follow, not t.mission, t.kind != Kind.AV, t.first

        self.lines = stop_lines(replay.road)
        self.follow = min(replay.tracks, key=rank, default=None)
        self.any_av = self.follow is not None and self.follow.kind == Kind.AV and self.follow.id != follow
        self.x = self.y = 0.0  # m, the middle of the picture
        if self.follow is not None:
            self.x, self.y = float(self.follow.x[0]), float(self.follow.y[0])

    def look(self, poses: list[Pose]) -> Pose | None:
        """Move to the followed vehicle; returns the AV whose decision is shown: itself, else the nearest AV.

        If the followed AV was not requested and has left the road, the camera follows the nearest AV.
        """
        here = next((p for p in poses if self.follow and p.track.id == self.follow.id), None)
        if here is not None:
            self.x, self.y = here.x, here.y
            if here.track.kind == Kind.AV:
                return here
        avs = [p for p in poses if p.track.kind == Kind.AV]
        nearest = min(avs, key=lambda p: math.hypot(p.x - self.x, p.y - self.y), default=None)
        if here is None and nearest is not None and self.any_av:
            self.follow, self.x, self.y = nearest.track, nearest.x, nearest.y
        return nearest


def picture_at(r: ReplayData, time: float, camera: _Camera, *, small: bool = False) -> Image.Image:
    """One picture: of the film, WIDTH x HEIGHT, or the `small` one of the GIF, SMALL x (LOW + CAPTION)."""
    poses = poses_at(r, time)
    shown = camera.look(poses)
    strip = Strip(camera.x, camera.y, *((SMALL, LOW) if small else (WIDTH, HEIGHT - PANEL)))
    strip.road(r)
    strip.signs(r, camera.lines, time)
    k = int(np.searchsorted(r.decided, time + 1e-6, side="right")) - 1
    choices: Mapping[str, Choice] = r.choices[k] if 0 <= k < len(r.choices) else {}
    by_name = {p.track.id: p for p in poses}
    if not small:
        strip.forecast(r, k)
    near = [p for p in poses if strip.sees(np.array([[p.x, p.y]]))]
    for pose in near:
        strip.vehicle(pose)
    under_way = [e for e in r.errors if e.time <= time + 0.05 and e.until > time - 0.05]
    error_of = {e.who: (e.kind.replace("_", " "),) for e in under_way}
    for pose in () if small else near:
        if pose.track.id in choices:
            strip.choice(pose, choices[pose.track.id], by_name)
        named = [pose.track.id] if pose.track.mission or pose is shown else []
        if words := ": ".join([*named, *error_of.get(pose.track.id, ())]):
            strip.name(pose, words, ERROR if pose.track.id in error_of else TEXT)
    seen = {p.track.id for p in near}
    for one in r.offences:
        if one.vehicle in seen and 0.0 <= time - one.time + 0.05 < SHOWN_EVENT:
            strip.broken(by_name[one.vehicle], one.what)
    for correction in () if small else r.interventions:
        if correction.vehicle in seen and 0.0 <= time - correction.time + 0.05 < SHOWN_EVENT:
            strip.corrected(by_name[correction.vehicle])
    for error in under_way:
        if error.who in seen:
            strip.driver_error(by_name[error.who], by_name.get(error.near))
    for crash in r.collisions:
        if math.isfinite(crash.x) and 0.0 <= time - crash.time + 0.05 < SHOWN_CRASH:
            strip.crash(crash.x, crash.y)
    board = _Board(strip.finished(), CAPTION if small else PANEL)
    board.legend(r)
    if small:
        board.caption(r, time)
    else:
        board.panel(r, time, camera, by_name, shown, choices)
    return board.picture


class _Board:
    """The whole picture: the strip above, `beneath` pixels of words below."""

    def __init__(self, strip: Image.Image, beneath: int) -> None:
        self.picture = Image.new("RGB", (strip.width, strip.height + beneath), (255, 255, 255))
        self.picture.paste(strip, (0, 0))
        self._line_top = strip.height
        self._pen = ImageDraw.Draw(self.picture)

    def legend(self, r: ReplayData) -> None:
        """The legend of colours and shapes, at the top."""
        mission = "mission vehicle" + ", guessed" * bool(r.facts.get("mission_guessed"))
        cars = {mission if t.mission else _driver(t): (Actor.CAR, colour_of(t)) for t in r.tracks}
        cars.pop("", None)  # of persons
        others = sorted({t.actor for t in r.tracks} - {Actor.CAR})
        shapes = {NAMES[a]: (a, PERSON if a == Actor.PERSON else OTHER) for a in others}
        entries = {**dict(sorted(cars.items())), **shapes}
        x, y = 14.0, 8.0
        for name, (actor, colour) in entries.items():
            wide = 40 + self._pen.textlength(name, font(12))
            if x + wide > self.picture.width:
                x, y = 14.0, y + 18.0
            self.picture.paste(icon(actor, colour), (round(x), round(y) + 2))
            self._line(x + 23, y, name, TEXT, 12)
            x += wide

    def caption(self, r: ReplayData, time: float) -> None:
        """One line: policy, outcome, time."""
        top = self._line_top + 4
        policy = str(r.facts.get("policy"))
        self._line(14, top, policy, TEXT, 13, bold=True)
        outcome, colour = _outcome(r, time)
        self._line(28 + self._pen.textlength(policy, font(13, True)), top, outcome, colour)
        clock = f"{time - r.begin:.1f} s"
        self._line(self.picture.width - 14 - self._pen.textlength(clock, font(13)), top, clock, QUIET)

    def panel(
        self,
        r: ReplayData,
        time: float,
        camera: _Camera,
        here: Mapping[str, Pose],
        shown: Pose | None,
        choices: Mapping[str, Choice],
    ) -> None:
        """The episode, the followed vehicle, and one AV's decision, as on the page."""
        f, line = r.facts, self._line_top
        label = f" ({f['policy_label']})" if f.get("policy_label") else ""
        title = f"{f.get('scenario')} / {f.get('demand')} / {f.get('policy')}{label}"
        self._wrapped(14, line + 8, title, TEXT, SPLIT - 24, most=1, bold=True)
        self._line(
            14, line + 30, f"seed {f.get('seed')}, {f.get('preset')}, svo {f.get('svo_deg'):g}°", QUIET
        )
        self._line(14, line + 50, f"{time - r.begin:.1f} s of {r.times[-1] - r.begin:.0f} s", TEXT, 14)
        outcome, colour = _outcome(r, time)
        self._wrapped(14, line + 72, outcome, colour, SPLIT - 24)
        broken = [one for one in r.offences if one.time <= time + 0.05]
        corrections = [one for one in r.interventions if one.time <= time + 0.05]
        errors = [one for one in r.errors if r.begin < one.time <= time + 0.05]
        if t := camera.follow:
            what = _kind(t) + ", mission vehicle" * t.mission
            where = f"{here[t.id].speed:.1f} m/s" if t.id in here else "not on the road"
            self._wrapped(14, line + 104, f"{t.id} ({what}): {where}", colour_of(t), SPLIT - 24, most=1)
        counts = {
            f"{len(broken)} violations": LAW if broken else None,
            f"{len(corrections)} corrections of AVs": CORRECTION if corrections else None,
            f"{len(errors)} human errors": ERROR if errors else None,
        }
        if said := {text: colour for text, colour in counts.items() if colour}:
            self._line(14, line + 121, f"{', '.join(said)} so far", next(iter(said.values())), 12)
        if shown is not None:
            mine = [one for one in corrections if one.vehicle == shown.track.id]
            reason = mine[-1].reason if mine and time - mine[-1].time < SHOWN_EVENT else None
            self._decision(SPLIT, line, shown, choices.get(shown.track.id), reason)

    def _decision(self, left: float, top: float, av_: Pose, c: Choice | None, corrected: str | None) -> None:
        """The command of one AV and its reasons; `corrected`: the reason of the car's intervention."""
        name = f"{av_.track.id}, {av_.speed:.1f} m/s: "
        room = self.picture.width - 14 - left
        why = f"corrected by the car: {corrected}"
        if c is None:
            self._line(left, top + 8, f"{name}driven by SUMO, no command", AV, 14)
            if corrected:
                self._wrapped(left, top + 28, why, CORRECTION, room)
            return
        d = c.decision
        self._line(left, top + 8, f"{name}{ACTIONS[d.action]}, target {c.target:.0f} m/s", AV, 14, bold=True)
        said = {
            f"preferred action vetoed, blamed {d.blamed}": WARN if d.vetoed else None,
            "no action safe": BAD if d.fallback else None,
            f"command blocked: {c.blocked}": BAD if c.blocked else None,
            why: CORRECTION if corrected else None,
        }
        words = {text: shade for text, shade in said.items() if shade} or {"command executed": QUIET}
        top += 16 * (self._wrapped(left, top + 28, "; ".join(words), [*words.values()][-1], room) - 1)
        named = (("Q", d.q), ("score s", d.safety_score), ("TTC s", d.ttc))
        rows = [(name, values) for name, values in named if values is not None]
        for a in MetaAction if rows else ():
            x = left + 90 + 132 * int(a)
            unsafe = d.unsafe is not None and bool(d.unsafe[a])
            colour = AV if a == d.action else BAD if unsafe else TEXT
            self._line(x, top + 50, ACTIONS[a], colour, 13, bold=a == d.action)
            for k, (_, values) in enumerate(rows):
                self._line(x, top + 67 + 17 * k, f"{values[a]:.2f}", BAD if unsafe else TEXT, 13)
        for k, (row, _) in enumerate(rows):
            self._line(left, top + 67 + 17 * k, row, QUIET, 13)

    def _wrapped(
        self, x: float, y: float, text: str, colour: Colour, room: float, *, most: int = 2, bold: bool = False
    ) -> int:
        """Write text within `room` pixels on at most `most` lines, cut with dots; returns their number."""
        lines, letters = [""], font(13, bold)
        for word in text.split():
            longer = f"{lines[-1]} {word}".strip()
            if self._pen.textlength(longer, letters) <= room:
                lines[-1] = longer
            else:
                lines.append(word)
        lines = [line for line in lines if line]
        shown = lines[:most]
        if shown and (len(lines) > most or self._pen.textlength(shown[-1], letters) > room):
            while shown[-1] and self._pen.textlength(f"{shown[-1]} ...", letters) > room:
                shown[-1] = shown[-1][:-1]
            shown[-1] += " ..."
        for k, line in enumerate(shown):
            self._line(x, y + 16 * k, line, colour, bold=bold)
        return max(len(shown), 1)

    def _line(
        self, x: float, y: float, text: str, colour: Colour, size: int = 13, *, bold: bool = False
    ) -> None:
        self._pen.text((x, y), text, fill=colour, font=font(size, bold))


def _driver(t: Track) -> str:
    """The driver in words; "" without one."""
    return "AV" if t.kind == Kind.AV else "" if t.kind == Kind.PERSON else f"human, {t.driver}"


def _kind(t: Track) -> str:
    parts = [_driver(t), NAMES[t.actor] if t.actor != Actor.CAR else ""]
    return ", ".join(filter(None, parts))


def _outcome(r: ReplayData, time: float) -> tuple[str, Colour]:
    """The events so far, in a few words."""
    crashes = [c for c in r.collisions if c.time <= time + 0.05]
    if crashes:
        return f"collision: {crashes[-1].collider} hit {crashes[-1].victim}", BAD
    fulfilled = r.facts.get("mission_time_s")
    if fulfilled is not None and time - r.begin >= fulfilled - 0.05:
        return f"mission fulfilled at {fulfilled:.1f} s", GOOD
    if r.facts.get("mission_success") is None:
        return "no collision so far", QUIET
    return f"no collision, mission not fulfilled{' yet' if time < r.times[-1] - 0.05 else ''}", QUIET
