"""Environments on the loop: `cosim.open`, Gymnasium ids `cosim/...-v0`, PettingZoo's `parallel_env`."""

from typing import TYPE_CHECKING

import gymnasium

from sumo_scenarios import names

if TYPE_CHECKING:
    from cosim.envs.gym import SumoEnv
    from cosim.envs.parallel import SumoParallelEnv, parallel_env
    from cosim.envs.session import Session, StepResult, open
    from cosim.observation.view import View

__all__ = ["Session", "StepResult", "SumoEnv", "SumoParallelEnv", "View", "open", "parallel_env"]

_HOME = {
    "SumoEnv": "cosim.envs.gym",
    "SumoParallelEnv": "cosim.envs.parallel",
    "parallel_env": "cosim.envs.parallel",
    "View": "cosim.observation.view",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'cosim.envs' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME.get(name, "cosim.envs.session")), name)


for _world in names():
    gymnasium.register(f"cosim/{_world.capitalize()}-v0", "cosim.envs.gym:SumoEnv", kwargs={"config": _world})
gymnasium.register("cosim/Sumo-v0", "cosim.envs.gym:SumoEnv")  # give it config="my.sumocfg" or a folder
