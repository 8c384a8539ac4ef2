"""Replays of stored episodes: driven again in a separate process, drawn, stored beside the run's tables."""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from cosim.errors import BadInput, CosimError, SimulationError
from cosim.service.clerk import Clerks
from cosim.service.confined import Drawer, room
from cosim.service.lanes import Lane
from cosim.service.problems import Conflict, NotFound
from cosim.service.processes import Processes
from cosim.service.runs import SUMMARY, Runs
from cosim.service.settings import Settings
from cosim.service.uploads import Uploads
from cosim.service.warm import Warmth

HEARTBEAT = 60.0  # s


class Replays:
    """Draws replays in `lane`; concurrent requests for the same replay share one drawing."""

    def __init__(
        self,
        settings: Settings,
        runs: Runs,
        uploads: Uploads,
        clerks: Clerks,
        warmth: Warmth,
        processes: Processes,
        lane: Lane,
    ) -> None:
        self._settings, self._runs, self._uploads, self._clerks = settings, runs, uploads, clerks
        self._warmth, self._processes, self._lane = warmth, processes, lane
        self._lock = threading.Lock()
        self._asked: dict[tuple[str, str], Future[Path]] = {}

    def ask(self, run: str, episode: str) -> Future[Path]:
        """The page of an episode, named by its key or seed.

        Raises NotFound, Conflict unless the run has finished, Unavailable when too many wait. The future
        raises BadInput if the run has no such episode, or if files, weights or code have changed; Conflict if
        the replay differs from the episode.
        """
        job = self._runs.get(run)
        found = self._runs.files(run)
        if job.status != "finished" or SUMMARY not in found:
            raise Conflict(f"run {run} is {job.status}: it has no replays")
        future: Future[Path]
        if kept := found.get(name(episode)):
            future = Future()
            future.set_result(kept)
            return future
        with self._lock:
            key = run, episode
            if key in self._asked:
                return self._asked[key]
            page = functools.partial(self._page, run, episode, job.uploads)
            future = self._asked[key] = self._lane.begin(page)
        future.add_done_callback(lambda _: self._asked.pop(key, None))
        return future

    def _page(self, run: str, episode: str, uploads: list[str]) -> Path:
        try:
            case, manifest, trace_hash = self._clerks.call("recorded", run, episode)
        except BadInput as error:
            field = "episode" if error.field == "EPISODE" else error.field
            raise BadInput(error.problem, file=error.file, field=field, value=error.value) from None
        page = self._runs.folder(run) / name(case.key)
        if page.is_file():
            return page
        for upload in uploads:
            self._uploads.get(upload)  # raises NotFound for a deleted upload
        with tempfile.TemporaryDirectory(dir=self._settings.scratch) as folder:
            draft = Path(folder) / page.name
            self._draw(uploads, draft, case, manifest, trace_hash)
            with contextlib.suppress(OSError):
                if draft.is_file() and not draft.is_symlink():  # not trusted: from a confined process
                    os.replace(draft, page)
        if page.name not in self._runs.files(run):
            raise NotFound(f"run {run} has been deleted")
        return page

    def _draw(self, uploads: list[str], draft: Path, *episode: Any) -> None:
        """Write the page of an episode; `episode`: the first arguments of `Drawer.page`."""
        settings = self._settings
        self._warmth.wait()
        with (
            room(settings, uploads, draft.parent) as confined,
            self._processes.host(
                Drawer, confined, settings.limits, timeout=HEARTBEAT, start_timeout=2.0 * HEARTBEAT,
                name="cosim-replay",
            ) as worker,
        ):  # fmt: skip
            try:
                worker.call("page", *episode, str(draft), progress=lambda *_: None)
            except SimulationError as error:
                raise Conflict(f"cannot be driven again: {error}") from None
            except BadInput:
                raise
            except CosimError as error:
                if error.exit_code == 1:  # ReplayDiffers
                    raise Conflict(str(error).partition(" (--no-check")[0]) from None
                raise


def name(episode: str) -> str:
    """The file name of an episode's page, by the episode's key."""
    return f"replay-{episode}.html"
