"""Sessions of remote clients: each a simulation in a separate process, closed when idle."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cosim.envs.host import Reply
from cosim.envs.session import Session, StepResult
from cosim.errors import BadInput, SimulationError
from cosim.observation.view import Packer, View
from cosim.policies import make
from cosim.scenario import Scenario
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import label
from cosim.service.clerk import Clerks
from cosim.service.confined import confined_host, room
from cosim.service.ids import ID, new_id
from cosim.service.jobs import now
from cosim.service.limited import limited_host
from cosim.service.live import Live, Viewer
from cosim.service.problems import Conflict, NotFound, Unavailable
from cosim.service.settings import Settings
from cosim.service.warm import Warmth
from cosim.types import COMPACT, ObservationConfig
from cosim.workers.worker import Worker

if TYPE_CHECKING:
    from cosim.service.watch import Scene

NOTHING = Packer().pack({}, None)
TIMEOUT = 120.0  # s without an answer of the simulation
CALLS = 4  # requests of one session at a time
LOOKS = 1.0  # s between looks for idle sessions
log = logging.getLogger("cosim.service")


class Served(Session):
    """A session that can pass on the answers of its process unchanged.

    `passes_on` is set per episode. The server then does not unpack observations, which would take a
    millisecond or two; the client keeps the history.
    """

    reply: Reply
    passes_on = False
    live: Live | None = None  # the viewers

    def reset(self, seed: int | None = None, *, passes_on: bool = False) -> dict[str, View]:
        """As `Session.reset`."""
        self.passes_on = passes_on
        return super().reset(seed)

    def check_observed(self) -> None:
        """Raises Conflict in an episode whose observations are passed on."""
        if self.passes_on:
            raise Conflict("only the client that began this episode gets observations: reset first")

    def _take(self, reply: Reply) -> None:
        self.reply = reply
        super()._take(reply._replace(packed=NOTHING) if self.passes_on else reply)
        if self.live is not None:
            self.live.told(reply.steps == 0)

    # ---- for `Live` ----

    def scene(self) -> Scene | None:
        """The episode for a new viewer; None before the first episode."""
        return self._call("scene") if self.begun else None

    def drawn(self) -> tuple[list[str], str]:
        """The result of the last decision."""
        found: tuple[list[str], str] = self._call("drawn")
        return found

    def explain(self, av: str | None) -> None:
        """Select the AV for attribution; None: no AV."""
        self._call("explain", av)

    def unwatched(self) -> None:
        """Stop observing for viewers."""
        self._call("unwatched")


class Open:
    """One session and its current users."""

    def __init__(
        self,
        request: dict[str, Any],
        session: Served,
        idle: float,
        uploads: Sequence[str],
        end: Callable[[], None],
        took: Callable[[float], None],
    ) -> None:
        self.id, self.created = new_id(), now()
        self.request, self.session, self.idle, self.uploads = request, session, idle, uploads
        self._end, self._took = end, took
        self._lock = threading.Lock()
        self._calls = threading.BoundedSemaphore(CALLS)
        self._used = time.monotonic()
        self.ended = False
        self.live = session.live = Live(session, self._drive, self._reset, self._explain)

    @contextlib.contextmanager
    def asked(self) -> Iterator[Served]:
        """`using` the session for one of at most `CALLS` requests. Raises Unavailable."""
        if not self._calls.acquire(blocking=False):
            raise Unavailable(f"{CALLS} requests of session {self.id} wait already: try again later")
        try:
            with self.using() as session:
                yield session
        finally:
            self._calls.release()

    @contextlib.contextmanager
    def using(self) -> Iterator[Served]:
        """The session, for one request at a time.

        Raises NotFound when the session has ended, Conflict when the simulation failed: a reset restarts it.
        """
        with self._lock:
            if self.ended:
                raise NotFound(f"session {self.id} has ended")
            try:
                yield self.session
            except SimulationError as error:
                raise Conflict(f"the simulation failed, a reset restarts it: {error}") from None
            finally:
                self._used = time.monotonic()

    @property
    def idle_for(self) -> float:
        """s since the last request ended; 0 during a request."""
        return 0.0 if self._lock.locked() else time.monotonic() - self._used

    def act(self, actions: Mapping[str, Any], see: Sequence[str] | None) -> StepResult:
        """Carry out one decision; the caller is `using` the session."""
        began = time.perf_counter()
        result = self.session.act(actions, see=see)
        self._took(time.perf_counter() - began)
        return result

    def close(self, reason: str = "closed") -> None:
        """End the simulation and its process."""
        with self._lock:
            if not self.ended:
                self.ended = True
                self.session.close()
                self._end()
        self.live.end(reason)

    def watch(self, viewer: Viewer) -> None:
        """Add a viewer. Raises NotFound, Conflict."""
        with self.using():
            self.live.join(viewer)

    # ---- driven for viewers ----

    def _drive(self, until: float) -> bool:
        with self.using() as session:
            on = session.begun and not session.over and session.elapsed < until - 1e-6
            if on:
                self.act({}, [])
        return on

    def _explain(self, av: str | None) -> None:
        with self.using() as session:
            session.explain(av)

    def _reset(self, seed: int | None) -> None:
        with self.using() as session:
            session.reset(seed)


class Sessions:
    """The open sessions. `took` is called with the duration of every decision, s."""

    def __init__(
        self, settings: Settings, clerks: Clerks, warmth: Warmth, took: Callable[[float], None]
    ) -> None:
        self._settings, self._clerks, self._warmth, self._took = settings, clerks, warmth, took
        self._open: dict[str, Open] = {}
        self._opening = 0
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._reaper = threading.Thread(target=self._reap, name="cosim-idle-sessions", daemon=True)

    def start(self) -> None:
        """End idle sessions from now on."""
        self._reaper.start()

    def close(self) -> None:
        """End all sessions."""
        self._closed.set()
        for one in [*self._open.values()]:
            self.end(one.id)

    @property
    def number(self) -> int:
        """Number of open sessions."""
        return len(self._open)

    @property
    def watched(self) -> int:
        """Number of pages that watch a session."""
        return sum(one.live.number for one in self.all())

    def open(
        self,
        request: dict[str, Any],
        flags: Mapping[str, Any],
        uploads: Sequence[str],
        *,
        observation: ObservationConfig = COMPACT,
        seed: int | None = None,
        reward: str = "p",
        idle: float | None = None,
    ) -> Open:
        """Open a session. Raises BadInput, Unavailable at the limit of open sessions."""
        limits = self._settings.limits
        with self._lock:
            if len(self._open) + self._opening >= limits.sessions:
                raise Unavailable(f"{limits.sessions} sessions are open: close one first")
            self._opening += 1
        try:
            scenario, case = self._clerks.session(flags, uploads)
            self._warmth.wait()
            found = self._begin(request, scenario, case, uploads, observation, seed, reward, idle)
            self._open[found.id] = found
        except SimulationError as error:
            raise BadInput(f"the simulation cannot begin: {error}", field="scenario") from None
        finally:
            with self._lock:
                self._opening -= 1
        log.info("session opened", extra={"session": found.id, "scenario": scenario.name})
        return found

    def that_uses(self, upload: str) -> str | None:
        """The id of an open session that uses this upload; None without one."""
        return next((one.id for one in self.all() if upload in one.uploads), None)

    def get(self, session: str) -> Open:
        """The open session of this id. Raises NotFound."""
        found = self._open.get(session) if ID.fullmatch(session) else None
        if found is None:
            raise NotFound(f"no session {session!r} is open")
        return found

    def all(self) -> list[Open]:
        """The open sessions, the oldest first."""
        return [*self._open.values()]

    def end(self, session: str, reason: str = "closed") -> None:
        """Close a session. Raises NotFound."""
        one = self.get(session)
        self._open.pop(session, None)
        one.close(reason)
        log.info("session ended", extra={"session": session})

    # ---- inside ----

    def _begin(
        self,
        request: dict[str, Any],
        scenario: Scenario,
        case: EpisodeOptions,
        uploads: Sequence[str],
        observation: ObservationConfig,
        seed: int | None,
        reward: str,
        idle: float | None,
    ) -> Open:
        svo = math.radians(case.svo_deg)
        others = None if label(case.policy) == "idm" else functools.partial(make, case.policy)
        arguments = (scenario, observation, svo, reward, others)
        rooms = contextlib.ExitStack()
        confined = rooms.enter_context(room(self._settings, uploads))

        def connect() -> Worker:
            limits = self._settings.limits
            host = (limited_host, limits) if confined is None else (confined_host, confined)
            return Worker(*host, *arguments, timeout=TIMEOUT, name="cosim-session")

        try:
            session = Served(scenario, connect, seed)
        except BaseException:
            rooms.close()
            raise
        most = self._settings.limits.idle
        return Open(request, session, min(idle or most, most), uploads, rooms.close, self._took)

    def _reap(self) -> None:
        while not self._closed.wait(LOOKS):
            for one in [*self._open.values()]:
                # a session with an open page gets the server's limit
                if one.idle_for > (self._settings.limits.idle if one.live.number else one.idle):
                    log.info("session was idle", extra={"session": one.id, "seconds": one.idle})
                    with contextlib.suppress(NotFound):
                        self.end(one.id, "it was idle")
