"""From inside a confined process: token, network, programs, files, other processes; each is refused."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.errors import BadInput, CosimError, SimulationCrashed
from cosim.service import confined, privileges
from cosim.service.confined import Room
from cosim.service.settings import TOKEN, DataFolder, Limits, Settings
from cosim.workers.untrusted import untrusted
from cosim.workers.worker import Worker

SECRET = "s3cret-of-the-server"
MPTCP, RAW_NETLINK = 262, 16
LIBC = ctypes.CDLL(None, use_errno=True)


def call(number: int, *arguments: Any) -> int:
    """A system call; raises OSError."""
    found = int(LIBC.syscall(number, *arguments))
    if found < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return found


def connect(family: int, kind: int, protocol: int, address: Any) -> None:
    with socket.socket(family, kind, protocol) as ours:
        ours.connect(address)


def write_anew(path: Path) -> None:
    with path.open("r+b") as file:
        file.write(b"x")


# number on x86_64, on aarch64
NUMBERS = {
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271), "mount": (165, 40),
    "unshare": (272, 97), "setns": (308, 268), "bpf": (321, 280), "io_uring_setup": (425, 425),
    "keyctl": (250, 219), "pidfd_open": (434, 434), "memfd_create": (319, 279), "userfaultfd": (323, 282),
    "perf_event_open": (298, 241), "open_by_handle_at": (304, 265), "execveat": (322, 281),
    "tkill": (200, 130), "rt_sigqueueinfo": (129, 138), "pivot_root": (155, 41), "kexec_load": (246, 104),
    "seccomp": (317, 277), "chroot": (161, 51),
    "fsopen": (430, 430), "mknodat": (259, 33), "setuid": (105, 146), "fchmodat2": (452, 452),
    "shmget": (29, 194), "msgget": (68, 186), "mq_open": (240, 180), "clone3": (435, 435),
}  # fmt: skip


@untrusted
class Prisoner:
    """Tries things in its room."""

    def __init__(self, room: Room) -> None:
        room.enter()

    def knows(self) -> dict[str, Any]:
        """What it is told."""
        own = Path("/proc/self/environ").read_bytes().decode()
        return {
            "variables": [*os.environ],
            "started with": [entry.partition("=")[0] for entry in own.split("\0") if entry],
            "arguments": sys.argv,
            "descriptors": descriptors(),
            "user": (os.getuid(), os.geteuid(), os.getgroups()),
            "capabilities": privileges._capabilities(),
        }

    def attempts(self, server: int, port: int, unix: str, place: str) -> list[str]:
        """What of all that is refused was possible."""
        own = Path.cwd()
        database, secret, others = (Path(place, n) for n in ("service.sqlite", "token", "others.xml"))
        column = os.uname().machine == "aarch64"
        here = ("127.0.0.1", port)
        tries: dict[str, Callable[[], Any]] = {
            # the server's secrets
            "its environment": Path(f"/proc/{server}/environ").read_bytes,
            "its arguments": Path(f"/proc/{server}/cmdline").read_bytes,
            "its maps": Path(f"/proc/{server}/maps").read_bytes,
            "its memory": Path(f"/proc/{server}/mem").open,
            "its status": Path(f"/proc/{server}/status").read_bytes,
            "its descriptors": lambda: os.listdir(f"/proc/{server}/fd"),
            "its files by its descriptors": lambda: [*Path(f"/proc/{server}/root/etc").iterdir()],
            "the list of processes": lambda: os.listdir("/proc"),
            # the network
            "TCP": lambda: socket.create_connection(here, timeout=5.0),
            "TCP, version 6": lambda: connect(socket.AF_INET6, socket.SOCK_STREAM, 0, ("::1", port)),
            "MPTCP": lambda: connect(socket.AF_INET, socket.SOCK_STREAM, MPTCP, here),
            "UDP": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b"x", here),
            "a Unix socket": lambda: connect(socket.AF_UNIX, socket.SOCK_STREAM, 0, unix),
            "an abstract one": lambda: connect(socket.AF_UNIX, socket.SOCK_STREAM, 0, f"\0{unix}"),
            "netlink": lambda: socket.socket(RAW_NETLINK, socket.SOCK_RAW, 0),
            "packets": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0),
            "VSOCK": lambda: socket.socket(40, socket.SOCK_STREAM, 0),
            "a pair of sockets": socket.socketpair,
            "listening": lambda: socket.create_server(("127.0.0.1", 0)),
            "a name looked up": lambda: socket.getaddrinfo("localhost", 80, type=socket.SOCK_STREAM)[9],
            # programs
            "a shell": lambda: os.execv("/bin/sh", ["sh", "-c", "true"]),
            "Python": lambda: os.execv(sys.executable, [sys.executable, "-c", "pass"]),
            "the dynamic linker": lambda: os.execv("/lib64/ld-linux-x86-64.so.2", ["ld", "/bin/true"]),
            "a program of its own": lambda: os.execv(str(script(own)), ["x"]),
            "a subprocess": lambda: subprocess.run(["/bin/true"], check=True),
            "posix_spawn": lambda: os.posix_spawn("/bin/true", ["true"], {}),
            "os.system": lambda: failed(os.system("true")),
            # processes
            "fork": os.fork,
            "vfork": lambda: call((58, 220)[column], 0x4111, 0, 0, 0, 0),
            "a kill of the server": lambda: os.kill(server, signal.SIGUSR1),
            "a look whether it lives": lambda: os.kill(server, 0),
            "a kill of all": lambda: os.kill(-1, signal.SIGUSR1),
            "a kill of the group": lambda: os.kill(0, signal.SIGCONT),
            "a signal by a descriptor": lambda: fcntl.fcntl(0, fcntl.F_SETOWN, server),
            "the server's limits": lambda: resource.prlimit(server, resource.RLIMIT_NOFILE, (3, 3)),
            "the server's priority": lambda: os.setpriority(os.PRIO_PROCESS, server, 19),
            "the server's cores": lambda: os.sched_setaffinity(server, {0}),
            "its parent's trace": lambda: call((101, 117)[column], 16, server, 0, 0),
            # files
            "reading the token": secret.read_bytes,
            "reading another upload": others.read_bytes,
            "reading the passwords": Path("/etc/shadow").read_bytes,
            "reading the users": Path("/etc/passwd").read_bytes,
            "reading the kernel": Path("/proc/kallsyms").read_bytes,
            "reading a disk": lambda: open_any("/dev/vda", "/dev/sda", "/dev/mem", "/dev/kmsg"),
            "writing the database": lambda: write_anew(database),
            "cutting the database": lambda: os.truncate(database, 0),
            "removing the database": database.unlink,
            "renaming the database": lambda: database.rename(own / "mine"),
            "replacing the database": lambda: script(own).replace(database),
            "linking the database": lambda: os.link(database, own / "link"),
            "a link to it": lambda: os.symlink(database, own / "symlink"),
            "chmod": lambda: database.chmod(0o777),
            "chmod by descriptor": lambda: os.fchmod(os.open(own, os.O_RDONLY), 0o777),
            "setuid on a file of its own": lambda: script(own).chmod(0o4755),
            "chown": lambda: os.chown(database, os.getuid(), os.getgid()),
            "times": lambda: os.utime(database, (0, 0)),
            "attributes": lambda: os.setxattr(database, "user.x", b"x"),
            "making a file beside": lambda: (database.parent / "new").touch(),
            "making a folder beside": lambda: (database.parent / "folder").mkdir(),
            "a FIFO": lambda: os.mkfifo(own / "fifo"),
            "a device": lambda: os.mknod(own / "device", 0o600 | 0o060000, os.makedev(254, 0)),
            "writing into our code": lambda: write_anew(Path(confined.__file__)),
            "writing into shared memory": lambda: Path("/dev/shm/x").touch(),
            "writing where all may": lambda: Path("/tmp/x-of-a-prisoner").touch(),
            "out by ..": lambda: (own / ".." / ".." / ".." / "token").read_bytes(),
            "the terminal": lambda: fcntl.ioctl(0, 0x5412, b"x"),
            "another root": lambda: os.chroot("/"),
            "root again": lambda: os.setresuid(0, 0, 0),
        }
        for name, numbers in NUMBERS.items():
            tries[name] = lambda n=numbers[column]: call(n, 0, 0, 0, 0, 0, 0)
        return [name for name, attempt in tries.items() if possible(attempt)]

    def threads(self) -> int:
        """How many it can have."""
        threading.stack_size(1 << 16)
        stop = threading.Event()
        started = 0
        try:
            while started < 5000:
                threading.Thread(target=stop.wait, daemon=True).start()
                started += 1
        except RuntimeError:
            pass
        stop.set()
        return started

    def fill(self, folder: str) -> None:
        """Write small files for ever."""
        for k in range(10**9):
            Path(folder, str(k)).write_bytes(bytes(1 << 20))
            time.sleep(0.01)

    def answer(self, what: str) -> Any:
        """Something else than plain data."""
        return {"a call": Call(), "code": os.getcwd, "an object of another kind": Counter()}[what]

    def raw(self, message: bytes) -> None:
        """Write into the pipe itself."""
        for handle, what in descriptors().items():
            if what.startswith("socket"):
                os.write(handle, message)
        time.sleep(60.0)

    def works(self) -> float:
        """Threads, matrices and compiled code."""
        import numba
        import numpy
        import torch

        @numba.njit(cache=False)  # type: ignore[untyped-decorator]
        def twice(x: float) -> float:
            return 2.0 * x

        torch.set_num_threads(2)
        square = torch.ones(512, 512) @ torch.ones(512, 512)
        thread = threading.Thread(target=lambda: None)
        thread.start()
        thread.join()
        with mmap.mmap(-1, 4096) as page:
            page.write(b"x")
        return float(twice(numpy.float64(square[0, 0].item())))


class Call:
    """Unpickled, it runs something in the reader's process."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch /tmp/of-a-prisoner",)


def descriptors() -> dict[int, str]:
    """What this process has open."""
    found = {}
    for handle in map(int, os.listdir("/proc/self/fd")):
        with contextlib.suppress(OSError):  # of the list itself
            found[handle] = os.readlink(f"/proc/self/fd/{handle}")
    return found


def script(folder: Path) -> Path:
    path = folder / "script"
    handle = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o755)
    os.write(handle, b"#!/bin/sh\ntrue\n")
    os.close(handle)
    return path


def open_any(*names: str) -> None:
    """Raises OSError: none can be opened."""
    for name in names:
        try:
            os.close(os.open(name, os.O_RDONLY))
        except OSError:
            continue
        return
    raise OSError(errno.EACCES, "none")


def failed(status: int) -> None:
    if status:
        raise OSError(errno.EPERM, "not run")


def possible(attempt: Callable[[], Any]) -> bool:
    try:
        attempt()
    except (OSError, subprocess.SubprocessError):
        return False
    except IndexError:  # of the name that was looked up: it was
        return True
    return True


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("upload", "room", "scratch"):
        (tmp_path / name).mkdir()
    for name in ("service.sqlite", "token", "others.xml"):
        (tmp_path / name).write_text(SECRET)
    return tmp_path


def prison(place: Path, **limits: int) -> Room:
    return Room(str(place / "scratch"), (str(place / "upload"),), (str(place / "room"),), Limits(**limits))


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int, str]]:
    """This process as one: a token, an open port, a Unix socket, an abstract one."""
    monkeypatch.setenv(TOKEN, SECRET)
    monkeypatch.setenv("COSIM_DATABASE", f"postgresql://user:{SECRET}@somewhere/db")
    monkeypatch.setattr(sys, "argv", ["cosim", "serve", "--database", f"postgresql://u:{SECRET}@x/db"])
    unix = f"/tmp/cosim-test-{os.getpid()}"
    before = signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    with (
        socket.create_server(("127.0.0.1", 0)) as tcp,
        socket.socket(socket.AF_UNIX) as named,
        socket.socket(socket.AF_UNIX) as abstract,
    ):
        for one, name in ((named, unix), (abstract, f"\0{unix}")):
            one.bind(name)
            one.listen()
        yield os.getpid(), tcp.getsockname()[1], unix
    os.unlink(unix)
    signal.signal(signal.SIGUSR1, before)


def test_nothing_of_what_leads_out_is_possible(place: Path, server: tuple[int, int, str]) -> None:
    with Worker(Prisoner, prison(place)) as worker:
        known = worker.call("knows")
        assert worker.call("attempts", *server, str(place)) == []
    assert SECRET not in str(known)
    told = {*known["variables"], *known["started with"]}
    assert not told & {TOKEN, "COSIM_DATABASE"}
    assert {name for name in told if "TOKEN" in name or "SECRET" in name or "PASSWORD" in name} == set()
    assert known["arguments"] == [""]
    assert len(known["descriptors"]) <= 7, [*known["descriptors"].values()]
    assert not {fd for fd, what in known["descriptors"].items() if what.startswith("/tmp")} - {1, 2}
    assert 0 not in known["user"][:2]
    assert os.geteuid() != 0 or known["user"] == (privileges.NOBODY, privileges.NOBODY, [])
    assert known["capabilities"] & ~(1 << 2) == 0
    assert all((place / name).read_text() == SECRET for name in ("service.sqlite", "token", "others.xml"))


def test_simulations_and_networks_work_in_it(place: Path) -> None:
    with Worker(Prisoner, prison(place)) as worker:
        assert worker.call("works") == 1024.0


def test_threads_are_limited(place: Path) -> None:
    with Worker(Prisoner, prison(place, tasks=500)) as worker:  # other tests' processes count too
        assert 200 < worker.call("threads") < 800


@pytest.mark.parametrize("limits", [{"disk": 20 << 20}, {"free": 1 << 60}])
def test_whoever_fills_the_disk_is_ended(tmp_path: Path, limits: dict[str, int]) -> None:
    with DataFolder(str(tmp_path / "data")) as folder:
        settings = Settings(folder.path, limits=Limits(**limits))
        wrote = folder.path / "runs"
        with (
            pytest.raises(BadInput, match=r"more than 20 MB|no space left on device"),
            confined.room(settings, ["of somebody"], wrote) as room,
            Worker(Prisoner, room) as worker,
        ):
            worker.call("fill", str(wrote))
        assert sum(file.stat().st_size for file in wrote.iterdir()) < 2 << 30
        assert [*settings.scratch.iterdir()] == []


@pytest.mark.parametrize("what", ["a call", "code", "an object of another kind"])
def test_its_answers_are_plain_data_or_none(place: Path, what: str) -> None:
    with (
        Worker(Prisoner, prison(place)) as worker,
        pytest.raises(SimulationCrashed, match="is not plain data"),
    ):
        worker.call("answer", what)
    assert not Path("/tmp/of-a-prisoner").exists()


@pytest.mark.parametrize(
    "message",
    [
        b"\xff\xff\xff\xff\x7f\xff\xff\xff\xff\xff\xff\xff",  # endless, by its own word
        b"\0\0\0\4abcd",
        *((len(p).to_bytes(4, "big") + p) for p in (pickle.dumps(("error", 3)), pickle.dumps(7))),
    ],
)
def test_a_broken_answer_ends_it(place: Path, message: bytes) -> None:
    with Worker(Prisoner, prison(place)) as worker, pytest.raises(SimulationCrashed, match="not plain data"):
        worker.call("raw", message)


@pytest.mark.parametrize(
    ("what", "found", "says"),
    [
        ("landlock.version", 0, "no Landlock"),
        ("seccomp.available", False, "no seccomp"),
        ("privileges.droppable", False, "root cannot"),
    ],
)
def test_what_cannot_be_confined_is_not_driven(
    place: Path, monkeypatch: pytest.MonkeyPatch, what: str, found: object, says: str
) -> None:
    module, name = what.split(".")
    monkeypatch.setattr(getattr(confined, module), name, lambda: found)
    assert says in confined.lacking()
    with pytest.raises(CosimError, match=says):
        prison(place).enter()
