"""The model of `train_sb3_dqn.py --out runs/sb3-dqn.zip` as a policy for cosim's commands.

SB3_MODEL=runs/sb3-dqn.zip cosim evaluate --scenario merge --demand contested --policy idm \
    --policy examples/sb3_policy.py:Dqn --seeds 200000:200010 --out runs/sb3
cosim compare runs/sb3 --baseline idm --candidate Dqn
"""

import os
from collections.abc import Mapping
from pathlib import Path

from stable_baselines3 import DQN

from cosim.envs.gym import nearest_upstream
from cosim.envs.spaces import observation
from cosim.observation.view import views
from cosim.types import History, ObservationConfig, PolicyContext


class Dqn:
    """Commands the AV nearest upstream of the conflict zone; SUMO's IDM drives the others.

    In training it commanded the AV in conflict with the mission vehicle.
    """

    observation = ObservationConfig(maps=False)  # as in training

    def __init__(self) -> None:
        model = Path(os.environ.get("SB3_MODEL", "runs/sb3-dqn.zip")).absolute()
        self.files = [model]  # hashed for the manifest
        self.model = DQN.load(model, device="cpu")

    def reset(self, context: PolicyContext) -> None:
        """No AV is chosen yet."""
        self.learner = ""

    def decide(self, histories: Mapping[str, History]) -> dict[str, int]:
        """The chosen AV -> the number of its action."""
        seen = views(histories)
        if self.learner not in seen:
            self.learner = nearest_upstream(seen)
        if not self.learner:
            return {}
        numbers = observation(seen[self.learner], self.observation, "kinematics")
        action, _ = self.model.predict(numbers, deterministic=True)
        return {self.learner: int(action)}
