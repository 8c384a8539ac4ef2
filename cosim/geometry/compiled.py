"""One way to compile a kernel: numba, cached on disk wherever a cache folder can be written."""

import functools
import importlib
import time
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numba.np.linalg
from numba.core import event

_numba = cast(Any, numba)  # its decorators are not typed
Function = TypeVar("Function", bound=Callable[..., Any])


# numba.np.arraymath imports scipy.linalg only to learn whether there is a BLAS; every use of one asks again.
# No kernel here uses one, and scipy.linalg takes as long to import as numba: arraymath takes it for granted.
_linalg = _numba.np.linalg
_asked, _linalg.ensure_blas = _linalg.ensure_blas, lambda: None
importlib.import_module("numba.np.arraymath")
_linalg.ensure_blas = _asked

_compiling = _numba.core.event.TimingListener()  # what lies inside another compilation counts once
_numba.core.event.register("numba:compile", _compiling)


def compilation_time() -> float:
    """Time in s that this process has spent compiling kernels; loading one from the cache is not counted."""
    return float(_compiling.duration) if _compiling.done else 0.0


def clock() -> float:
    """As `time.perf_counter` in s, but it stands still while a kernel is compiled."""
    return time.perf_counter() - compilation_time()


def on_compilation(begun: Callable[[], None]) -> None:
    """Call `begun` in this process when numba begins to compile a kernel, not when it loads one from its
    cache."""

    class Compilations(event.Listener):
        def on_start(self, event: object) -> None:
            begun()

        def on_end(self, event: object) -> None:
            pass

    _numba.core.event.register("numba:compile", Compilations())


def cached(decorator: Callable[..., Any]) -> Callable[[Function], Function]:
    """A decorator of numba's with its cache on disk.

    The cache notices a change of the file a kernel stands in, not of the files it calls into: so kernels that
    call one another share a file. A read-only image has no cache folder: compiled each time.
    """

    def decorate(function: Function) -> Function:
        try:
            return cast(Function, decorator(cache=True)(function))
        except RuntimeError:
            return cast(Function, decorator()(function))

    return decorate


# njit without the lock; a division by zero gives inf or nan, as in numpy
compiled = cached(functools.partial(_numba.njit, nogil=True, error_model="numpy"))
# the same where rounding may differ in the last bit (pixels)
compiled_fast = cached(functools.partial(_numba.njit, nogil=True, error_model="numpy", fastmath=True))
