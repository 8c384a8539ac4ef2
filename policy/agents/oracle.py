"""The fair oracle: an agent whose predictions are what really comes of everybody's present course."""

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.types import HEADING, SPEED, Floats, History, LookAhead, Snapshot, X, Y
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import PredictionAware
from policy.inputs.scene import Scene, join
from policy.prediction.forecast import KinematicForecast
from policy.prediction.motion import Rollout
from policy.prediction.traffic import Traffic, predict_traffic

STATE = (X, Y, SPEED, HEADING)


class Oracle(PredictionAware):
    """Drives by the same networks; the simulation itself says where everybody will be.

    Fair: the AVs hold what they are commanded, and human errors that have not begun do not begin, as no
    predictor can know of them. Predicted maps are drawn without the shading that stands for doubt.

    Args:
        name: the approach.
        config: its sizes and weights.
    """

    def __init__(
        self,
        name: str,
        config: AgentConfig | None = None,
    ) -> None:
        super().__init__(name, config)
        if config is None:  # the one that ships
            self.name = f"{name}-oracle"
        self.hpn = None  # nothing is left to be corrected

    def looks_ahead(self, look: LookAhead) -> None:
        """See `cosim.types.LooksAhead`."""
        self._look = look

    def foresee(self, histories: Mapping[str, History]) -> tuple[Scene, Traffic, KinematicForecast]:
        """What all AVs see together, and where the networks expect everybody in it."""
        return self._truth(join(histories, self._context.pooled))

    def _truth(self, scene: Scene) -> tuple[Scene, Traffic, KinematicForecast]:
        c, context = self.config, self._context
        frames = max(c.chain.horizon, c.safety.frames)
        states = coming(scene, self._look(frames), context.timing.frame)
        x, y, speed, heading = (states[:, : c.chain.horizon, k] for k in STATE)
        forecast = KinematicForecast.without_spread(x, y, speed, heading, scene.valid[:, -1])
        carried = predict_traffic(scene, forecast, context.road, c.traffic, c.safety.frames)
        traffic = carried._replace(rollout=_true(carried, scene, states[:, : c.safety.frames]))
        self._expected = scene.vehicles, traffic, forecast
        return scene, traffic, forecast


def coming(scene: Scene, frames: Sequence[Snapshot], dt: float) -> Floats:
    """States [V,M,4] (x m, y m, speed m/s, heading rad unwrapped) of the scene's vehicles in M frames.

    Who has left the road goes straight on as it was seen last.
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
    """The rollout [V,M+1] with the places and speeds of `states` [V,M,4] where vehicles are known."""
    whole = np.concatenate([scene.state[:, -1:, :4], states], 1)
    known, old = carried.known[:, None], carried.rollout
    return old._replace(
        x=np.where(known, whole[..., X], old.x),
        y=np.where(known, whole[..., Y], old.y),
        heading=np.where(known, whole[..., HEADING], old.heading),
        speed=np.where(known, whole[..., SPEED], old.speed),
    )
