"""One way to compile a kernel: numba, cached on disk wherever a cache folder can be written."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numba.np.linalg
from numba.core import event

_numba = cast(Any, numba)  # its decorators are not typed
Function = TypeVar("Function", bound=Callable[..., Any])


def _start_without_scipy() -> None:
    """numba.np.arraymath imports scipy.linalg only to learn whether there is a BLAS; every use of one asks
    again. No kernel here uses one, and scipy.linalg takes as long to import as numba."""
    linalg = _numba.np.linalg
    asked, linalg.ensure_blas = linalg.ensure_blas, lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = asked


_start_without_scipy()


class _Compilation(event.Listener):
    """Calls `begun` whenever numba begins to compile a kernel, not when it loads one from its cache."""

    def __init__(self, begun: Callable[[], None]) -> None:
        self._begun = begun

    def on_start(self, event: object) -> None:
        self._begun()

    def on_end(self, event: object) -> None:
        pass


def on_compilation(begun: Callable[[], None]) -> None:
    """Call `begun` in this process whenever a kernel has to be compiled, which takes seconds."""
    event.register("numba:compile", _Compilation(begun))


def compiled(function: Function) -> Function:
    """numba's njit without the lock; a division by zero gives inf or nan, as in numpy.

    The cache on disk notices a change of the file a kernel stands in, not of the files it calls into: so
    kernels that call one another share a file. A read-only image has no cache folder: compiled each time.
    """
    return _compiled(function, fastmath=False)


def compiled_fast(function: Function) -> Function:
    """The same where rounding may differ in the last bit (pixels)."""
    return _compiled(function, fastmath=True)


def _compiled(function: Function, fastmath: bool) -> Function:
    options = {"nogil": True, "error_model": "numpy", "fastmath": fastmath}
    try:
        return cast(Function, _numba.njit(cache=True, **options)(function))
    except RuntimeError:
        return cast(Function, _numba.njit(**options)(function))
