"""Transient faults: a run may succeed later, once the disk has space or the database answers."""

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import SQLAlchemyError

from cosim.errors import BadInput, CosimError, SimulationCrashed


def may_pass(problem: BaseException) -> bool:
    """All but what is wrong with the request itself: a BadInput that no fault of the machine's led to."""
    reason = problem.__context__ if isinstance(problem, BadInput) else problem
    return reason is problem or isinstance(reason, OSError | SQLAlchemyError | SimulationCrashed)


@contextlib.contextmanager
def told_apart() -> Iterator[None]:
    """A BadInput of the block that may pass leaves it as a CosimError: what led to it crosses no process."""
    try:
        yield
    except BadInput as problem:
        if may_pass(problem):
            raise CosimError(str(problem)) from None
        raise
