"""The Gymnasium environment: one learning AV among humans and other AVs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt

import cosim.envs.session as sessions
from cosim.envs import spaces
from cosim.envs.session import Session, StepResult
from cosim.envs.spaces import Observation
from cosim.errors import BadInput
from cosim.observation.view import View
from cosim.scenario import Scenario
from cosim.types import COMPACT, Bytes, ObservationConfig

if TYPE_CHECKING:
    from cosim.envs.host import PolicyFactory

MISSION, NEAREST = "mission", "nearest"


class SumoEnv(gymnasium.Env[Observation, Any]):
    """One AV learns; a step is one decision (0.4 s); the reward is its SVO reward (`cosim.rewards`).

    `reset(seed=s)` is the episode that `cosim run --seed s` drives; without a seed, one is drawn from the
    training seeds. `reset(options={"learner": ...})` chooses the learner of one episode. If no AV is on the
    road after the warm-up, the reset drives on until one is. Each environment has a process of its own:
    close it.

    `terminated`: the learner or the mission vehicle crashed. `truncated`: the duration is over, the learner
    left the road, or another AV's collision ended the episode. `info["ended"]` says which.

    Args:
        config: a scenario's name or folder, a `.sumocfg`, or a `Scenario`.
        learner: the AV that learns. "mission": the AV that would have to yield to the mission vehicle, else
            as "nearest": the AV nearest upstream of the conflict zone. Or the id of an AV.
        others: builds the policy of the other AVs; None: SUMO's IDM.
        observation: of the learner.
        flatten: "kinematics" or "kinematics+law" for one vector; None for a dictionary.
        render_mode: "rgb_array" or None.
        continuous: actions are an acceleration in m/s2 and a lane offset, which is rounded.
        **words: as of `cosim.open`.
    """

    metadata = {"render_modes": [*spaces.RENDER_MODES], "render_fps": 2.5}  # noqa: RUF012 - gymnasium's own form

    def __init__(
        self,
        config: str | Scenario,
        *,
        learner: str = MISSION,
        others: PolicyFactory | None = None,
        observation: ObservationConfig = COMPACT,
        flatten: str | None = None,
        render_mode: str | None = None,
        continuous: bool = False,
        **words: Any,
    ) -> None:
        observation = spaces.checked(observation, flatten, render_mode)
        self.render_mode = render_mode
        self.action_space = spaces.action_space(continuous)
        self._continuous = continuous
        self.observation_space = spaces.observation_space(observation, flatten)
        self._config, self._flatten, self._wanted = observation, flatten, learner
        self._session: Session = sessions.open(config, others=others, observation=observation, **words)
        self.learner = ""

    @property
    def session(self) -> Session:
        """The session below: snapshot, road, result."""
        return self._session

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode. Raises BadInput when no AV, or not the named AV, ever appears."""
        super().reset(seed=seed)
        if seed is None:
            seed = spaces.training_seed(self.np_random)
        views = self._session.reset(seed)
        wanted = str((options or {}).get("learner", self._wanted))
        while not (found := self._choose(views, wanted)):
            if self._session.over:
                raise no_av(seed, wanted)
            views = self._session.act({}).observations
        self.learner = found
        self._view = views[found]
        told = {"learner": found, "seed": seed, "decision_latency": self._view.decision_latency}
        return self._observation(), {"action_mask": self.action_masks(), **told}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One decision of the learner."""
        name = self.learner
        step = self._session.act({name: spaces.action_of(action, self._continuous)}, see=(name,))
        self._view = step.observations.get(name, self._view)  # after leaving the road: the last view
        reason = step.ended.get(name, "")
        terminated, truncated = step.terminated[name], step.truncated[name]
        info = self._info(step)
        if reason:
            result = self._session.result()
            info["ended"] = reason
            info["episode_metrics"] = {key: metric.value for key, metric in result.metrics.items()}
            info["trace_hash"] = result.trace_hash
        return self._observation(), step.rewards[name], terminated, truncated, info

    def action_masks(self) -> npt.NDArray[np.int8]:
        """[5] 0 for an impossible lane change: no lane, or a change under way (sb3-contrib's name)."""
        return self._view.action_mask.astype(np.int8)

    def render(self) -> Bytes | None:
        """[160, 640, 3] RGB from above, the learner in the middle looking to the right."""
        return self._session.picture(self.learner) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the simulation and its process."""
        if hasattr(self, "_session"):
            self._session.close()

    # ---- inside ----

    def _choose(self, views: Mapping[str, View], wanted: str) -> str:
        """The learning AV's id; "" while it is off the road."""
        if wanted not in (MISSION, NEAREST):
            return wanted if wanted in views else ""
        partner = self._session.partner() if wanted == MISSION and views else ""
        return partner if partner in views else nearest_upstream(views)

    def _observation(self) -> Observation:
        return spaces.observation(self._view, self._config, self._flatten)

    def _info(self, step: StepResult) -> dict[str, Any]:
        return {
            "action_mask": self.action_masks(),
            **spaces.decision_info(step, self.learner),
            "time": step.info["elapsed"],
        }


def nearest_upstream(views: Mapping[str, View]) -> str:
    """The AV with the shortest distance to the conflict zone. AVs in it (0 m) or past it (inf) count only
    without other AVs. "" without any AV."""
    upstream = {n: v.conflict_distance for n, v in views.items() if 0.0 < v.conflict_distance < np.inf}
    return min(upstream or views, key=lambda n: (upstream.get(n, 0.0), n), default="")


def no_av(seed: int, name: str = MISSION) -> BadInput:
    """The error for a missing learner, with its remedy."""
    if name not in (MISSION, NEAREST):
        words = f"; an AV's name, {MISSION!r} or {NEAREST!r} is needed"
        return BadInput(
            f"this AV was never on the road in episode {seed}{words}", field="learner", value=name
        )
    return BadInput(
        "no AV was ever on the road: give penetration=0.2, the share of AVs, or a demand with AVs",
        field="seed",
        value=seed,
    )
