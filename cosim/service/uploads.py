"""Uploads of users: archives of a scenario or of weights, unpacked with limits, examined, stored."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import stat
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosim.errors import BadInput, CosimError, SimulationCrashed, SimulationTimeout
from cosim.files import whole
from cosim.service.confined import Examiner, room
from cosim.service.ids import ID, new_id
from cosim.service.jobs import now
from cosim.service.problems import NotFound, Unavailable
from cosim.service.processes import Processes
from cosim.service.settings import Limits, Settings

ABOUT = ".json"  # beside the upload's folder
log = logging.getLogger("cosim.service")


@dataclass(frozen=True, slots=True)
class Upload:
    """One upload; `file` is its .sumocfg or its weights, relative to its folder."""

    id: str
    kind: str  # scenario or policy
    name: str
    created: str  # UTC
    file: str
    files: list[str]
    bytes: int  # unpacked
    about: dict[str, Any]  # results of the examination


class Uploads:
    """The stored uploads, a folder each."""

    def __init__(self, settings: Settings, processes: Processes) -> None:
        self._settings, self._processes = settings, processes
        for part in settings.uploads.glob("*.part"):  # of a server that was killed
            shutil.rmtree(part, ignore_errors=True)

    def add(self, archive: Path, kind: str, name: str) -> Upload:
        """Unpack, check and store an archive. Raises BadInput, Unavailable when there are too many."""
        settings, limits = self._settings, self._settings.limits
        if len(self.all()) >= limits.uploads:
            raise Unavailable(f"{limits.uploads} uploads are stored: delete one first")
        upload = new_id()
        part = settings.uploads / f"{upload}.part"
        part.mkdir()
        try:
            with _of_the_archive(part):
                main, about = self._taken(archive, part, kind)
                sizes = _settled(part, limits)
            if main not in sizes:
                raise BadInput("contains no such file", field="archive", value=main)
            found = Upload(
                id=upload,
                kind=kind,
                name=name or Path(main).name,
                created=now(),
                file=main,
                files=[*sizes],
                bytes=sum(sizes.values()),
                about=about,
            )
            text = json.dumps(asdict(found), indent=1) + "\n"
            part.rename(settings.uploads / upload)
            with whole(self._about(upload)) as draft:
                draft.write_text(text)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        log.info("upload taken", extra={"upload": upload, "kind": kind, "files": len(sizes)})
        return found

    def all(self) -> list[Upload]:
        """All uploads, the newest first."""
        found = [self._read(path) for path in self._settings.uploads.glob(f"*{ABOUT}")]
        return sorted(found, key=lambda upload: (upload.created, upload.id), reverse=True)

    def get(self, upload: str) -> Upload:
        """The upload of this id. Raises NotFound."""
        about = self._about(upload)
        if not ID.fullmatch(upload) or not about.is_file():
            raise NotFound(f"no upload {upload!r}")
        return self._read(about)

    def file(self, upload: str, kind: str) -> Path:
        """The .sumocfg (kind scenario) or the weights (kind policy) of an upload. Raises BadInput."""
        try:
            found = self.get(upload)
        except NotFound as error:
            raise BadInput(str(error), field=kind, value=f"upload:{upload}") from None
        if found.kind != kind:
            raise BadInput(f"this upload is a {found.kind}", field=kind, value=f"upload:{upload}")
        return self._settings.uploads / upload / found.file

    def remove(self, upload: str) -> None:
        """Delete an upload and its files. Raises NotFound."""
        self.get(upload)
        self._about(upload).unlink()
        shutil.rmtree(self._settings.uploads / upload, ignore_errors=True)

    # ---- inside ----

    def _taken(self, archive: Path, part: Path, kind: str) -> tuple[str, dict[str, Any]]:
        """Unpack and examine an archive in a confined process; returns its main file and a description.

        Raises BadInput, also if that process crashes or hangs.
        """
        limit = self._settings.limits.check
        with room(self._settings, [archive], part) as confined:
            examiner, files = (Examiner, confined), (str(archive), str(part))
            try:
                main, about = self._processes.ask("cosim-examiner", limit, examiner, "take", *files, kind)
                return str(main), dict(about)
            except SimulationTimeout:
                raise BadInput(f"takes more than {limit:g} s to examine", field="archive") from None
            except SimulationCrashed as error:
                raise BadInput(f"ends the process that reads it: {error}", field="archive") from None
            except BadInput:
                raise
            except CosimError as error:  # an internal error caused by an upload
                log.exception("an upload could not be examined")
                raise BadInput(f"cannot be read: {str(error).splitlines()[-1]}", field="archive") from None

    def _about(self, upload: str) -> Path:
        return self._settings.uploads / f"{upload}{ABOUT}"

    @staticmethod
    def _read(path: Path) -> Upload:
        return Upload(**json.loads(path.read_text("utf-8")))


@contextlib.contextmanager
def _of_the_archive(folder: Path) -> Iterator[None]:
    """Name files in the block's BadInput relative to the archive."""
    try:
        yield
    except BadInput as error:

        def clean(text: object) -> Any:
            return text.replace(f"{folder}/", "") if isinstance(text, str) else text

        raise BadInput(
            clean(error.problem), file=clean(error.file), field=error.field, value=clean(error.value)
        ) from None


def _settled(folder: Path, limits: Limits) -> dict[str, int]:
    """Name -> bytes of every file below `folder`; changes their owner to this process's user.

    Call it after the writing process has ended. Raises BadInput for links, special files, or a size above
    the limit.
    """
    found: dict[str, int] = {}
    for path, folders, names in os.walk(folder, onerror=_raise):
        for name in (*folders, *names):
            one = Path(path, name)
            about = one.lstat()
            if not (stat.S_ISDIR(about.st_mode) or (stat.S_ISREG(about.st_mode) and about.st_nlink == 1)):
                raise BadInput("is not a regular file", field="archive", value=name)
            os.chown(one, os.geteuid(), os.getegid())
            one.chmod(0o755 if name in folders else 0o644)
            if name in names:
                found[str(one.relative_to(folder))] = about.st_size
    os.chown(folder, os.geteuid(), os.getegid())
    if len(found) > limits.files or sum(found.values()) > limits.unpacked:
        raise BadInput("has more files or bytes than were unpacked", field="archive")
    return dict(sorted(found.items()))


def _raise(error: OSError) -> None:
    raise error
