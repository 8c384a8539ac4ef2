"""Unpacking of an uploaded zip file: regular files with plain names, with size limits while writing."""

import gzip
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from cosim.errors import BadInput
from cosim.files.xml_input import GZIP_MAGIC
from cosim.service.settings import MB, Limits

CHUNK = 1 << 18  # bytes
MAX_NAME, MAX_PARTS = 200, 8  # characters and parts of a name
_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1  # a bit of an entry's flags
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,
    UnicodeError,
    ValueError,
    struct.error,
)


def unpack(archive: Path, folder: Path, suffixes: tuple[str, ...], limits: Limits) -> list[Path]:
    """Write the files of `archive` below `folder`, which exists and is empty; returns their sorted paths.

    Names must end with one of `suffixes`. The limit of bytes includes the content of gzip files, which are
    recognised by their first bytes, as in SUMO.

    Raises:
        BadInput: not a zip file; a name outside of the folder, a duplicate name or another suffix; links,
            devices, encryption; gzip within gzip; more files, bytes or parts of a name than allowed.
    """
    try:
        with zipfile.ZipFile(archive) as found:
            entries = [entry for entry in found.infolist() if not entry.is_dir()]
            if len(found.infolist()) > limits.files:
                problem = f"{len(found.infolist())} entries are more than {limits.files}"
                raise BadInput(problem, field="archive")
            if sum(entry.file_size for entry in entries) > limits.unpacked:
                raise _too_much(limits)
            names = [_name(entry, suffixes) for entry in entries]
            left = limits.unpacked
            paths = []
            for entry, name in zip(entries, names, strict=True):
                path = folder / name
                if path.exists():
                    raise BadInput("appears twice", field="archive", value=name)
                path.parent.mkdir(parents=True, exist_ok=True)
                with found.open(entry) as source, path.open("xb") as target:
                    for chunk in _counted(source, left, limits):
                        left -= len(chunk)
                        target.write(chunk)
                for chunk in _gzip_content(path, name, left, limits):
                    left -= len(chunk)
                paths.append(path)
            return sorted(paths)
    except _BROKEN as error:
        raise BadInput(f"is not a readable zip file: {error}", field="archive") from None
    except OSError as error:
        raise BadInput(f"cannot be unpacked: {error.strerror or error}", field="archive") from None


def _name(entry: zipfile.ZipInfo, suffixes: tuple[str, ...]) -> str:
    """The checked name of an entry. Raises BadInput for an entry that must not be unpacked."""
    name = entry.filename
    path = PurePosixPath(name)
    mode = entry.external_attr >> 16
    problem = ""
    if len(name) > MAX_NAME or len(path.parts) > MAX_PARTS:
        problem = f"a name has at most {MAX_NAME} characters and {MAX_PARTS} parts"
    elif not name.isprintable() or "\\" in name or ":" in name or "\0" in entry.orig_filename:
        problem = "a name must not contain this"
    elif path.is_absolute() or ".." in path.parts or str(path) != name or name.startswith("."):
        problem = "a name must lead below the archive's own folder"
    elif stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        problem = "is not a regular file"
    elif entry.flag_bits & _ENCRYPTED:
        problem = "is encrypted"
    elif entry.compress_type not in _PLAIN:
        problem = "is neither stored nor deflated"
    elif not name.endswith(suffixes):
        problem = f"is not one of {', '.join(suffixes)}"
    if problem:
        raise BadInput(problem, field="archive", value=name[:MAX_NAME])
    return name


def _counted(source: IO[bytes] | gzip.GzipFile, most: int, limits: Limits) -> Iterator[bytes]:
    """Read with a limit. Raises BadInput beyond `most` bytes, regardless of sizes declared in the archive."""
    total = 0
    while chunk := source.read(CHUNK):
        total += len(chunk)
        if total > most:
            raise _too_much(limits)
        yield chunk


def _gzip_content(path: Path, name: str, most: int, limits: Limits) -> Iterator[bytes]:
    """The content of a gzip file; empty for another file."""
    with path.open("rb") as raw:
        if raw.read(len(GZIP_MAGIC)) != GZIP_MAGIC:
            return
        raw.seek(0)
        try:
            with gzip.GzipFile(fileobj=raw) as packed:
                if packed.peek(len(GZIP_MAGIC)).startswith(GZIP_MAGIC):
                    raise BadInput("is a gzip file in a gzip file", field="archive", value=name)
                yield from _counted(packed, most, limits)
        except (OSError, EOFError, zlib.error) as error:
            raise BadInput(f"broken gzip file: {error}", field="archive", value=name) from None


def _too_much(limits: Limits) -> BadInput:
    return BadInput(f"unpacks to more than {limits.unpacked // MB} MB", field="archive")
