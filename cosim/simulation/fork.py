"""What would come: the simulation goes on in a copy of this process, while the real one stands still."""

import os
import pickle
import signal
from collections.abc import Callable
from typing import TypeVar

from cosim.errors import CosimError, SimulationError

Answer = TypeVar("Answer")


def forked(work: Callable[[], Answer]) -> Answer:
    """What `work` returns, done in a copy of this process, which then is no more.

    libsumo holds its state in memory, so a copy of the process is a copy of the simulation (SUMO's own
    saveState leaves lane changes under way and the states of car-following models out). The copy has one
    thread: `work` may use torch only where that has one thread too. Its answer is pickled.

    Raises what `work` raised, if that is a CosimError; else SimulationError.
    """
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        code = 1
        try:
            os.close(ours)
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
            answer: object
            try:
                answer = work()
            except CosimError as error:
                answer = error
            with os.fdopen(theirs, "wb") as pipe:
                pickle.dump(answer, pipe, pickle.HIGHEST_PROTOCOL)
            code = 0
        finally:
            os._exit(code)  # nothing of the parent's is flushed or cleaned up twice
    os.close(theirs)
    try:
        with os.fdopen(ours, "rb") as pipe:
            text = pipe.read()
    except BaseException:
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        _, status = os.waitpid(child, 0)
    if status:
        raise SimulationError(f"the forked simulation failed (wait status {status})")
    result: Answer | CosimError = pickle.loads(text)  # our own copy's, not a file
    if isinstance(result, CosimError):
        raise result
    return result
