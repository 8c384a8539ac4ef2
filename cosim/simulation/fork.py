"""Counterfactual rollouts: the simulation continues in a copy of this process, and the original waits."""

import os
import pickle
import signal
import traceback
from collections.abc import Callable
from typing import TypeVar

from cosim.errors import CosimError, SimulationError

Answer = TypeVar("Answer")


def forked(work: Callable[[], Answer]) -> Answer:
    """The result of `work`, run in a short-lived copy of this process (os.fork).

    libsumo holds its state in memory, so a copy of the process is a copy of the simulation. SUMO's saveState
    omits active lane changes and the states of car-following models. The copy has one thread, so `work` may
    use torch only with one thread. The result is pickled.

    Raises a CosimError of `work`; else SimulationError.
    """
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        code = 1
        try:
            os.close(ours)
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
            answer: object
            try:
                answer = work()
            except CosimError as error:
                answer = error
            except BaseException:
                traceback.print_exc()
                raise
            with os.fdopen(theirs, "wb") as pipe:
                pickle.dump(answer, pipe, pickle.HIGHEST_PROTOCOL)
            code = 0
        finally:
            os._exit(code)  # skips the parent's flushes and exit handlers
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
    result: Answer | CosimError = pickle.loads(text)  # trusted: from this process's own copy
    if isinstance(result, CosimError):
        raise result
    return result
