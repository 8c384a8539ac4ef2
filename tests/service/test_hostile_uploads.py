"""Archives made to hurt: each is refused by a confined process, and meanwhile the server answers."""

from __future__ import annotations

import functools
import gzip
import io
import stat
import struct
import tarfile
import threading
import time
import zipfile
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import httpx
import pytest

from policy.checkpoint import SHIPPED
from tests.service.postgres import until
from tests.service.servers import Server
from tests.service.test_uploads import (
    CONFIG,
    DEMAND,
    GOOD,
    LAUGHS,
    NESTED,
    NET,
    OUTSIDE,
    archive,
    everything,
    send,
)

ANSWERS = 1.0  # s within which /health answers, whatever is sent
ATTEMPTS = 5
T = TypeVar("T")
NAMES = ("a.xml", "a.rou.xml", "a.xml.gz", "net.net.xml", "run.sumocfg", "b.sumocfg", "far/below/a.add.xml")
TOO_MUCH = "unpacks to more than"


@functools.cache
def packed(megabytes: int, members: int = 1, text: bytes = b"<a/>") -> bytes:
    """A gzip file of so many MB of elements, in so many members."""
    member = []
    pack = zlib.compressobj(9, wbits=31)
    block = text * ((1 << 20) // len(text))
    member = [pack.compress(b"<routes>"), *(pack.compress(block) for _ in range(megabytes // members))]
    return b"".join([*member, pack.flush()]) * members


def with_(name: str, content: bytes) -> bytes:
    """A good scenario, and this."""
    return archive({**GOOD, name: content})


def weights(**files: bytes) -> bytes:
    good = {name: (SHIPPED / f"conv2d-dqn.{name}").read_bytes() for name in ("safetensors", "json")}
    return archive({f"a.{name}": content for name, content in {**good, **files}.items()})


def entry(name: str, mode: int = 0, **changes: int) -> bytes:
    """A good scenario with an entry of this mode."""
    info = zipfile.ZipInfo(name)
    info.external_attr = mode << 16
    for field, value in changes.items():
        setattr(info, field, value)
    return archive({**GOOD, info: b"<a/>"})


def tar(*entries: tarfile.TarInfo, mode: str = "w") -> bytes:
    whole = io.BytesIO()
    with tarfile.open(fileobj=whole, mode=mode) as target:  # type: ignore[call-overload]
        for name, content in GOOD.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            target.addfile(info, io.BytesIO(content))
        for info in entries:
            target.addfile(info)
    return whole.getvalue()


def special(name: str, kind: bytes, to: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.devmajor, info.devminor = kind, to, 1, 3
    return info


def patched(body: bytes, mark: bytes, at: int, value: bytes) -> bytes:
    """Other bytes behind every such mark of a zip file."""
    found = bytearray(body)
    place = found.find(mark)
    while place >= 0:
        found[place + at : place + at + len(value)] = value
        place = found.find(mark, place + 4)
    return bytes(found)


def twice() -> bytes:
    whole = io.BytesIO(archive(GOOD))
    with zipfile.ZipFile(whole, "a") as target, pytest.warns(UserWarning, match="Duplicate name"):
        target.writestr("net.net.xml", NET)
    return whole.getvalue()


def same_bytes() -> bytes:
    """Every entry is the same local file: a bomb that is no bomb file by file."""
    body = archive({f"{k}.xml": b"<a/>" for k in range(3)})
    return patched(body, b"PK\1\2", 42, struct.pack("<I", 0))


LOCAL, CENTRAL, END = b"PK\3\4", b"PK\1\2", b"PK\5\6"
KINDS = {"FIFO": stat.S_IFIFO, "device": stat.S_IFCHR, "disk": stat.S_IFBLK, "socket": stat.S_IFSOCK}
TARS = {
    "plain": (), "link": (special("l.xml", tarfile.SYMTYPE, "/etc/passwd"),),
    "hard link": (special("l.xml", tarfile.LNKTYPE, "../../token"),),
    "device": (special("d.xml", tarfile.CHRTYPE),), "FIFO": (special("f.xml", tarfile.FIFOTYPE),),
    "traversal": (special("../../x.xml", tarfile.REGTYPE),),
    "absolute": (special("/tmp/x.xml", tarfile.REGTYPE),),
}  # fmt: skip
Build = Callable[[], bytes]
CASES: dict[str, tuple[Build, str]] = {
    # gzip is known by its first bytes
    **{f"gzip bomb as {name}": (lambda n=name: with_(n, packed(300)), TOO_MUCH) for name in NAMES},  # type: ignore[misc]
    "gzip bomb of 75 members": (lambda: with_("a.xml", packed(300, 75)), TOO_MUCH),
    "gzip within gzip": (lambda: with_("a.xml.gz", gzip.compress(packed(300))), "gzip file in a gzip"),
    "gzip within gzip as .xml": (lambda: with_("a.xml", gzip.compress(packed(2))), "gzip file in a gzip"),
    "three times": (
        lambda: with_("a.xml", gzip.compress(gzip.compress(packed(300)))),
        "gzip file in a gzip",
    ),
    "one budget for two gzip files": (
        lambda: archive({**GOOD, "a.xml": packed(140), "b.rou.xml": packed(140)}),
        TOO_MUCH,
    ),
    "one budget for gzip and plain": (
        lambda: archive({**GOOD, "a.xml": packed(200), "b.xml": bytes(60 << 20)}),
        TOO_MUCH,
    ),
    "one budget for 190 gzip files": (
        lambda: archive({**GOOD, **{f"{k}.xml": packed(2) for k in range(190)}}),
        TOO_MUCH,
    ),
    "cut gzip": (lambda: with_("a.xml", packed(2)[:-30]), "broken gzip"),
    "cut gzip as .gz": (lambda: with_("a.xml.gz", packed(2)[:-30]), "broken gzip"),
    "gzip head only": (lambda: with_("a.xml", b"\x1f\x8b"), "broken gzip"),
    "gzip with a wrong sum": (lambda: with_("a.xml", packed(2)[:-8] + bytes(8)), "broken gzip"),
    "gzip with an unknown method": (lambda: with_("a.xml", b"\x1f\x8b\x09" + bytes(40)), "broken gzip"),
    "garbage behind gzip": (lambda: with_("a.xml", packed(2) + b"garbage" * 9), "broken gzip"),
    # XML within gzip
    "entities in gzip": (lambda: with_("demand.rou.xml", gzip.compress(LAUGHS)), "entities may not"),
    "external entity in gzip": (lambda: with_("demand.rou.xml", gzip.compress(OUTSIDE)), "entit"),
    "nested tags in gzip": (lambda: with_("run.sumocfg", gzip.compress(NESTED)), "nest deeper"),
    "entities in a file nobody names": (lambda: with_("a.xml", gzip.compress(LAUGHS)), "entities may not"),
    "UTF-16": (lambda: with_("a.xml", "<a/>".encode("utf-16")), "is not UTF-8"),
    "UTF-7": (lambda: with_("a.xml", b"<?xml version='1.0' encoding='utf-7'?><a/>"), "is not UTF-8"),
    "no XML": (lambda: with_("a.xml", b"\0\1\2\3"), "not well-formed"),
    "an archive within": (lambda: with_("a.xml", archive(GOOD)), "is not UTF-8"),
    "bzip2 as .xml": (lambda: with_("a.xml", b"BZh91AY&SY" + bytes(40)), "not well-formed"),
    "xz as .xml": (lambda: with_("a.xml", b"\xfd7zXZ\0" + bytes(40)), "is not UTF-8"),
    # other archives
    **{
        f"tar: {what}": (lambda e=entries: tar(*e), "not a readable zip")  # type: ignore[misc]
        for what, entries in TARS.items()
    },
    "tar.gz": (lambda: tar(mode="w:gz"), "not a readable zip"),
    "tar.xz": (lambda: tar(mode="w:xz"), "not a readable zip"),
    "gzip bomb alone": (lambda: packed(300), "not a readable zip"),
    # zip files that lie
    "a size that is too small": (
        lambda: patched(with_("a.xml", bytes(9 << 20)), CENTRAL, 24, struct.pack("<I", 10)),
        "not a readable zip",
    ),
    "a size that is too large": (
        lambda: patched(archive(GOOD), CENTRAL, 24, struct.pack("<I", 0xFFFFFFF0)),
        TOO_MUCH,
    ),
    "an offset beyond the end": (
        lambda: patched(archive(GOOD), CENTRAL, 42, struct.pack("<I", 0x7FFFFFF0)),
        "not a readable zip",
    ),
    "other names in the heads": (
        lambda: patched(archive(GOOD), LOCAL, 30, b"x"),
        "not a readable zip",
    ),
    "the same bytes under many names": (same_bytes, "not a readable zip"),
    "a wrong sum": (lambda: patched(archive(GOOD), CENTRAL, 16, bytes(4)), "not a readable zip"),
    "no end": (lambda: archive(GOOD)[:-22], "not a readable zip"),
    "an end with 65,535 entries": (
        lambda: patched(archive(GOOD), END, 8, b"\xff" * 8),
        "not a readable zip",
    ),
    "a name there twice": (twice, "appears twice"),
    "a file that is a folder too": (lambda: with_("net.net.xml/a.xml", b"<a/>"), "cannot be unpacked"),
    # entries
    **{
        f"entry: {what}": (lambda m=mode: entry("a.xml", m | 0o666), "not a regular file")  # type: ignore[misc]
        for what, mode in KINDS.items()
    },
    "encrypted": (lambda: patched(archive(GOOD), CENTRAL, 8, b"\1\0"), "is encrypted"),
    "bzip2": (lambda: archive(GOOD, zipfile.ZIP_BZIP2), "is neither stored nor"),
    "lzma": (lambda: archive(GOOD, zipfile.ZIP_LZMA), "is neither stored nor"),
    "a drive": (lambda: with_("c:evil.xml", b"<a/>"), "must not contain"),
    "a line break": (lambda: with_("a\n.xml", b"<a/>"), "must not contain"),
    "a hidden file": (lambda: with_(".a.xml", b"<a/>"), "below the archive's own folder"),
    "dots within": (lambda: with_("a/../../b.xml", b"<a/>"), "below the archive's own folder"),
    "a dot folder": (lambda: with_("./a.xml", b"<a/>"), "below the archive's own folder"),
    "a long name": (lambda: with_("a" * 300 + ".xml", b"<a/>"), "at most 200 characters"),
    "deep folders": (lambda: with_("a/" * 20 + "a.xml", b"<a/>"), "8 parts"),
    "10,000 folders": (lambda: archive({f"{k}/": b"" for k in range(10_000)}), "are more than"),
    "nothing in it": (lambda: archive({}), "one .sumocfg is needed"),
    "a library": (lambda: with_("a.so", b"\x7fELF"), "is not one of"),
    "upper case": (lambda: with_("a.XML", b"<a/>"), "is not one of"),
}
POLICIES: dict[str, tuple[Build, str]] = {
    "weights that are a gzip bomb": (lambda: weights(safetensors=packed(300)), TOO_MUCH),
    "a card that is a gzip bomb": (lambda: weights(json=packed(300)), TOO_MUCH),
    "a card that is gzip": (lambda: weights(json=gzip.compress(b"{}")), ""),
    "a head without end": (lambda: weights(safetensors=b"\xff" * 8 + b"{}"), ""),
    "nested JSON": (lambda: weights(json=b"[" * 100_000), ""),
    "an endless number": (lambda: weights(json=b'{"sha256": 1' + b"0" * 100_000 + b"}"), ""),
    "pickled weights": (lambda: archive({"a.pt": b"\x80\4.", "a.json": b"{}"}), "is not one of"),
}


class Watch:
    """Asks for /health all the time; `worst` is the longest answer in s, `statuses` those of all."""

    def __init__(self, server: Server) -> None:
        self.worst, self.statuses = 0.0, set[int]()
        self._url = f"{server.url}/health"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._ask)

    def _ask(self) -> None:
        with httpx.Client(timeout=60.0) as http:
            while not self._ended.wait(0.05):
                began = time.monotonic()
                self.statuses.add(http.get(self._url).status_code)
                self.worst = max(self.worst, time.monotonic() - began)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()


def healthy(server: Server, work: Callable[[], T]) -> T:
    """What `work` returns; meanwhile /health answers within `ANSWERS` s.

    A stall of the server's comes every time, one of the machine does not.
    """
    for _ in range(ATTEMPTS):
        with Watch(server) as health:
            found = work()
        assert health.statuses == {200}
        if health.worst < ANSWERS:
            return found
    raise AssertionError(f"/health took {health.worst:.1f} s, and more than {ANSWERS} s {ATTEMPTS} times")


def refused(server: Server, body: bytes, says: str, kind: str) -> None:
    data = Path(server.data)
    before = everything(data)
    answer = healthy(server, lambda: send(server, body, kind))
    assert answer.status_code == 422, answer.text
    assert says in answer.json()["problem"]
    assert str(data) not in answer.text
    until(lambda: everything(data) <= before)


@pytest.mark.parametrize("what", CASES)
def test_a_hostile_scenario_is_refused(server: Server, what: str) -> None:
    build, says = CASES[what]
    refused(server, build(), says, "scenario")


@pytest.mark.parametrize("what", POLICIES)
def test_hostile_weights_are_refused(server: Server, what: str) -> None:
    build, says = POLICIES[what]
    refused(server, build(), says, "policy")


def test_many_bombs_at_once_leave_the_server_answering(server: Server) -> None:
    body = archive({**GOOD, **{f"a{k}.xml": packed(300) for k in range(40)}})
    assert len(body) < 1 << 18

    def flood() -> list[int]:
        with ThreadPoolExecutor(30) as sending:
            return [answer.status_code for answer in sending.map(lambda _: send(server, body), range(30))]

    answers = healthy(server, flood)
    assert set(answers) <= {422, 429}
    assert answers.count(422) >= 18


@pytest.mark.soak
def test_gzip_files_within_the_budget_are_driven_whatever_their_names(server: Server) -> None:
    files = {
        "run.sumocfg": CONFIG % (b"3", b""),
        "net.net.xml": gzip.compress(NET),
        "demand.rou.xml": gzip.compress(DEMAND),
    }
    upload = send(server, files).json()
    run = server.submit(scenario=f"upload:{upload['id']}", penetration=0.5)
    assert server.wait(run)["status"] == "finished"
    plain = send(server, GOOD).json()
    other = server.submit(scenario=f"upload:{plain['id']}", penetration=0.5)
    assert server.wait(other)["status"] == "finished"
    assert server.hashes(run) == server.hashes(other)
