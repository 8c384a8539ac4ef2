"""Keeps the XML parser that libsumo ships initialized between loads: a fifth of a reset's time.

SUMO starts Xerces with every `load` and shuts it down at the next one; each start builds its Unicode tables
anew (1.5 of 7 ms, perf). Xerces counts its starts (XMLPlatformUtils::Initialize), so one more of our own,
never ended, makes all others free.
"""

from __future__ import annotations

import contextlib
import ctypes
from pathlib import Path

import libsumo

INITIALIZE = "_ZN11xercesc_3_216XMLPlatformUtils10InitializeEPKcS2_PNS_12PanicHandlerEPNS_13MemoryManagerE"


def keep_initialized() -> bool:
    """Start Xerces once for the life of this process; False where libsumo brings no such library along
    (another platform, another build), which costs time and nothing else. Call it after `libsumo.start`."""
    folder = Path(libsumo.__file__).parents[1] / "libsumo.libs"
    for path in sorted(folder.glob("libxerces-c-*.so*")):
        with contextlib.suppress(OSError, AttributeError):
            initialize = getattr(ctypes.CDLL(str(path)), INITIALIZE)
            initialize.restype = None
            initialize.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p]
            initialize(b"en_US", None, None, None)
            return True
    return False
