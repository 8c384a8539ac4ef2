"""The folder of a run: created, locked and checked for disk space before the first episode."""

import contextlib
import os
from contextlib import AbstractContextManager
from pathlib import Path

from cosim.batch.store import FILE
from cosim.errors import BadInput
from cosim.files import cannot, lock

EPISODE_BYTES = 32_000  # 6 kB in the store, 2 kB exported, and the store's log beside it
MIN_BYTES = 4_000_000  # bytes
RESULTS = (FILE, "episodes.parquet", "episodes.csv", "summary.json", "manifest.json")


class RunFolder(contextlib.AbstractContextManager["RunFolder"]):
    """Holds the lock on a run folder until `close`.

    Raises:
        BadInput: the folder cannot be created or written, has no space for `episodes`, is in use by another
            process, or holds results already (without `resume`). A created folder is removed again.
    """

    def __init__(self, path: str, *, resume: bool, episodes: int) -> None:
        self.path = Path(path).absolute()
        self._shown = path
        self._lock: int | None = None
        self._made = self._make()
        try:
            self._lock = lock(self.path, "--out", path)
            held = [name for name in RESULTS if (self.path / name).exists()]
            if held and not resume:
                problem = f"holds {held[0]} already: continue with --resume, or name another folder"
                raise BadInput(problem, field="--out", value=path)
            self._check_space(max(episodes * EPISODE_BYTES, MIN_BYTES))
        except BaseException:
            self._remove_made()
            raise

    def undo(self) -> None:
        """Remove what was created, when nothing was run (not after `resume`)."""
        for name in (FILE, f"{FILE}-wal", f"{FILE}-shm"):
            (self.path / name).unlink(missing_ok=True)
        self._remove_made()

    def close(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __exit__(self, *error: object) -> None:
        self.close()

    def _make(self) -> list[Path]:
        """Create the folder; returns the created folders, innermost first."""
        missing: list[Path] = []
        try:
            missing += [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
            with self._cannot("make this folder"):
                self.path.mkdir(parents=True, exist_ok=True)
        except BadInput:
            for made in missing:
                if made.is_dir():
                    made.rmdir()
            raise
        return missing

    def _remove_made(self) -> None:
        self.close()
        for folder in self._made:
            with contextlib.suppress(OSError):  # another process put a file there in the meantime
                folder.rmdir()

    def _check_space(self, size: int) -> None:
        """Check the free space with a temporary file of `size` bytes, the largest size of the results."""
        probe = self.path / ".space.part"
        with self._cannot(f"hold the results ({size / 1e6:.0f} MB at most)"):
            try:
                with probe.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, size)
            finally:
                probe.unlink(missing_ok=True)

    def _cannot(self, doing: str) -> AbstractContextManager[None]:
        return cannot(doing, field="--out", value=self._shown)
