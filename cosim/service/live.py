"""Viewers of a session, their messages, and driving on request of their pages.

A page requests driving up to some time, and requests more as its own clock approaches that time. So a page
that pauses, is slow or is gone drives nothing. Programs that drive the session never wait: for a slow page
the oldest unsent steps are dropped.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from cosim.errors import CosimError
from cosim.service.problems import Conflict

if TYPE_CHECKING:
    from cosim.service.watch import Scene

KEPT = 16  # steps buffered for a page
WATCHED = 16  # pages per session


class Stage(Protocol):
    """The watched session. Each method waits until the session is free, and raises CosimError."""

    def scene(self) -> Scene | None: ...  # None: no episode has begun

    def drawn(self) -> tuple[list[str], str]: ...

    def unwatched(self) -> None: ...


class Viewer:
    """One page. `take` returns its messages whenever `wake` is set."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._lock = loop, threading.Lock()
        self.wake = asyncio.Event()
        self.until = 0.0  # s of the episode requested by the page
        self.dropped = 0  # steps
        self.ended = False
        self._steps: deque[str] = deque()
        self._said: list[str] = []
        self._scene: Scene | None = None
        self._lasting: list[str] = []
        self._sent = 0  # of `_lasting`
        self._knows_road = False

    def take(self) -> list[str]:
        """The waiting messages, as JSON."""
        with self._lock:
            found, self._said = self._said, []
            steps, length = [*self._steps], len(self._lasting)
            self._steps.clear()
            add, self._sent = self._lasting[self._sent : length], length
            scene, self._scene = self._scene, None
        parts = []
        if scene is not None:
            parts = [f'"episode":{scene.episode}']
            if not self._knows_road:
                parts.append(f'"road":{scene.road}')
                self._knows_road = True
        if parts or steps or add:
            parts += [f'"add":[{",".join(add)}]', f'"steps":[{",".join(steps)}]']
            found.append(f"{{{','.join(parts)}}}")
        return found

    def begin(self, scene: Scene, lasting: list[str], step: str) -> None:
        """An episode and its newest step; `lasting` grows with it."""
        with self._lock:
            self._scene, self._lasting, self._sent = scene, lasting, 0
            self._steps.clear()
            self._steps.append(step)
        self._call()

    def add(self, step: str) -> None:
        """Add the step of one decision."""
        with self._lock:
            if len(self._steps) >= KEPT:
                self._steps.popleft()
                self.dropped += 1
            self._steps.append(step)
        self._call()

    def say(self, message: str, *, end: bool = False) -> None:
        """Add another message, as JSON; with `end` the last one."""
        with self._lock:
            self._said.append(message)
            self.ended |= end
        self._call()

    def _call(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self.wake.set)
        except RuntimeError:  # the server has ended
            self.ended = True


class Live:
    """The viewers of one session.

    `drive(s)` carries out one decision and returns True, unless the episode is over or has reached `s`;
    `reset(seed)` begins another episode; `explain(av)` selects the AV for attribution.
    """

    def __init__(
        self,
        stage: Stage,
        drive: Callable[[float], bool],
        reset: Callable[[int | None], None],
        explain: Callable[[str | None], None],
    ) -> None:
        self._stage, self._drive, self._reset, self._explain = stage, drive, reset, explain
        self._changed = threading.Condition()
        self._viewers: list[Viewer] = []
        self._scene: Scene | None = None
        self._lasting: list[str] = []
        self._step = ""  # the newest
        self._begin: list[int | None] = []  # requested seeds
        self._explained: list[str | None] = []  # AVs requested for attribution
        self._driver: threading.Thread | None = None
        self.program = False  # whether a program drives the session by requests

    @property
    def number(self) -> int:
        """Number of viewers."""
        return len(self._viewers)

    # ---- in the session's turn ----

    def told(self, begun: bool) -> None:
        """Tell the viewers that a decision was carried out, or that an episode has begun."""
        if not self._viewers:
            if self._scene is not None:
                self._scene = None
                self._stage.unwatched()
        elif begun or self._scene is None:
            self._look()
        else:
            lasting, self._step = self._stage.drawn()
            self._lasting += lasting
            for viewer in [*self._viewers]:
                viewer.add(self._step)

    def join(self, viewer: Viewer) -> None:
        """Add a viewer. Raises Conflict at the limit."""
        if len(self._viewers) >= WATCHED:
            raise Conflict(f"{WATCHED} pages watch this session already")
        self._viewers.append(viewer)
        if self._scene is None:
            self._look()
        else:
            viewer.begin(self._scene, self._lasting, self._step)

    # ---- at any time ----

    def leave(self, viewer: Viewer) -> None:
        """Remove a viewer."""
        with self._changed:
            if viewer in self._viewers:
                self._viewers.remove(viewer)
            self._changed.notify_all()

    def ask(self, viewer: Viewer, until: float) -> None:
        """Drive up to `until` s of the episode."""
        with self._changed:
            viewer.until = until
            self._go()

    def ask_begin(self, seed: int | None) -> None:
        """Begin the episode of `seed`; None: the next seed."""
        with self._changed:
            self._begin.append(seed)
            for viewer in self._viewers:
                viewer.until = 0.0
            self._go()

    def ask_explained(self, av: str | None) -> None:
        """Select the AV for attribution from the next decision on; None: no AV."""
        with self._changed:
            self._explained.append(av)
            self._go()

    def end(self, reason: str) -> None:
        """The session has ended."""
        self.say({"ended": reason}, end=True)
        with self._changed:
            self._viewers.clear()
            self._changed.notify_all()

    def say(self, message: dict[str, str], *, end: bool = False) -> None:
        """Notify all viewers."""
        for viewer in [*self._viewers]:
            viewer.say(json.dumps(message), end=end)

    # ---- inside ----

    def _look(self) -> None:
        self._scene = self._stage.scene()
        if self._scene is not None:
            self._lasting, self._step = [*self._scene.lasting], self._scene.step
            for viewer in [*self._viewers]:
                viewer.begin(self._scene, self._lasting, self._step)

    def _go(self) -> None:
        if self._driver is None:
            self._driver = threading.Thread(target=self._work, name="cosim-live", daemon=True)
            self._driver.start()
        self._changed.notify_all()

    def _work(self) -> None:
        """The thread of a watched session: drive as far as requested."""
        while True:
            with self._changed:
                while self._viewers and not (self._begin or self._explained or self._until):
                    self._changed.wait()
                if not self._viewers:
                    self._driver = None
                    self._begin.clear()
                    self._explained.clear()
                    return
                seed, av, until = self._begin[-1:], self._explained[-1:], self._until
                self._begin.clear()
                self._explained.clear()
            try:
                if av:
                    self._explain(av[0])
                if seed:
                    self._reset(seed[0])
                    continue
                reached = not self._drive(until)
            except CosimError as error:
                reached = True
                self.say({"problem": str(error)})
            if reached:
                with self._changed:
                    for viewer in self._viewers:
                        viewer.until = 0.0 if viewer.until <= until else viewer.until

    @property
    def _until(self) -> float:
        return max((viewer.until for viewer in self._viewers), default=0.0)
