"""Freed memory stays with the process, so that arrays reuse mapped pages without new page faults."""

import ctypes

# glibc's malloc.h
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4
_PAD = 64 * 2**20  # bytes by which the heap grows at once


def keep_freed_memory() -> None:
    """Ask glibc to keep freed memory for reuse; elsewhere nothing happens.

    Batches of maps are tens of megabytes: by default each is mapped, faulted in page by page and unmapped
    again.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_M_MMAP_MAX, 0)
    mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(_M_TOP_PAD, _PAD)
