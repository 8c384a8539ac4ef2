"""Altruistic cooperative driving in mixed traffic on SUMO; `cosim.open` starts a session with your own agent.

Importing cosim costs next to nothing: SUMO, numba and torch are loaded by what needs them, when it does.
Where gymnasium is imported, before or after, it knows the environments `cosim/...-v0`.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

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


class _WithGymnasium:
    """Imports `cosim.envs`, which registers the environments, right after gymnasium, whoever imports that."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> Any:
        if name != "gymnasium":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        spec: Any = find_spec(name)
        execute = spec.loader.exec_module

        def exec_module(module: object) -> None:
            execute(module)
            import_module("cosim.envs")

        spec.loader.exec_module = exec_module
        return spec


if "gymnasium" in sys.modules:
    import_module("cosim.envs")
else:
    sys.meta_path.insert(0, _WithGymnasium())
