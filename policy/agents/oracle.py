"""The fair oracle: an agent with predictions taken from counterfactual rollouts of the simulation."""

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.types import HEADING, SPEED, Floats, History, LookAhead, Snapshot, X, Y
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import PredictionAware
from policy.inputs.scene import Scene, join
from policy.prediction.forecast import KinematicForecast
from policy.prediction.motion import Rollout
from policy.prediction.traffic import Traffic, predict_traffic

STATE_COLUMNS = (X, Y, SPEED, HEADING)


class Oracle(PredictionAware):
    """The agent's networks with true future states, read from the simulation.

    Fair: in the rollout AVs keep their present commands, and no human error begins, because no predictor
    can know of it. Predicted maps are drawn without the shading for uncertainty.

    Args:
        name: the approach.
        config: sizes and weights.
    """

    def __init__(
        self,
        name: str,
        config: AgentConfig | None = None,
    ) -> None:
        super().__init__(name, config)
        if config is None:  # the shipped one
            self.name = f"{name}-oracle"
        self.hpn = None  # true states need no correction

    def looks_ahead(self, look: LookAhead) -> None:
        """See `cosim.types.LooksAhead`."""
        self._look = look

    def foresee(self, histories: Mapping[str, History]) -> tuple[Scene, Traffic, KinematicForecast]:
        """The joined scene of all AVs and the forecast of its vehicles, as the networks receive them."""
        return self._truth(join(histories, self._context.pooled))

    def _truth(self, scene: Scene) -> tuple[Scene, Traffic, KinematicForecast]:
        c, context = self.config, self._context
        frames = max(c.chain.horizon, c.safety.frames)
        states = coming(scene, self._look(frames), context.timing.frame)
        x, y, speed, heading = (states[:, : c.chain.horizon, k] for k in STATE_COLUMNS)
        forecast = KinematicForecast.without_spread(x, y, speed, heading, scene.valid[:, -1])
        carried = predict_traffic(scene, forecast, context.road, c.traffic, c.safety.frames)
        traffic = carried._replace(rollout=_true(carried, scene, states[:, : c.safety.frames]))
        self._expected = scene.vehicles, traffic, forecast
        return scene, traffic, forecast


def coming(scene: Scene, frames: Sequence[Snapshot], dt: float) -> Floats:
    """States [V,M,4] (x m, y m, speed m/s, heading rad unwrapped) of the scene's vehicles in M frames.

    A vehicle that has left the road continues straight at its last speed.
    """
    out = np.empty((len(scene.vehicles), len(frames), 4))
    now = scene.state[:, -1, :4].copy()
    for k, frame in enumerate(frames):
        rows = np.array([frame.row.get(name, -1) for name in scene.vehicles])
        there = rows >= 0
        way = (now[:, SPEED] * dt)[:, None] * np.stack([np.cos(now[:, HEADING]), np.sin(now[:, HEADING])], 1)
        gone = np.concatenate([now[:, :2] + way, now[:, 2:]], 1)
        rows, left = rows[there], now[there, HEADING]
        heading = left + (frame.heading[rows] - left + np.pi) % (2 * np.pi) - np.pi
        now = gone
        now[there] = np.stack([frame.x[rows], frame.y[rows], frame.speed[rows], heading], 1)
        out[:, k] = now
    return out


def _true(carried: Traffic, scene: Scene, states: Floats) -> Rollout:
    """The rollout [V,M+1] with positions and speeds of `states` [V,M,4] for known vehicles."""
    whole = np.concatenate([scene.state[:, -1:, :4], states], 1)
    known, old = carried.known[:, None], carried.rollout
    return old._replace(
        x=np.where(known, whole[..., X], old.x),
        y=np.where(known, whole[..., Y], old.y),
        heading=np.where(known, whole[..., HEADING], old.heading),
        speed=np.where(known, whole[..., SPEED], old.speed),
    )
