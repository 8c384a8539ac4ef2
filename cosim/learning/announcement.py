"""Messages of a training before its first update: schedule, start of learning, command for the curves."""

import argparse
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path

from cosim.errors import BadInput
from policy.training.curriculum import Drive, DriveResult, VfnTraining
from policy.training.vfn import Actors

LINE_EVERY = 10.0  # s between two lines about the prefill


def announce(title: str, lines: Mapping[str, str]) -> None:
    """`title: ...` with a line for each of `lines` below it, on stderr at once."""
    width = max(map(len, lines))
    said = [title, *(f"  {head:<{width}}  {text}" for head, text in lines.items())]
    print("\n".join(said), file=sys.stderr, flush=True)


def curves(folder: str, log: str) -> str:
    """The command that shows the curves of a training in `folder`, and its file `log`."""
    return f"tensorboard --logdir {folder}  (as lines: {folder}/{log})"


def begun(state: Path, args: argparse.Namespace) -> None:
    """Raises BadInput if the training whose `state` is a file in --out has begun, unless it is continued."""
    if state.exists() and not args.resume:
        raise BadInput("holds a training run already: --resume continues it", field="--out", value=args.out)


def begin(name: str, training: VfnTraining, wanted: int, folder: str) -> None:
    """Announce a training of a value network. `wanted`: decisions before the first update; `folder`: its
    output folder, as written in commands."""
    demands: dict[str, list[str]] = {}
    for lesson in training.lessons:
        demands.setdefault(lesson.scenario, []).append(lesson.demand)
    scenarios = ", ".join(f"{scenario} ({', '.join(found)})" for scenario, found in demands.items())
    drives, judged = training.iterations * training.episodes, len(training.lessons) * training.validation
    waits = f"after {wanted:,} recorded decisions of AVs; the first drive shows how long that takes"
    announce(
        f"train {name}: {training.iterations} iterations of {training.episodes} drives, {drives:,} in all",
        {
            "scenarios": scenarios,
            "learning begins": waits if wanted else "with the first iteration",
            "curves": curves(folder, "log.jsonl"),
            "validation": f"every {training.validate_every} iterations, {judged} drives; "
            "best.safetensors is the best so far",
            "interrupt": f"Ctrl-C; --resume continues, at most {training.save_every} iterations are lost",
        },
    )


class Announced:
    """Actors that report the time left until the first update.

    Args:
        actors: executor of the episodes.
        wanted: recorded decisions of AVs before the first update.
        say: shows a line.
    """

    def __init__(self, actors: Actors, wanted: int, say: Callable[[str], None]) -> None:
        self.recorded = 0  # decisions in the replay buffer
        self._actors, self._wanted, self._say = actors, wanted, say
        self._first: tuple[float, int] | None = None  # end of the first episode, and its recorded decisions
        self._began = time.monotonic()
        self._said = -math.inf
        self._lock = threading.Lock()  # episodes end in separate threads

    def submit(self, drive: Drive) -> Future[DriveResult]:
        """Queue the episode."""
        future = self._actors.submit(drive)
        if drive.record and self.recorded < self._wanted:
            future.add_done_callback(self._ended)
        return future

    def _ended(self, future: "Future[DriveResult]") -> None:
        if future.cancelled() or future.exception() is not None:
            return
        with self._lock:
            now = time.monotonic()
            self.recorded += sum(map(len, future.result().trajectories))
            counted = f"{min(self.recorded, self._wanted):,} of {self._wanted:,} decisions recorded"
            if self.recorded >= self._wanted and self._said < math.inf:
                self._said = math.inf
                self._say(f"{counted}, learning begins")
            elif now - self._said >= LINE_EVERY:
                self._said = now
                self._say(f"{counted}, learning begins in {self._time_left(now)}")
            self._first = self._first or (now, self.recorded)

    def _time_left(self, now: float) -> str:
        """In words. The first episode is excluded, because it starts processes and compiles kernels."""
        since, before = self._first or (self._began, 0)
        speed = (self.recorded - before) / max(now - since, 1e-9)
        if not speed:
            return "an unknown time"
        seconds = (self._wanted - self.recorded) / speed
        words = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"about {words}" if self._first else f"at most {words}"
