"""Linux's Landlock: restricts a process to given files, without starting programs and without TCP.

Needs no privilege (https://docs.kernel.org/userspace-api/landlock.html; the system call numbers hold on every
Linux architecture except alpha). Files that were open before stay open.
"""

import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from cosim.errors import CosimError

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls
_VERSION = 1  # landlock_create_ruleset's flag: say which version the kernel has
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38  # linux/prctl.h
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR, _REMOVE, _MAKE_FOLDER, _MAKE_FILE = (
    1,
    2,
    4,
    8,
    0x30,
    0x80,
    0x100,
)
_ALL = 0x1FFF  # of version 1: those, and to make links, sockets, FIFOs and devices
_REFER, _TRUNCATE, _DEVICES = 1 << 13, 1 << 14, 1 << 15  # since 2, 3, 5
_READ = _READ_FILE | _READ_DIR
_WRITE = _READ | _WRITE_FILE | _REMOVE | _MAKE_FOLDER | _MAKE_FILE | _REFER | _TRUNCATE
_OF_FILES = _WRITE_FILE | _READ_FILE | _TRUNCATE
_TCP = 3  # to bind and to connect, since 4
_SCOPE = 3  # abstract sockets and signals, since 6


class _Ruleset(ctypes.Structure):
    _fields_ = (("fs", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _PathBeneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def version() -> int:
    """Landlock's version on this kernel; 0: no Landlock."""
    if sys.platform != "linux":
        return 0
    return max(int(ctypes.CDLL(None).syscall(_CREATE, None, ctypes.c_size_t(0), _VERSION)), 0)


def restrict(reads: Iterable[Path], writes: Iterable[Path], lists: Iterable[Path] = ()) -> None:
    """From now on this process may only read below `reads`, read and write below `writes`, and list folders
    below `lists`. It cannot start programs.

    TCP is blocked if the kernel supports that (version 4), and so are signals to other processes (6). Raises
    CosimError without Landlock, and with several threads, since only the calling thread would be restricted.
    """
    abi = version()
    if not abi:
        raise CosimError("this kernel has no Landlock: uploads cannot be driven on it")
    if len(os.listdir("/proc/self/task")) != 1:
        raise CosimError("Landlock: this process has several threads already")
    every = _ALL | (abi >= 2) * _REFER | (abi >= 3) * _TRUNCATE | (abi >= 5) * _DEVICES
    libc = ctypes.CDLL(None, use_errno=True)

    def call(number: int, *arguments: object) -> int:
        result = int(libc.syscall(number, *arguments))
        if result < 0:
            raise CosimError(f"Landlock: {os.strerror(ctypes.get_errno())}")
        return result

    ruleset = _Ruleset(every, (abi >= 4) * _TCP, (abi >= 6) * _SCOPE)
    size = 8 if abi < 4 else 16 if abi < 6 else 24  # bytes of the structure in this version
    rules = call(_CREATE, ctypes.byref(ruleset), ctypes.c_size_t(size), 0)
    try:
        rights = (reads, _READ), (writes, _WRITE), (lists, _READ_DIR)
        for paths, allowed in rights:
            for path in filter(Path.exists, paths):
                here = allowed & every if path.is_dir() else allowed & every & _OF_FILES
                if here:
                    handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
                    try:
                        call(_ADD, rules, _PATH_BENEATH, ctypes.byref(_PathBeneath(here, handle)), 0)
                    finally:
                        os.close(handle)
        if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
            raise CosimError(f"Landlock: {os.strerror(ctypes.get_errno())}")
        call(_RESTRICT, rules, 0)
    finally:
        os.close(rules)
