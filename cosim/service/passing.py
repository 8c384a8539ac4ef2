"""Transient faults: a run may succeed later, once the disk has space or the database answers."""

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import SQLAlchemyError

from cosim.errors import BadInput, CosimError, SimulationCrashed


def may_pass(problem: BaseException) -> bool:
    """Whether a retry may succeed: False for a BadInput that was not caused by a fault of the machine."""
    reason = problem.__context__ if isinstance(problem, BadInput) else problem
    return reason is problem or isinstance(reason, OSError | SQLAlchemyError | SimulationCrashed)


@contextlib.contextmanager
def told_apart() -> Iterator[None]:
    """Turn a transient BadInput of the block into a CosimError, since its cause does not cross processes."""
    try:
        yield
    except BadInput as problem:
        if may_pass(problem):
            raise CosimError(str(problem)) from None
        raise
