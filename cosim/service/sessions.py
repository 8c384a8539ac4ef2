"""Sessions that drivers elsewhere hold open: each a simulation in a process of its own, ended when idle."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from cosim.envs.host import Reply
from cosim.envs.session import Session, StepResult, build_host
from cosim.errors import BadInput, SimulationError
from cosim.observation.view import Packer, View
from cosim.policies import make
from cosim.scenario import Scenario
from cosim.scenario.episode_id import EpisodeId
from cosim.scenario.policy_name import label
from cosim.service.clerk import Clerks
from cosim.service.confined import confined_host, room
from cosim.service.ids import ID, new_id
from cosim.service.jobs import now
from cosim.service.problems import Conflict, NotFound, Unavailable
from cosim.service.settings import Settings
from cosim.types import COMPACT, ObservationConfig
from cosim.workers.worker import Worker

NOTHING = Packer().pack({}, None)
TIMEOUT = 120.0  # s without an answer of the simulation
LOOKS = 1.0  # s between looks for idle sessions
log = logging.getLogger("cosim.service")


class Served(Session):
    """A session whose process's answers can be passed on as they are.

    `passes_on` is set for an episode: then nobody observes here, since what is unpacked here costs a
    millisecond or two and is kept by the other side.
    """

    reply: Reply
    passes_on = False

    def reset(self, seed: int | None = None, *, passes_on: bool = False) -> dict[str, View]:
        """As `Session.reset`."""
        self.passes_on = passes_on
        return super().reset(seed)

    def check_observed(self) -> None:
        """Raises Conflict in an episode whose observations are passed on."""
        if self.passes_on:
            raise Conflict("this episode's observations go to the client that began it: reset first")

    def _take(self, reply: Reply) -> None:
        self.reply = reply
        super()._take(reply._replace(packed=NOTHING) if self.passes_on else reply)


class Open:
    """One session and who holds it."""

    def __init__(
        self,
        request: dict[str, Any],
        session: Served,
        idle: float,
        uploads: Sequence[str],
        end: Callable[[], None],
    ) -> None:
        self.id, self.created = new_id(), now()
        self.request, self.session, self.idle, self.uploads = request, session, idle, uploads
        self._end = end
        self._lock = threading.Lock()
        self._used = time.monotonic()
        self.ended = False

    @contextlib.contextmanager
    def using(self) -> Iterator[Served]:
        """The session, for one request at a time.

        Raises NotFound when it has ended meanwhile, Conflict when the simulation failed: a reset begins anew.
        """
        with self._lock:
            if self.ended:
                raise NotFound(f"session {self.id} has ended")
            try:
                yield self.session
            except SimulationError as error:
                raise Conflict(f"the simulation failed, reset begins anew: {error}") from None
            finally:
                self._used = time.monotonic()

    @property
    def idle_for(self) -> float:
        """s since its last request ended; 0 during one."""
        return 0.0 if self._lock.locked() else time.monotonic() - self._used

    def close(self) -> None:
        """End it: the simulation and its process."""
        with self._lock:
            if not self.ended:
                self.ended = True
                self.session.close()
                self._end()


class Sessions:
    """Those that are open. `took` is told the s of every decision."""

    def __init__(self, settings: Settings, clerks: Clerks, took: Callable[[float], None]) -> None:
        self._settings, self._clerks, self._took = settings, clerks, took
        self._open: dict[str, Open] = {}
        self._opening = 0
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._reaper = threading.Thread(target=self._reap, name="cosim-idle-sessions", daemon=True)

    def start(self) -> None:
        """End idle ones from now on."""
        self._reaper.start()

    def close(self) -> None:
        """End all."""
        self._closed.set()
        for one in [*self._open.values()]:
            self.end(one.id)

    @property
    def number(self) -> int:
        """How many are open."""
        return len(self._open)

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
        """Open one. Raises BadInput, Unavailable when as many are open as the server takes."""
        limits = self._settings.limits
        with self._lock:
            if len(self._open) + self._opening >= limits.sessions:
                raise Unavailable(f"{limits.sessions} sessions are open: close one first")
            self._opening += 1
        try:
            scenario, case = self._clerks.call("session", flags)
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
        """A session that is open on this upload."""
        return next((one.id for one in self.all() if upload in one.uploads), None)

    def get(self, session: str) -> Open:
        """One of them. Raises NotFound."""
        found = self._open.get(session) if ID.fullmatch(session) else None
        if found is None:
            raise NotFound(f"no session {session!r} is open")
        return found

    def all(self) -> list[Open]:
        """Those that are open, the oldest first."""
        return [*self._open.values()]

    def act(self, one: Open, actions: Mapping[str, Any], see: Sequence[str] | None) -> StepResult:
        """One decision of a session that the caller is `using`."""
        began = time.perf_counter()
        result = one.session.act(actions, see=see)
        self._took(time.perf_counter() - began)
        return result

    def end(self, session: str) -> None:
        """Close one. Raises NotFound."""
        one = self.get(session)
        self._open.pop(session, None)
        one.close()
        log.info("session ended", extra={"session": session})

    # ---- inside ----

    def _begin(
        self,
        request: dict[str, Any],
        scenario: Scenario,
        case: EpisodeId,
        uploads: Sequence[str],
        observation: ObservationConfig,
        seed: int | None,
        reward: str,
        idle: float | None,
    ) -> Open:
        svo = math.radians(case.svo_deg)
        others = None if label(case.policy) == "idm" else functools.partial(make, case.policy)
        arguments = (scenario, observation, svo, reward, others, None, ())
        rooms = contextlib.ExitStack()
        confined = rooms.enter_context(room(self._settings, uploads))

        def connect() -> Worker:
            host = (build_host,) if confined is None else (confined_host, confined)
            return Worker(*host, *arguments, timeout=TIMEOUT, name="cosim-session")

        try:
            session = Served(scenario, connect, seed)
        except BaseException:
            rooms.close()
            raise
        most = self._settings.limits.idle
        return Open(request, session, min(idle or most, most), uploads, rooms.close)

    def _reap(self) -> None:
        while not self._closed.wait(LOOKS):
            for one in [*self._open.values()]:
                if one.idle_for > one.idle:
                    log.info("session was idle", extra={"session": one.id, "seconds": one.idle})
                    with contextlib.suppress(NotFound):
                        self.end(one.id)
