"""Permanent removal of a process's privileges: root becomes an unprivileged user."""

import ctypes
import os
from collections.abc import Iterable

from cosim.errors import CosimError

NOBODY = 64_000  # user and group without an account, in systemd's range for services
_CHOWN, _READ_SEARCH, _SETGID, _SETUID = 1 << 0, 1 << 2, 1 << 6, 1 << 7  # linux/capability.h
_VERSION = 0x20080522
_SET_END, _GET_END, _KEEP, _SECURE = 1, 2, 8, 28  # PR_SET_PDEATHSIG, PR_GET_, PR_SET_KEEPCAPS, _SECUREBITS
_NO_FIXUP = 1 << 2  # SECBIT_NO_SETUID_FIXUP: access(2), which SUMO uses, respects kept capabilities


def droppable() -> bool:
    """Whether this process is not root, or may change its user."""
    return os.geteuid() != 0 or not (_CHOWN | _SETGID | _SETUID) & ~_capabilities()


def drop(folders: Iterable[str]) -> None:
    """Give up every capability; root becomes NOBODY, the new owner of `folders`.

    A former root keeps the capability to read and enter folders, if it had it; Landlock restricts them.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    ended_by = ctypes.c_int()
    libc.prctl(_GET_END, ctypes.byref(ended_by))
    kept = 0
    if os.geteuid() == 0:
        kept = _READ_SEARCH & _capabilities()
        try:
            for folder in folders:
                os.chown(folder, NOBODY, NOBODY)
            libc.prctl(_KEEP, 1, 0, 0, 0)
            libc.prctl(_SECURE, _NO_FIXUP, 0, 0, 0)
            os.setgroups(())
            os.setresgid(NOBODY, NOBODY, NOBODY)
            os.setresuid(NOBODY, NOBODY, NOBODY)
        except OSError as error:
            raise CosimError(f"root cannot become an ordinary user: {error.strerror}") from None
    head = (ctypes.c_uint32 * 2)(_VERSION, 0)
    sets = (ctypes.c_uint32 * 6)(kept, kept, 0, 0, 0, 0)  # effective, permitted, inheritable; once more
    if libc.capset(head, sets):
        raise CosimError(f"capabilities: {os.strerror(ctypes.get_errno())}")
    libc.prctl(_SET_END, ended_by.value, 0, 0, 0)  # reset by the change of user


def tasks() -> int:
    """Number of visible processes and threads of this user."""
    number, user = 0, os.getuid()
    for entry in os.scandir("/proc"):
        if entry.name.isdecimal():
            try:
                if os.stat(entry).st_uid == user:
                    number += len(os.listdir(f"/proc/{entry.name}/task"))
            except OSError:  # the process has ended
                continue
    return number


def _capabilities() -> int:
    """The effective capabilities of this process, one bit each."""
    head = (ctypes.c_uint32 * 2)(_VERSION, 0)
    sets = (ctypes.c_uint32 * 6)()
    return 0 if ctypes.CDLL(None).capget(head, sets) else int(sets[0])
