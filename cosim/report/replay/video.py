"""The replay as an MP4 or a GIF: a strip of road that follows one vehicle, and what is decided there.

Several episodes (the same seed with other policies, say) are drawn one above the other, each followed by a
camera of its own, at equal times since they began.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from cosim.files import whole
from cosim.recording import Choice
from cosim.recording.watched import Track, Watched
from cosim.report.replay.strip import AV, BAD, TEXT, WARN, Colour, Pose, Strip, colour_of, font, poses_at
from cosim.types import Kind, MetaAction
from cosim.workers.tasks import Progress

WIDTH, HEIGHT = 1280, 400  # pixels
PANEL = 124  # pixels of text beneath the road
RATE = 10  # pictures a second
SMALL, LOW, CAPTION = 800, 112, 24  # pixels: width of a GIF, height of its road and of the line beneath
STEP, SHOWN = 0.4, 0.2  # s from picture to picture of a GIF, and s that each is shown: twice as fast
COLOURS = 64  # of a GIF
SHOWN_CRASH = 4.0  # s that a collision stays marked
QUIET, GOOD = (95, 107, 122), (21, 128, 61)
ACTIONS = {
    MetaAction.LANE_LEFT: "lane left",
    MetaAction.IDLE: "idle",
    MetaAction.LANE_RIGHT: "lane right",
    MetaAction.ACCELERATE: "accelerate",
    MetaAction.DECELERATE: "decelerate",
}


def film(
    episodes: Sequence[Watched], path: Path, *, follow: str | None = None, progress: Progress | None = None
) -> None:
    """Write the MP4. `follow`: a vehicle's id (default: the mission vehicle, else the first AV).

    The file appears whole or not at all. Raises OSError when it cannot be written.
    """
    fast = {"movflags": "faststart"}
    with whole(path) as draft, av.open(str(draft), "w", format="mp4", options=fast) as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT * len(episodes), "yuv420p"
        stream.options = {"crf": "23", "preset": "veryfast"}
        for picture in _pictures(episodes, follow, picture_at, RATE, progress):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def animation(
    episodes: Sequence[Watched], path: Path, *, follow: str | None = None, progress: Progress | None = None
) -> None:
    """Write a small GIF for a page or a slide: roads and outcomes without explanations, twice as fast.

    `follow`, the file and errors as in `film`.
    """
    first, *rest = (
        Image.fromarray(picture).quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        for picture in _pictures(episodes, follow, caption_at, 1.0 / STEP, progress)
    )
    times = round(1000 * SHOWN)  # ms
    with whole(path) as draft:
        first.save(draft, "GIF", save_all=True, append_images=rest, duration=times, loop=0)


def _pictures(
    episodes: Sequence[Watched],
    follow: str | None,
    draw: Callable[[Watched, float, _Camera], Image.Image],
    rate: float,
    progress: Progress | None,
) -> Iterator[npt.NDArray[np.uint8]]:
    """`rate` pictures [height,width,3] a second, all episodes one above the other; those that ended earlier
    stand still."""
    cameras = [_Camera(r, follow) for r in episodes]
    count = round(rate * max(float(r.times[-1] - r.times[0]) for r in episodes)) + 1
    for k in range(count):
        times = [min(float(r.times[0]) + k / rate, float(r.times[-1])) for r in episodes]
        parts = [draw(*shot) for shot in zip(episodes, times, cameras, strict=True)]
        yield np.vstack([np.asarray(part) for part in parts])
        if progress is not None:
            progress(k + 1, count)


class _Camera:
    """Whom the film follows, and where it looks while that vehicle is not on the road."""

    def __init__(self, watched: Watched, follow: str | None) -> None:
        def rank(t: Track) -> tuple[bool, bool, bool]:
            return t.id != follow, not t.mission, t.kind != Kind.AV

        self.follow = min(watched.tracks, key=rank, default=None)
        self.x = self.y = 0.0  # m, the middle of the picture
        if self.follow is not None:
            self.x, self.y = float(self.follow.x[0]), float(self.follow.y[0])

    def look(self, poses: list[Pose]) -> Pose | None:
        """Move to the followed vehicle; the AV whose decision is explained: itself, else the nearest one."""
        name = None if self.follow is None else self.follow.id
        here = next((p for p in poses if p.track.id == name), None)
        if here is not None:
            self.x, self.y = here.x, here.y
            if here.track.kind == Kind.AV:
                return here
        avs = [p for p in poses if p.track.kind == Kind.AV]
        return min(avs, key=lambda p: math.hypot(p.x - self.x, p.y - self.y), default=None)


def picture_at(r: Watched, time: float, camera: _Camera) -> Image.Image:
    """One picture of the film, WIDTH x HEIGHT."""
    poses = poses_at(r, time)
    shown = camera.look(poses)
    strip = Strip(camera.x, camera.y, WIDTH, HEIGHT - PANEL)
    k = int(np.searchsorted(r.decided, time + 1e-6, side="right")) - 1
    choices: Mapping[str, Choice] = r.choices[k] if 0 <= k < len(r.choices) else {}
    strip.road(r)
    strip.forecast(r, k)
    for pose in poses:
        strip.vehicle(pose)
    by_name = {p.track.id: p for p in poses}
    for pose in poses:
        if pose.track.id in choices:
            strip.choice(pose, choices[pose.track.id], by_name)
        if pose.track.mission or pose is shown:
            strip.name(pose)
    _crashes(strip, r, time)
    board = _Board(strip.finished(), PANEL)
    board.legend(r)
    board.panel(r, time, camera, by_name, shown, choices)
    return board.picture


def caption_at(r: Watched, time: float, camera: _Camera) -> Image.Image:
    """One picture of the GIF, SMALL x (LOW + CAPTION)."""
    poses = poses_at(r, time)
    camera.look(poses)
    strip = Strip(camera.x, camera.y, SMALL, LOW)
    strip.road(r)
    for pose in poses:
        strip.vehicle(pose)
    _crashes(strip, r, time)
    board = _Board(strip.finished(), CAPTION)
    board.legend(r)
    board.caption(r, time)
    return board.picture


def _crashes(strip: Strip, r: Watched, time: float) -> None:
    """Marks the collisions of the last seconds."""
    for crash in r.collisions:
        if math.isfinite(crash.x) and 0.0 <= time - crash.time + 0.05 < SHOWN_CRASH:
            strip.crash(crash.x, crash.y)


class _Board:
    """The whole picture: the strip above, `beneath` pixels of words below."""

    def __init__(self, strip: Image.Image, beneath: int) -> None:
        self.picture = Image.new("RGB", (strip.width, strip.height + beneath), (255, 255, 255))
        self.picture.paste(strip, (0, 0))
        self._line_top = strip.height
        self._pen = ImageDraw.Draw(self.picture)

    def legend(self, r: Watched) -> None:
        """Which colour is who, at the top."""
        kinds = {"mission vehicle" if t.mission else _kind(t): colour_of(t) for t in r.tracks}
        x = 14.0
        for name, colour in sorted(kinds.items()):
            self._pen.rounded_rectangle((x, 12, x + 18, 20), 2, fill=colour)
            self._line(x + 23, 8, name, TEXT, 12)
            x += 40 + self._pen.textlength(name, font(12))

    def caption(self, r: Watched, time: float) -> None:
        """One line: who drives, what has come of it, when."""
        top = self._line_top + 4
        policy = str(r.facts.get("policy"))
        self._line(14, top, policy, TEXT, 13, bold=True)
        outcome, colour = _outcome(r, time)
        self._line(28 + self._pen.textlength(policy, font(13, True)), top, outcome, colour)
        clock = f"{time - r.begin:.1f} s"
        self._line(self.picture.width - 14 - self._pen.textlength(clock, font(13)), top, clock, QUIET)

    def panel(
        self,
        r: Watched,
        time: float,
        camera: _Camera,
        here: Mapping[str, Pose],
        shown: Pose | None,
        choices: Mapping[str, Choice],
    ) -> None:
        """What the page says too: the episode, the followed vehicle, and one AV's decision explained."""
        f, line = r.facts, self._line_top
        label = f" ({f['policy_label']})" if f.get("policy_label") else ""
        title = f"{f.get('scenario')} / {f.get('demand')} / {f.get('policy')}{label}"
        self._line(14, line + 8, title, TEXT, 15, bold=True)
        self._line(
            14, line + 30, f"seed {f.get('seed')}, {f.get('preset')}, svo {f.get('svo_deg'):g}°", QUIET
        )
        self._line(14, line + 50, f"{time - r.begin:.1f} s of {r.times[-1] - r.begin:.0f} s", TEXT, 14)
        outcome, colour = _outcome(r, time)
        self._line(14, line + 72, outcome, colour, 14)
        followed = None if camera.follow is None else here.get(camera.follow.id)
        if camera.follow is not None:
            t = camera.follow
            what = _kind(t) + ", mission vehicle" * t.mission
            where = f"{followed.speed:.1f} m/s" if followed is not None else "not on the road"
            self._line(14, line + 96, f"{t.id} ({what}): {where}", colour_of(t), 13)
        if shown is not None:
            self._decision(470, line, shown, choices.get(shown.track.id))

    def _decision(self, left: float, top: float, av_: Pose, c: Choice | None) -> None:
        name = f"{av_.track.id}, {av_.speed:.1f} m/s: "
        if c is None:
            self._line(left, top + 8, f"{name}driven by SUMO, no command", AV, 14)
            return
        d = c.decision
        self._line(left, top + 8, f"{name}{ACTIONS[d.action]}, target {c.target:.0f} m/s", AV, 14, bold=True)
        said = {
            f"preferred action vetoed, blamed {d.blamed}": WARN if d.vetoed else None,
            "no action safe": BAD if d.fallback else None,
            f"command blocked: {c.blocked}": BAD if c.blocked else None,
        }
        words = {text: shade for text, shade in said.items() if shade} or {"command executed": QUIET}
        self._line(left, top + 28, "; ".join(words), [*words.values()][-1], 13)
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

    def _line(
        self, x: float, y: float, text: str, colour: Colour, size: int = 13, *, bold: bool = False
    ) -> None:
        self._pen.text((x, y), text, fill=colour, font=font(size, bold))


def _kind(t: Track) -> str:
    return "AV" if t.kind == Kind.AV else f"human, {t.driver}"


def _outcome(r: Watched, time: float) -> tuple[str, Colour]:
    """What has happened so far, in a few words."""
    crashes = [c for c in r.collisions if c.time <= time + 0.05]
    if crashes:
        return f"collision: {crashes[-1].collider} hit {crashes[-1].victim}", BAD
    served = r.facts.get("mission_time_s")
    if served is not None and time - r.begin >= served - 0.05:
        return f"mission fulfilled at {served:.1f} s", GOOD
    if r.facts.get("mission_success") is None:
        return "no collision so far", QUIET
    return f"no collision, mission not fulfilled{' yet' if time < r.times[-1] - 0.05 else ''}", QUIET
