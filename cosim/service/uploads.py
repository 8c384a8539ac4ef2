"""What users send: archives of a scenario or of weights, unpacked with limits, examined, kept."""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosim.errors import BadInput, SimulationCrashed, SimulationTimeout
from cosim.files import whole
from cosim.service.archive import unpack
from cosim.service.bundle import check_references, config_of
from cosim.service.confined import Examiner, room
from cosim.service.ids import ID, new_id
from cosim.service.jobs import now
from cosim.service.problems import NotFound, Unavailable
from cosim.service.settings import Settings
from cosim.workers.worker import Worker

SCENARIO, POLICY = KINDS = ("scenario", "policy")
SUFFIXES = {SCENARIO: (".sumocfg", ".xml", ".xml.gz"), POLICY: (".safetensors", ".json")}
EXAMINED_AT_ONCE = 2
ABOUT = ".json"  # beside the upload's folder
log = logging.getLogger("cosim.service")


@dataclass(frozen=True, slots=True)
class Upload:
    """One of them; `file` is its .sumocfg or its weights, below its own folder."""

    id: str
    kind: str  # one of KINDS
    name: str
    created: str  # UTC
    file: str
    files: list[str]
    bytes: int  # unpacked
    about: dict[str, Any]  # what the examination found


class Uploads:
    """Those that the server keeps, a folder each."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._examined = threading.Semaphore(EXAMINED_AT_ONCE)
        for part in settings.uploads.glob("*.part"):  # of a server that was killed
            shutil.rmtree(part, ignore_errors=True)

    def add(self, archive: Path, kind: str, name: str) -> Upload:
        """Unpack, check and keep an archive. Raises BadInput, Unavailable when there are too many."""
        settings, limits = self._settings, self._settings.limits
        if len(self.all()) >= limits.uploads:
            raise Unavailable(f"{limits.uploads} uploads are kept: delete one first")
        upload = new_id()
        part = settings.uploads / f"{upload}.part"
        part.mkdir()
        try:
            files = unpack(archive, part, SUFFIXES[kind], limits)
            with _of_the_archive(part):
                main = config_of(files) if kind == SCENARIO else _weights(files)
                if kind == SCENARIO:
                    check_references(files, part)
                about = self._examine(part, kind, main)
            found = Upload(
                id=upload,
                kind=kind,
                name=name or main.name,
                created=now(),
                file=str(main.relative_to(part)),
                files=[str(file.relative_to(part)) for file in files],
                bytes=sum(file.stat().st_size for file in files),
                about=about,
            )
            part.rename(settings.uploads / upload)
            with whole(self._about(upload)) as draft:
                draft.write_text(json.dumps(asdict(found), indent=1) + "\n")
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        log.info("upload taken", extra={"upload": upload, "kind": kind, "files": len(files)})
        return found

    def all(self) -> list[Upload]:
        """The newest first."""
        found = [self._read(path) for path in self._settings.uploads.glob(f"*{ABOUT}")]
        return sorted(found, key=lambda upload: (upload.created, upload.id), reverse=True)

    def get(self, upload: str) -> Upload:
        """One of them. Raises NotFound."""
        about = self._about(upload)
        if not ID.fullmatch(upload) or not about.is_file():
            raise NotFound(f"no upload {upload!r}")
        return self._read(about)

    def file(self, upload: str, kind: str) -> Path:
        """Its .sumocfg (kind scenario) or its weights (kind policy). Raises BadInput."""
        try:
            found = self.get(upload)
        except NotFound as error:
            raise BadInput(str(error), field=kind, value=f"upload:{upload}") from None
        if found.kind != kind:
            raise BadInput(f"this upload is a {found.kind}", field=kind, value=f"upload:{upload}")
        return self._settings.uploads / upload / found.file

    def remove(self, upload: str) -> None:
        """Forget one and its files. Raises NotFound."""
        self.get(upload)
        self._about(upload).unlink()
        shutil.rmtree(self._settings.uploads / upload, ignore_errors=True)

    # ---- inside ----

    def _examine(self, part: Path, kind: str, main: Path) -> dict[str, Any]:
        """What a confined process finds of it. Raises BadInput, also where that process ends or hangs."""
        limit = self._settings.limits.check
        with self._examined, room(self._settings, [part.name]) as confined:
            try:
                with Worker(Examiner, confined, timeout=limit, name="cosim-examiner") as worker:
                    found: dict[str, Any] = worker.call(kind, str(main))
                    return found
            except SimulationTimeout:
                raise BadInput(f"takes more than {limit:g} s to look at", file=main) from None
            except SimulationCrashed as error:
                raise BadInput(f"ends the process that reads it: {error}", file=main) from None

    def _about(self, upload: str) -> Path:
        return self._settings.uploads / f"{upload}{ABOUT}"

    @staticmethod
    def _read(path: Path) -> Upload:
        return Upload(**json.loads(path.read_text("utf-8")))


@contextlib.contextmanager
def _of_the_archive(folder: Path) -> Iterator[None]:
    """Name files of the block's BadInput as the archive does."""
    try:
        yield
    except BadInput as error:

        def clean(text: object) -> Any:
            return text.replace(f"{folder}/", "") if isinstance(text, str) else text

        raise BadInput(
            clean(error.problem), file=clean(error.file), field=error.field, value=clean(error.value)
        ) from None


def _weights(files: list[Path]) -> Path:
    """The weights, their card beside them."""
    found = [file for file in files if file.suffix == ".safetensors"]
    if len(found) != 1 or files != sorted([found[0], found[0].with_suffix(".json")]):
        raise BadInput("one NAME.safetensors and its card NAME.json are needed, no more", field="archive")
    return found[0]
