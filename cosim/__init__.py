"""Altruistic cooperative driving in mixed traffic on SUMO; `cosim.open` starts a session with your own agent.

Importing cosim costs next to nothing: SUMO, numba and torch are loaded by what needs them, when it does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosim.envs.session import Session, StepResult, open
    from cosim.observation.view import View

__all__ = ["Session", "StepResult", "View", "__version__", "open"]
__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    if name in __all__:
        from cosim.envs import session

        return getattr(session, name)
    raise AttributeError(f"module 'cosim' has no attribute {name!r}")
