"""The runs of a server: submitted, queued, driven a few at a time, cancelled, resumed, retried."""

from __future__ import annotations

import contextlib
import logging
import re
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

import sumo_scenarios
from cosim.batch import execution
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.estimate import estimate
from cosim.batch.folder import RunFolder
from cosim.batch.matrix import Plan
from cosim.batch.store import FILE, Store
from cosim.errors import BadInput, CosimError
from cosim.scenario.sumo_outputs import DRAFT
from cosim.service.claim import LOOKS, Superseded
from cosim.service.clerk import Clerks
from cosim.service.confined import ConfinedRunner, Room, room
from cosim.service.ids import ID, new_id
from cosim.service.jobs import CANCELLED, FAILED, FINISHED, QUEUED, RUNNING, Job, Jobs, now
from cosim.service.limited import LimitedRunner
from cosim.service.passing import may_pass
from cosim.service.problems import Conflict, NotFound, Unavailable
from cosim.service.settings import Settings
from cosim.workers.engines import Engine, LocalEngine, cores
from cosim.workers.pool import Cancelled, Pool, PoolEngine
from cosim.workers.ray_engine import RayEngine
from cosim.workers.supervisor import Limits as WorkerLimits

ENDING = 10.0  # s for runs to end when the server stops
RETRY = 5.0  # s until an unusable database is tried again, and until the first retry of a run
TRIES = 8  # retries without a new row, each after twice the time, 21 min in all
ACTIVE = 8  # concurrent runs on the processes of this machine
REPORT, SUMMARY = "report.html", "summary.json"
OUTPUTS = "outputs"  # folder of SUMO's output files
T = TypeVar("T")
log = logging.getLogger("cosim.service")


class Drive:
    """One run while it is driven."""

    def __init__(self) -> None:
        self.episodes = self.done = 0
        self.before = 0  # episodes of an earlier server
        self.began = time.monotonic()
        self.cancelled = threading.Event()
        self.left = False  # left to another server, or to the next start
        self.engine: Engine | None = None

    def leave(self) -> None:
        """Stop at once without recording a status."""
        self.left = True
        self.cancel()

    def cancel(self) -> None:
        """End the drive at once."""
        self.cancelled.set()
        if isinstance(self.engine, PoolEngine | RayEngine):
            self.engine.cancel()

    def progress(self, done: int) -> None:
        """`done` of the remaining episodes are driven. Raises Cancelled."""
        self.done = self.before + done
        if self.cancelled.is_set():
            raise Cancelled

    @property
    def running(self) -> dict[str, tuple[float, float]]:
        """Episode -> (simulated s so far, total s); (0, 0) during the start."""
        return dict(self.engine.running) if isinstance(self.engine, PoolEngine) else {}

    @property
    def seconds_left(self) -> float | None:
        """s of wall time at the rate so far; None before the first episode."""
        driven = self.done - self.before
        if not driven:
            return None
        return (time.monotonic() - self.began) / driven * (self.episodes - self.done)


class Waiting:
    """A run that waits for a retry after a transient fault."""

    def __init__(self, tries: int, rows: int) -> None:
        self.tries = tries  # so far, without a new row
        self.rows = rows  # when the last try began
        self.since = time.monotonic()
        self.seconds = RETRY * 2.0 ** (tries - 1)

    @property
    def left(self) -> float:
        """s until the retry."""
        return self.since + self.seconds - time.monotonic()


class Runs:
    """Every run of the server; `count` is called with the number of newly driven episodes.

    Call `start` once. `close` leaves running and waiting runs to the next start, and closes the clerks. No
    run is driven while another server may have claimed the database.
    """

    def __init__(self, settings: Settings, jobs: Jobs, clerks: Clerks, count: Callable[[int], None]) -> None:
        self._settings, self._jobs, self._clerks, self._count = settings, jobs, clerks, count
        self._changed = threading.Condition()
        self._queue: deque[str] = deque()
        self._plans: dict[str, Plan] = {}  # run -> checked plan, while the run waits
        self._waiting: dict[str, Waiting] = {}  # run -> its wait for a retry
        self._drives: dict[str, Drive] = {}
        self._driving = False
        self._closed = False
        self._reporting = threading.Lock()
        self._threads: list[threading.Thread] = []
        self.pool: Pool | None = None
        self._cluster: RayEngine | None = None
        if settings.engine == "local":
            self.pool = Pool(settings.workers)
        else:
            self._cluster = RayEngine(EpisodeRunner)  # raises BadInput if Ray is not installed

    def start(self) -> None:
        """Continue the runs of an earlier server, and accept new runs."""
        works = [(f"cosim-run-{k}", self._work) for k in range(ACTIVE if self.pool else 1)]
        if self._jobs.claim is None:
            self._take_up()
        else:
            works.append(("cosim-claim", self._keep))
        for name, work in works:
            thread = threading.Thread(target=work, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def close(self) -> None:
        """End running episodes. Stored rows stay; the remaining episodes are driven after the next start."""
        with self._changed:
            self._closed = True
            for drive in self._drives.values():
                drive.leave()
            self._changed.notify_all()
        if self.pool is not None:
            self.pool.close()
        self._clerks.close()
        deadline = time.monotonic() + ENDING
        for thread in self._threads:
            thread.join(timeout=max(deadline - time.monotonic(), 0.0))
        if self._cluster is not None:
            self._cluster.disconnect()

    def problem(self) -> str | None:
        """The reason why runs cannot be driven now; None if they can."""
        if ended := sum(not thread.is_alive() for thread in self._threads):
            return f"{ended} of {len(self._threads)} threads have ended"
        if self.pool is not None and (lost := self.pool.workers - self.pool.alive):
            return f"{lost} of {self.pool.workers} processes have no supervisor"
        return None

    # ---- requests of users ----

    def submit(
        self, name: str, request: dict[str, Any], flags: dict[str, Any], uploads: Sequence[str]
    ) -> Job:
        """Check a run and queue it. Raises BadInput, Unavailable when too many wait."""
        self._check_queue()
        plan = self._clerks.plan(flags, uploads)
        run = new_id()
        folder = self.folder(run)
        try:
            with RunFolder(str(folder), resume=False, episodes=plan.episodes), self._store(run) as store:
                execution.begin(plan, store, {"command": "cosim serve", "began": now()})
            with self._changed:
                job = self._jobs.add(run, name, request, uploads, plan.episodes)
                self._plans[run] = plan
                self._queue.append(run)
                self._changed.notify_all()  # all, since not only workers wait
        except BaseException:
            self._forget(run)
            raise
        log.info("run submitted", extra={"run": run, "episodes": plan.episodes})
        return job

    def estimate(self, flags: dict[str, Any], uploads: Sequence[str]) -> dict[str, Any]:
        """The estimated time of a run on an idle server, from short episodes driven now."""
        plan = self._clerks.plan(flags, uploads)
        workers = self.pool.workers if self.pool else self._settings.workers or cores()
        with room(self._settings, uploads) as confined:
            seconds, basis = estimate(plan, self._engine(confined, probes=True), workers)
        return {"cells": len(plan.cells), "episodes": plan.episodes, "estimated_s": seconds, "basis": basis}

    def get(self, run: str) -> Job:
        """One run. Raises NotFound."""
        job = self._jobs.get(run) if ID.fullmatch(run) else None
        if job is None:
            raise NotFound(f"no run {run!r}")
        return job

    def all(self, status: str | None = None) -> list[Job]:
        """Every run (of one status), the newest first."""
        return self._jobs.all(status)

    def compare(self, a: str, b: str, fail_on: Sequence[str], across: Sequence[str]) -> dict[str, Any]:
        """The document of `cosim compare --json`; `a`, `b`: RUN or RUN:POLICY. Raises BadInput."""
        found: dict[str, Any] = self._clerks.call("compare", a, b, list(fail_on), list(across))
        return found

    def that_use(self, upload: str) -> str | None:
        """The id of a waiting or running run that uses this upload; None without one."""
        return next((job.run for job in self._jobs.open() if upload in job.uploads), None)

    def report(self, run: str) -> None:
        """Write the report of a finished run, unless it exists."""
        with self._reporting:  # two at once would write the same draft
            if SUMMARY in self.files(run) and REPORT not in self.files(run):
                self._clerks.call("report", run)

    def drive(self, run: str) -> Drive | None:
        """The progress of an active run."""
        return self._drives.get(run)

    def place(self, run: str) -> int | None:
        """Number of runs ahead in the queue; None if this run does not wait."""
        with self._changed:
            return self._queue.index(run) if run in self._queue else None

    def cancel(self, run: str) -> Job:
        """End a run; its stored rows stay. Raises Conflict when it has ended."""
        self.get(run)
        with self._changed:
            if run in self._queue:
                self._jobs.set(run, status=CANCELLED, ended=now())
                self._queue.remove(run)
                self._plans.pop(run, None)
                self._waiting.pop(run, None)
                return self.get(run)
            drive = self._drives.get(run)
        if drive is None:
            raise Conflict(f"run {run} has ended: it is {self.get(run).status}")
        drive.cancel()
        deadline = time.monotonic() + 10.0
        while run in self._drives and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.get(run)

    def resume(self, run: str) -> Job:
        """Queue a failed or cancelled run, to drive its missing episodes.

        Raises Conflict for a run of another status, Unavailable when too many wait.
        """
        self._check_queue()
        with self._changed:
            self._changed.wait_for(lambda: run not in self._drives, timeout=ENDING)  # until it has ended
            if (status := self.get(run).status) not in (FAILED, CANCELLED):
                raise Conflict(f"run {run} is {status}: only a failed or cancelled run can be resumed")
            self._jobs.set(run, status=QUEUED, error=None, ended=None)
            self._queue.append(run)
            self._changed.notify_all()  # all, since not only workers wait
        log.info("run resumed", extra={"run": run})
        return self.get(run)

    def remove(self, run: str) -> None:
        """Delete a run and its files. Raises Conflict while it waits or is active."""
        job = self.get(run)
        if job.status in (QUEUED, RUNNING):
            raise Conflict(f"run {run} is {job.status}: cancel it first")
        self._jobs.remove(run)
        self._forget(run)

    def rows(self, run: str) -> list[dict[str, Any]]:
        """The rows so far, as `cosim evaluate` keeps them."""
        with self.reading(run), self._store(run) as store:
            return store.rows()

    def files(self, run: str) -> dict[str, Path]:
        """The files of a run by their names: those of `cosim evaluate`, and SUMO's own outputs."""
        with self.reading(run) as folder:
            found = [*folder.glob("*.*"), *(folder / OUTPUTS).glob("*/*.xml")]
        return {
            str(path.relative_to(folder)): path
            for path in sorted(found)
            if path.is_file() and not path.is_symlink() and not path.name.startswith((FILE, "."))
        }

    @contextlib.contextmanager
    def reading(self, run: str) -> Iterator[Path]:
        """The folder of a run, for reading. Raises NotFound, also if the run is removed during the block."""
        self.get(run)
        try:
            yield self.folder(run)
        except (BadInput, OSError, SQLAlchemyError):
            self.get(run)
            raise

    def folder(self, run: str) -> Path:
        """The folder of a run."""
        return self._settings.runs / run

    # ---- inside ----

    def _check_queue(self) -> None:
        if len(self._queue) >= self._settings.limits.queued:
            raise Unavailable(f"{len(self._queue)} runs wait already: try again later")

    def _take_up(self) -> None:
        """Queue the open runs of the database."""
        with self._changed:
            found = [job.run for job in self._jobs.open()]
            for run in found:
                self._jobs.set(run, status=QUEUED)
            self._queue = deque(found)
            self._driving = True
            self._changed.notify_all()
        if found:
            log.info("runs picked up", extra={"runs": len(found)})

    def _keep(self) -> None:
        """A thread: keep the claim on the database, and stop driving without it."""
        claim = self._jobs.claim
        assert claim is not None
        while not self._closed:
            with contextlib.suppress(SQLAlchemyError, Superseded):
                if not claim.keep():
                    self._stand_by()
                elif not self._driving and not self._drives and time.monotonic() >= claim.drives_from:
                    self._take_up()
            with self._changed:
                self._changed.wait_for(lambda: self._closed, timeout=LOOKS)

    def _stand_by(self) -> None:
        """Stop driving, because another server may drive the runs."""
        with self._changed:
            if self._driving:
                log.error("another server may have claimed the database: no run is driven")
            self._driving = False
            for drive in self._drives.values():
                drive.leave()

    def _store(self, run: str) -> Store:
        return Store.in_folder(self.folder(run), self._settings.database)

    def _forget(self, run: str) -> None:
        """Remove a run's rows and files."""
        if self._settings.database is not None:
            with contextlib.suppress(CosimError), self._store(run) as store:
                store.remove()
        gone = self._settings.scratch / run
        with contextlib.suppress(OSError):  # moved first: a concurrent reader creates no new file in it
            self.folder(run).rename(gone)
        shutil.rmtree(gone, ignore_errors=True)

    def _engine(self, confined: Room | None = None, *, probes: bool = False) -> Engine:
        """The engine of one run, or of `probes`; in a room its processes are confined."""
        factory: Callable[..., Any] = LimitedRunner
        arguments: tuple[Any, ...] = (self._settings.limits,)
        if confined is not None:
            factory, arguments = ConfinedRunner, (confined,)
        once = None if confined is None else WorkerLimits(step=60.0, start=120.0, crashes=1)
        if self.pool is not None:
            return self.pool.engine(factory, arguments, limits=once)
        if probes:  # a run may hold every core of the cluster
            return LocalEngine(factory, arguments, workers=1, limits=once)
        workers, address = self._settings.workers, self._settings.ray_address
        return RayEngine(factory, arguments, workers=workers, limits=once, address=address, keep=True)

    def _work(self) -> None:
        """A thread that drives one run after another."""
        while (run := self._next()) is not None:
            drive = self._drives[run]
            try:
                self._run(self._patiently(self.get, run), self._plans.pop(run, None), drive)
            except Superseded:
                log.warning("run left to another server", extra={"run": run})
            except Exception:  # the database did not answer until the shutdown
                log.exception("run lost until the next start", extra={"run": run})
            finally:
                with self._changed:
                    if self._drives.get(run) is drive:
                        del self._drives[run]
                    self._changed.notify_all()

    def _next(self) -> str | None:
        """Wait for the next run and begin its drive; None: the server shuts down."""
        with self._changed:
            while not self._closed:
                left = {run: self._waiting[run].left if run in self._waiting else 0.0 for run in self._queue}
                run = next((run for run in self._queue if left[run] <= 0.0), None) if self._driving else None
                if run is not None:
                    self._queue.remove(run)
                    self._drives[run] = Drive()
                    return run
                self._changed.wait(timeout=min(left.values(), default=None) if self._driving else None)
            return None

    def _run(self, job: Job, plan: Plan | None, drive: Drive) -> None:
        """Drive one run and record its status."""
        run, drive.episodes = job.run, job.episodes
        self._patiently(self._jobs.set, run, status=RUNNING, began=job.began or now(), error=None)
        log.info("run began", extra={"run": run})
        status, error, passes = FINISHED, None, False
        try:
            faults = self._episodes(job, plan, drive)
            if faults:
                status, error, passes = FAILED, "\n".join(faults), True
        except Cancelled:
            status = CANCELLED
        except Exception as problem:
            status, error, passes = FAILED, self._message(run, problem), may_pass(problem)
        if drive.left and status != FINISHED:  # the next start, or another server, continues it
            return
        if passes and self._retry(run, drive, str(error)):
            return
        if passes and drive.cancelled.is_set():
            status, error = CANCELLED, None
        self._waiting.pop(run, None)
        for part in self.folder(run).glob(f"{OUTPUTS}/*/{DRAFT}"):
            shutil.rmtree(part, ignore_errors=True)
        self._patiently(self._jobs.set, run, status=status, error=error, ended=now(), done=drive.done)
        seconds = round(time.monotonic() - drive.began, 3)
        log.info("run ended", extra={"run": run, "status": status, "seconds": seconds})

    def _message(self, run: str, problem: Exception) -> str:
        """The message for users, without internals of the server."""
        if isinstance(problem, BadInput):
            return str(shown(problem, self._settings))
        if isinstance(
            problem, CosimError
        ):  # messages of a store have its URL and a hint for the command line
            text = re.sub(r"\w[\w+]*://\S+?: ", "the database: ", _short(str(problem)))
            return text.replace(" (--resume continues from here)", "")
        log.error("internal error", exc_info=problem, extra={"run": run})
        return f"internal error: {type(problem).__name__}"

    def _retry(self, run: str, drive: Drive, error: str) -> bool:
        """Queue a run again after a fault, each time with a longer delay; False after `TRIES` retries."""
        last = self._waiting.get(run)
        fresh = last is None or drive.before > last.rows
        wait = Waiting(1 if last is None or fresh else last.tries + 1, drive.before)
        if wait.tries > TRIES:
            return False
        log.warning("run waits", extra={"run": run, "error": error, "seconds": wait.seconds})
        said = f"{error} (tried again {wait.seconds:g} s later, {wait.tries} of {TRIES})"
        self._patiently(self._jobs.set, run, status=QUEUED, error=said, done=drive.done)
        with self._changed:
            if drive.cancelled.is_set() and not drive.left:
                return False
            if not drive.left:
                self._waiting[run] = wait
                self._queue.append(run)
            del self._drives[run]
            self._changed.notify_all()
        return True

    def _patiently(self, ask: Callable[..., T], *arguments: Any, **values: Any) -> T:
        """The database's answer, with retries until it answers. Raises SQLAlchemyError during shutdown."""
        while True:
            try:
                return ask(*arguments, **values)
            except SQLAlchemyError as error:
                log.error("the database cannot be used", extra={"error": str(error.__cause__ or error)})
                with self._changed:
                    if self._closed:
                        raise
                    self._changed.wait(timeout=RETRY)

    def _episodes(self, job: Job, plan: Plan | None, drive: Drive) -> list[str]:
        """Drive the missing episodes of a run and write its tables; returns internal errors, a line each."""
        run, folder = job.run, self.folder(job.run)
        if plan is None:
            cases, seeds = execution.asked(folder, self._settings.database)
            plan = self._clerks.plan_again(cases, seeds, job.uploads)
        (folder / OUTPUTS).mkdir(parents=True, exist_ok=True)  # the run may be from another server
        with RunFolder(str(folder), resume=True, episodes=0), self._store(run) as store:
            execution.check_same(plan, store)
            drive.before = drive.done = len(store.keys())

            def progress(done: float, _: float) -> None:
                self._count(drive.before + int(done) - drive.done)
                drive.progress(int(done))

            with room(self._settings, job.uploads, folder / OUTPUTS) as confined:
                drive.engine = self._engine(confined)
                drive.progress(0)
                faults = execution.drive(plan, store, drive.engine, folder / OUTPUTS, progress)
            drive.done = len(store.keys())
        with contextlib.suppress(OSError):
            (folder / OUTPUTS).rmdir()  # if no output was requested
        self._clerks.call("finish", run, plan)
        return [f"{fault.key}: {fault.error}" for fault in faults]


def _short(text: str) -> str:
    """The text; of a traceback only the first and the last line."""
    lines = text.strip().splitlines()
    return text if len(lines) < 3 else f"{lines[0]} {lines[-1]}"


def shown(error: BadInput, settings: Settings) -> BadInput:
    """The error without the server's folders, and with the field's name in requests."""
    ours = (settings.uploads, settings.runs, settings.data, sumo_scenarios.ROOT)

    def clean(text: object) -> Any:
        for folder in ours if isinstance(text, str) else ():
            text = str(text).replace(f"{folder}/", "")
        return text

    field = error.field and error.field.removeprefix("--").replace("-", "_")
    file = None if error.file == "command line" else clean(error.file)
    return BadInput(clean(error.problem), file=file, field=field, value=clean(error.value))
