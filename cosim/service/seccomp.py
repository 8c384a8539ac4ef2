"""Linux's seccomp: allows only the system calls that a simulation needs, for all threads of this process.

Needs no privilege (https://docs.kernel.org/userspace-api/seccomp_filter.html). A refused call answers EPERM;
a call newer than `_NEW` answers ENOSYS, on which the C library falls back to an older one.
"""

import ctypes
import errno
import os
import platform
import re
import sys
from collections.abc import Iterator

from cosim.errors import CosimError

# name, number on x86_64, on aarch64 (asm/unistd_64.h, asm-generic/unistd.h). Not included: sockets, programs,
# processes, changes of owners, modes, times and attributes, links, devices, mounts, others' memory.
_CALLS = """
read 0 63, write 1 64, readv 19 65, writev 20 66, pread64 17 67, pwrite64 18 68, preadv 295 69,
pwritev 296 70, close 3 57, close_range 436 436, lseek 8 62, fsync 74 82, fdatasync 75 83,
ftruncate 77 46, fallocate 285 47, fadvise64 221 223, sendfile 40 71, copy_file_range 326 285,
open 2 -, openat 257 56, stat 4 -, fstat 5 80, lstat 6 -, newfstatat 262 79, statx 332 291,
statfs 137 43, fstatfs 138 44, access 21 -, faccessat 269 48, faccessat2 439 439, readlink 89 -,
readlinkat 267 78, getcwd 79 17, chdir 80 49, fchdir 81 50, getdents 78 -, getdents64 217 61,
mkdir 83 -, mkdirat 258 34, rmdir 84 -, unlink 87 -, unlinkat 263 35, rename 82 -, renameat 264 38,
renameat2 316 276, umask 95 166, dup 32 23, dup2 33 -, dup3 292 24, pipe 22 -, pipe2 293 59,
eventfd2 290 19, flock 73 32, poll 7 -, ppoll 271 73, select 23 -, pselect6 270 72,
epoll_create1 291 20, epoll_ctl 233 21, epoll_wait 232 -, epoll_pwait 281 22, mmap 9 222,
mprotect 10 226, munmap 11 215, mremap 25 216, madvise 28 233, brk 12 214, msync 26 227,
mincore 27 232, mlock 149 228, munlock 150 229, membarrier 324 283, get_mempolicy 239 236,
exit 60 93, exit_group 231 94, wait4 61 260, waitid 247 95, set_tid_address 218 96,
set_robust_list 273 99, rseq 334 293, futex 202 98, sched_yield 24 124, sched_getaffinity 204 123,
sched_getparam 143 121, sched_getscheduler 145 120, sched_get_priority_max 146 125,
sched_get_priority_min 147 126, getpid 39 172, gettid 186 178, getppid 110 173, getuid 102 174,
geteuid 107 175, getgid 104 176, getegid 108 177, getgroups 115 158, getresuid 118 148,
getresgid 120 150, getpgrp 111 -, getpgid 121 155, getsid 124 156, uname 63 160, sysinfo 99 179,
times 100 153, getrusage 98 165, getrlimit 97 163, setrlimit 160 164, getpriority 140 141,
getcpu 309 168, time 201 -, gettimeofday 96 169, clock_gettime 228 113, clock_getres 229 114,
clock_nanosleep 230 115, nanosleep 35 101, alarm 37 -, getitimer 36 102, setitimer 38 103,
pause 34 -, rt_sigaction 13 134, rt_sigprocmask 14 135, rt_sigreturn 15 139, sigaltstack 131 132,
rt_sigpending 127 136, rt_sigtimedwait 128 137, rt_sigsuspend 130 133, restart_syscall 219 128,
arch_prctl 158 -, getrandom 318 278, capget 125 90,
clone 56 220, kill 62 129, tgkill 234 131, prlimit64 302 261, sched_setaffinity 203 122,
fcntl 72 25, ioctl 16 29, prctl 157 167
"""
_ARCHITECTURES = {"x86_64": (0xC000003E, 1), "aarch64": (0xC00000B7, 2)}  # linux/audit.h, column of _CALLS
_NEW = 424  # from this number on, both architectures have equal numbers

_OWN = -1  # stands for this process's id
# Calls with one argument that must be one of these: (its place, values)
_ONLY = {
    "kill": (0, (_OWN,)),
    "tgkill": (0, (_OWN,)),
    "prlimit64": (0, (0, _OWN)),
    "sched_setaffinity": (0, (0,)),
    # F_DUPFD to F_SETLKW, F_OFD_*, F_DUPFD_CLOEXEC: without signals to other processes
    "fcntl": (1, (0, 1, 2, 3, 4, 5, 6, 7, 36, 37, 38, 1030)),
    # TCGETS, TIOCGWINSZ, FIONREAD, FIONBIO, FIONCLEX, FIOCLEX
    "ioctl": (1, (0x5401, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451)),
    # PR_GET_PDEATHSIG, PR_GET_DUMPABLE, PR_SET_NAME, PR_GET_NAME, PR_SET_VMA
    "prctl": (0, (2, 3, 15, 16, 0x53564D41)),
}
_THREAD = 0x10000  # CLONE_THREAD: a thread of this process, not another process

_SET_FILTER, _ALL_THREADS = 1, 1  # linux/seccomp.h
_SECCOMP = {"x86_64": 317, "aarch64": 277}  # the system call
_PRCTL_GET_SECCOMP, _NO_NEW_PRIVILEGES = 21, 38
_LOAD, _EQUAL, _AT_LEAST, _BITS, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06  # linux/bpf_common.h
_ALLOW, _ERROR, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16  # bytes in struct seccomp_data


class _Instruction(ctypes.Structure):
    _fields_ = (("code", ctypes.c_uint16), ("yes", ctypes.c_uint8), ("no", ctypes.c_uint8),
                ("value", ctypes.c_uint32))  # fmt: skip


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("first", ctypes.POINTER(_Instruction)))


def available() -> bool:
    """Whether this kernel filters system calls, and its numbers are known here."""
    if sys.platform != "linux" or platform.machine() not in _ARCHITECTURES:
        return False
    return int(ctypes.CDLL(None).prctl(_PRCTL_GET_SECCOMP, 0, 0, 0, 0)) >= 0


def restrict() -> None:
    """Restrict this process to `_CALLS` from now on. Raises CosimError without seccomp."""
    if not available():
        raise CosimError("this kernel has no known seccomp: uploads cannot be driven on it")
    machine = platform.machine()
    lines = [_Instruction(*line) for line in _filter(*_ARCHITECTURES[machine])]
    program = _Program(len(lines), (_Instruction * len(lines))(*lines))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(
        _SECCOMP[machine], _SET_FILTER, _ALL_THREADS, ctypes.byref(program)
    ):
        raise CosimError(f"seccomp: {os.strerror(ctypes.get_errno())}")


def _filter(architecture: int, column: int) -> Iterator[tuple[int, int, int, int]]:
    """The instructions: code, lines to skip if so, lines to skip if not, value."""
    yield _LOAD, 0, 0, _ARCHITECTURE
    yield _EQUAL, 1, 0, architecture
    yield _RETURN, 0, 0, _KILL
    yield _LOAD, 0, 0, _NUMBER
    for entry in re.findall(r"(\w+) (\S+) ([^\s,]+)", _CALLS):
        name, number = entry[0], entry[column]
        if number == "-":
            continue
        body = [*_conditions(name), (_RETURN, 0, 0, _ALLOW)]
        yield _EQUAL, 0, len(body), int(number)
        yield from body
    yield _AT_LEAST, 0, 1, _NEW
    yield _RETURN, 0, 0, _ERROR | errno.ENOSYS
    yield _RETURN, 0, 0, _ERROR | errno.EPERM


def _conditions(name: str) -> Iterator[tuple[int, int, int, int]]:
    """Instructions that check a call's arguments: they return EPERM, or continue after the last one."""
    if name == "clone":
        yield _LOAD, 0, 0, _ARGUMENTS
        yield _BITS, 1, 0, _THREAD
        yield _RETURN, 0, 0, _ERROR | errno.EPERM
    elif name in _ONLY:
        place, values = _ONLY[name]
        yield _LOAD, 0, 0, _ARGUMENTS + 8 * place
        for k, value in enumerate(values):
            yield _EQUAL, len(values) - k, 0, os.getpid() if value == _OWN else value
        yield _RETURN, 0, 0, _ERROR | errno.EPERM
