"""One way to compile a kernel: numba, cached on disk wherever a cache folder can be written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_numba = cast(Any, numba)  # its decorators are not typed
Function = TypeVar("Function", bound=Callable[..., Any])


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
