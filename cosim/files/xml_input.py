"""Reads an untrusted XML file safely, as a stream.

SUMO answers a bad file with "Process Error", gigabytes of memory or SIGSEGV (docs/reference/sumo.md).
Therefore every input of SUMO passes through `scan` first. The parser is expat. It refuses entities,
external references, and encodings other than UTF-8 and Latin-1. Depth, token length and unpacked size
are limited; memory does not grow with the file.
"""

import codecs
import gzip
import stat
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO
from xml.parsers import expat

from cosim.errors import BadInput

MAX_DEPTH = 64  # SUMO's own files nest 6 deep; a million nested tags hang SUMO
MAX_TOKEN = 64 << 20  # bytes between two parser events: expat buffers a tag until its end
MAX_UNPACKED = 1 << 30  # bytes from one .gz: a 3 GB bomb costs SUMO 4.2 GB of memory
ENCODINGS = frozenset({"utf-8", "utf8", "us-ascii", "ascii", "iso-8859-1", "latin1"})  # supported by expat
CHUNK = 1 << 18  # bytes

Start = Callable[[str, dict[str, str], int], None]  # tag, attributes, line
End = Callable[[str], None]
Progress = Callable[[float, float], None]  # bytes of the file read, of all

GZIP_MAGIC = b"\x1f\x8b"
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")


def regular_file(path: Path, *, file: object, field: str) -> Path:
    """`path` if it is a readable regular file.

    Raises:
        BadInput: missing, a folder, a FIFO or device (SUMO hangs on these), or not readable; `file` and
            `field` name the origin of the path.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            with path.open("rb"):
                return path
        problem = f"is {'a folder' if stat.S_ISDIR(mode) else 'not a regular file'}, a file is needed"
    except FileNotFoundError:
        problem = "no such file"
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        problem = (getattr(error, "strerror", None) or str(error)).lower()
    raise BadInput(problem, file=file, field=field, value=str(path))


def is_there(path: Path) -> bool:
    """`path.exists()`; False for invalid names (too long, a NUL byte)."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def scan(
    path: Path,
    roots: tuple[str, ...],
    start: Start,
    end: End | None = None,
    *,
    unpacked: float | None = None,
    progress: Progress | None = None,
) -> str:
    """Call `start` for every element (the root included) and `end` when it closes; return the root's tag.

    Plain and gzip files are distinguished by their first bytes, as in SUMO. `roots`: permitted root tags;
    empty for any. `unpacked`: limit for the content of a .gz in bytes (default MAX_UNPACKED).

    Raises:
        BadInput: not readable, not UTF-8, truncated or malformed (with line and column), wrong root,
            entities, external references, too deep, too large.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True
    _refuse_entities(parser, path)
    stack: list[str] = []
    root = ""

    def opened(tag: str, attributes: dict[str, str]) -> None:
        nonlocal root
        root = root or tag
        if not stack and roots and tag not in roots:
            wanted = " or ".join(f"<{name}>" for name in roots)
            raise BadInput(f"wrong root element, {wanted} is needed", file=path, field="root", value=tag)
        stack.append(tag)
        if len(stack) > MAX_DEPTH:
            problem = f"elements nest deeper than {MAX_DEPTH} (line {parser.CurrentLineNumber})"
            raise BadInput(problem, file=path, field="element", value=tag)
        start(tag, attributes, parser.CurrentLineNumber)

    def closed(tag: str) -> None:
        stack.pop()
        if end is not None:
            end(tag)

    parser.StartElementHandler = opened
    parser.EndElementHandler = closed
    fed = 0
    try:
        for chunk in chunks(path, unpacked, progress):
            fed += len(chunk)
            parser.Parse(chunk, False)
            if fed - max(parser.CurrentByteIndex, 0) > MAX_TOKEN:
                problem = f"a single tag or comment is longer than {MAX_TOKEN >> 20} MiB"
                raise BadInput(problem, file=path, field="line", value=parser.CurrentLineNumber)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise _malformed(error, path, fed, stack) from None
    return root


def content(path: Path) -> bytes:
    """The unpacked content of a plain or gzip file; raises BadInput like `scan`."""
    return b"".join(chunks(path))


def chunks(path: Path, unpacked: float | None = None, progress: Progress | None = None) -> Iterator[bytes]:
    """The unpacked bytes of a plain or gzip file."""
    regular_file(path, file=path, field="file")
    most = MAX_UNPACKED if unpacked is None else unpacked
    with path.open("rb") as raw:
        head = raw.read(2)
        raw.seek(0)
        if head in _UTF16_MARKS:
            raise BadInput("is not UTF-8", file=path, field="encoding", value="UTF-16")
        size = path.stat().st_size
        for chunk in iter(lambda: raw.read(CHUNK), b"") if head != GZIP_MAGIC else _unpacked(raw, path, most):
            yield chunk
            if progress is not None:
                progress(raw.tell(), size)


def _unpacked(raw: IO[bytes], path: Path, most: float) -> Iterator[bytes]:
    total = 0
    with gzip.GzipFile(fileobj=raw) as unpacked:
        while True:
            try:
                chunk = unpacked.read(CHUNK)
            except (OSError, EOFError, zlib.error) as error:
                problem = f"broken gzip file ({str(error).rstrip('.').lower()})"
                raise BadInput(problem, file=path, field="gzip byte", value=total) from None
            if not chunk:
                return
            total += len(chunk)
            if total > most:
                problem = f"unpacks to more than {most / 2**20:.0f} MiB"
                raise BadInput(problem, file=path, field="unpacked size", value=total)
            yield chunk


def _refuse_entities(parser: expat.XMLParserType, path: Path) -> None:
    """Refuse entity declarations and external references (billion laughs, file disclosure)."""

    def entity(name: str, *_: object) -> None:
        raise BadInput("entities may not be declared", file=path, field="ENTITY", value=name)

    def doctype(name: str, system: str | None, public: str | None, _internal: bool) -> None:
        if system is not None or public is not None:
            raise BadInput(
                "external references are refused", file=path, field="DOCTYPE", value=system or name
            )

    def external(_context: str, _base: str | None, system: str | None, public: str | None) -> int:
        raise BadInput("external references are refused", file=path, field="entity", value=system or public)

    def declaration(_version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in ENCODINGS:
            raise BadInput("is not UTF-8: save it as UTF-8", file=path, field="encoding", value=encoding)

    parser.EntityDeclHandler = entity
    parser.UnparsedEntityDeclHandler = entity
    parser.ExternalEntityRefHandler = external
    parser.StartDoctypeDeclHandler = doctype
    parser.XmlDeclHandler = declaration


def _malformed(error: expat.ExpatError, path: Path, fed: int, stack: list[str]) -> BadInput:
    """expat's error as a message for users, with line and column."""
    messages = expat.errors.messages
    place = f"line {error.lineno}, column {error.offset + 1}"
    if error.code == expat.errors.codes[expat.errors.XML_ERROR_INVALID_TOKEN]:
        bad = _first_undecodable(path)
        if bad is not None:
            return BadInput(f"is not UTF-8 ({place})", file=path, field="byte", value=bad)
    if fed == 0:
        return BadInput("the file is empty", file=path, field="size", value=0)
    if error.code == expat.errors.codes[expat.errors.XML_ERROR_NO_ELEMENTS] or (
        stack and error.code == expat.errors.codes[expat.errors.XML_ERROR_UNCLOSED_TOKEN]
    ):
        inside = f" inside <{stack[-1]}>" if stack else ""
        return BadInput(f"truncated: the file ends{inside}", file=path, field="line", value=error.lineno)
    problem = f"not well-formed XML: {messages[error.code]} ({place})"
    return BadInput(problem, file=path, field="line", value=error.lineno)


def _first_undecodable(path: Path) -> str | None:
    """The first byte that is not UTF-8, in hexadecimal; None if all are."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        for chunk in chunks(path):
            decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError as error:
        return f"0x{error.object[error.start]:02x}"
    return None
