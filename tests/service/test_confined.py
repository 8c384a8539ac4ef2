"""What a confined process may do, tried from inside; an upload that ends its process is refused."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.batch.matrix import Cell, Plan
from cosim.errors import BadInput, SimulationCrashed
from cosim.scenario import load
from cosim.scenario.options import EpisodeOptions
from cosim.service import clerk, client, uploads
from cosim.service.clerk import Clerks
from cosim.service.confined import Room, allow_processor_time
from cosim.service.processes import Processes
from cosim.service.settings import DataFolder, Limits, Settings
from cosim.service.uploads import Uploads
from cosim.workers.untrusted import untrusted
from cosim.workers.worker import Worker
from tests.service.servers import Server
from tests.service.test_live import drawn, told, watching
from tests.service.test_sessions import drive, same
from tests.service.test_uploads import GOOD, archive, send


class Captive:
    """Tries things in its room."""

    def __init__(self, room: Room) -> None:
        room.enter()

    def refused(self, port: int, outside: str, inside: str) -> dict[str, bool]:
        """What must not be possible -> whether it is refused."""
        secret, own = Path(outside), Path(inside)
        attempts: dict[str, Callable[[], Any]] = {
            "reading": secret.read_bytes,
            "writing": lambda: secret.write_bytes(b"x"),
            "listing": lambda: [*secret.parent.iterdir()],
            "making": lambda: secret.with_name("other").touch(),
            "removing": secret.unlink,
            "a link to read it by": lambda: _through_a_link(own, secret),
            "writing into its upload": lambda: own.joinpath("upload", "new").touch(),
            "connecting": lambda: socket.create_connection(("127.0.0.1", port), timeout=5.0).close(),
            "listening": lambda: socket.create_server(("127.0.0.1", 0)).close(),
            "a program of its own": lambda: _program(own / "room"),
            "ending the server": lambda: os.kill(os.getppid(), signal.SIGUSR1),
        }
        return {name: _fails(attempt) for name, attempt in attempts.items()}

    def spin(self) -> None:
        """For ever."""
        allow_processor_time(1.0)
        while True:
            pass

    def fill(self, folder: str, size: int) -> str:
        """What becomes of a file of so many bytes."""
        try:
            with Path(folder, "big").open("wb") as file:
                for _ in range(0, size, 1 << 20):
                    file.write(bytes(1 << 20))
        except OSError as error:
            return str(error.strerror)
        return "written"

    def hoard(self, size: int) -> str:
        """What becomes of so many bytes of memory."""
        try:
            return str(len(bytearray(size)))
        except MemoryError:
            return "no memory"


def _fails(attempt: Callable[[], Any]) -> bool:
    try:
        attempt()
    except (OSError, subprocess.SubprocessError):
        return True
    return False


def _through_a_link(own: Path, secret: Path) -> None:
    link = own / "room" / "link"
    link.symlink_to(secret)
    link.read_bytes()


def _program(folder: Path) -> None:
    script = folder / "script"
    script.write_text("#!/bin/sh\ntrue\n")
    script.chmod(0o755)
    subprocess.run([str(script)], check=True)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("upload", "room", "scratch", "others"):
        (tmp_path / name).mkdir()
    (tmp_path / "others" / "secret").write_text("of somebody else")
    return tmp_path


def room(place: Path, limits: Limits = Limits()) -> Room:
    return Room(str(place / "scratch"), (str(place / "upload"),), (str(place / "room"),), limits)


def test_a_confined_process_has_no_way_out(place: Path) -> None:
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    try:
        with socket.create_server(("127.0.0.1", 0)) as somebody, Worker(Captive, room(place)) as worker:
            port = somebody.getsockname()[1]
            found = worker.call("refused", port, str(place / "others" / "secret"), str(place))
    finally:
        signal.signal(signal.SIGUSR1, signal.SIG_DFL)
    assert [name for name, refused in found.items() if not refused] == []
    assert (place / "others" / "secret").read_text() == "of somebody else"


def test_processor_time_memory_and_files_are_limited(place: Path) -> None:
    limits = Limits(file=3 << 20, memory=4 << 30)
    with Worker(Captive, room(place, limits)) as worker:
        assert worker.call("fill", str(place / "room"), 8 << 20) == "File too large"
        assert worker.call("hoard", 8 << 30) == "no memory"
        with pytest.raises(SimulationCrashed, match="SIGXCPU"):
            worker.call("spin")


class Killed:
    """An examination that ends its process as a net that kills SUMO does, or that never ends."""

    def __init__(self, room: Room) -> None:
        room.enter()

    def take(self, *_: str) -> None:
        """As the upload wants it."""
        print("Error: the net is broken", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)


class Endless(Killed):
    def take(self, *_: str) -> None:
        signal.pause()


class Babbling(Killed):
    """It says that it goes on, for ever."""

    def take(self, *_: str) -> None:
        message = pickle.dumps(("progress", ()))
        while True:
            for handle in map(int, os.listdir("/proc/self/fd")):
                with contextlib.suppress(OSError):
                    if stat.S_ISSOCK(os.fstat(handle).st_mode):
                        os.write(handle, len(message).to_bytes(4, "big") + message)
            time.sleep(0.1)


@pytest.mark.parametrize(
    ("examiner", "limit", "says"),
    [
        (Killed, 120.0, "ends the process that reads it: .*SIGSEGV.*the net is broken"),
        (Endless, 5.0, "takes more than 5 s"),
        (Babbling, 5.0, "takes more than 5 s"),
    ],
)
def test_an_upload_that_ends_or_stops_its_process_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, examiner: type, limit: float, says: str
) -> None:
    monkeypatch.setattr(uploads, "Examiner", examiner)
    sent = tmp_path / "sent.zip"
    sent.write_bytes(archive(GOOD))
    with DataFolder(str(tmp_path / "data")) as folder:
        kept = Uploads(Settings(folder.path, limits=Limits(check=limit)), Processes())
        with pytest.raises(BadInput, match=says):
            kept.add(sent, "scenario", "")
        assert kept.all() == []
        assert [*(folder.path / "uploads").iterdir(), *(folder.path / "scratch").iterdir()] == []


@untrusted
class Planning:
    """A planner that an upload has taken over."""

    def __init__(self, room: Room) -> None:
        room.enter()

    def plan_again(self, cases: list[EpisodeOptions], _: range) -> Plan:
        """Of something else, without end."""
        other = replace(cases[0], what="/etc/passwd")
        return Plan((Cell(other, load("merge"), {}),), range(10**15))


@untrusted
class Dying(Planning):
    def plan_again(self, *_: object) -> Plan:
        os._exit(7)


@untrusted
class Waiting(Planning):
    def plan_again(self, *_: object) -> Plan:
        signal.pause()
        raise AssertionError


def planned(place: Path, limit: float = 120.0) -> Plan:
    """A plan of two seeds of a case; a check has `limit` s."""
    with DataFolder(str(place / "data")) as folder:
        clerks = Clerks(Settings(folder.path, limits=Limits(check=limit)), Processes())
        try:
            return clerks.plan_again([EpisodeOptions("merge", seed=7)], range(7, 9), ["0" * 12])
        finally:
            clerks.close()


def test_a_plan_is_of_what_was_asked_for_whatever_its_process_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clerk, "confined_planner", Planning)
    plan = planned(tmp_path)
    assert [cell.case.what for cell in plan.cells] == ["merge"]
    assert plan.seeds == range(7, 9)


@pytest.mark.parametrize(
    ("planner", "limit", "says"),
    [(Dying, 120.0, "ends the process that reads it"), (Waiting, 5.0, "takes more than 5 s")],
)
def test_an_upload_that_ends_or_stops_its_planner_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planner: type, limit: float, says: str
) -> None:
    monkeypatch.setattr(clerk, "confined_planner", planner)
    with pytest.raises(BadInput, match=says):
        planned(tmp_path, limit)


def test_a_confined_session_is_an_unconfined_one_to_the_last_bit(server: Server, tmp_path: Path) -> None:
    for name, content in GOOD.items():
        (tmp_path / name).write_bytes(content)
    upload = send(server, GOOD).json()["id"]
    words: dict[str, Any] = {"duration": 4.0, "warmup": 5.0, "penetration": 0.5}
    with (
        client.open(server.url, f"upload:{upload}", **words) as remote,
        cosim.open(str(tmp_path / "run.sumocfg"), **words) as local,
    ):
        assert same(drive(remote, 7)[:-1], drive(local, 7)[:-1])  # the picture names the file


def test_a_confined_session_is_watched_and_explained(server: Server) -> None:
    upload = send(server, GOOD).json()["id"]
    asked = {
        "scenario": f"upload:{upload}",
        "penetration": 0.5,
        "policy": "vfn-p",
        "duration": 4,
        "warmup": 5,
    }
    session = server.http.post("/api/sessions", json=asked).json()["id"]
    with watching(server, session) as socket:
        socket.send(json.dumps({"begin": 140_000}))
        head = told(socket)
        assert head["episode"]["facts"]["seed"] == 140_000
        socket.send(json.dumps({"until": 0.4}))
        lasting, steps = drawn(socket, 0.4)
        vehicles = [row for kind, row in (*head["add"], *lasting) if kind == "vehicles"]
        socket.send(json.dumps({"explain": vehicles[steps[-1]["decided"][1][0][0]][0]}))
        socket.send(json.dumps({"until": 1.6}))
        _, steps = drawn(socket, 1.6)
    assert any(step["decided"][1] for step in steps)
    assert server.http.delete(f"/api/sessions/{session}").status_code == 204


def test_what_an_examination_leaves_is_plain_files_of_the_server_s_own(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir(mode=0o700)
    file = tmp_path / "below" / "a.xml"
    file.write_bytes(b"<a/>")
    file.chmod(0o4000)
    assert uploads._settled(tmp_path, Limits()) == {"below/a.xml": 4}
    assert stat.S_IMODE(file.stat().st_mode) == 0o644
    with pytest.raises(BadInput, match="more files or bytes"):
        uploads._settled(tmp_path, Limits(unpacked=3))
    for leave in (
        lambda path: path.symlink_to("/etc/passwd"),
        lambda path: path.symlink_to("/etc"),
        lambda path: path.hardlink_to(file),
        os.mkfifo,
    ):
        leave(tmp_path / "more.xml")  # type: ignore[no-untyped-call]
        with pytest.raises(BadInput, match="not a regular file"):
            uploads._settled(tmp_path, Limits())
        (tmp_path / "more.xml").unlink()
