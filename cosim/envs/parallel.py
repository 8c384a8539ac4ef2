"""The PettingZoo environment: every AV is an agent, and all act at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

import cosim.envs.session as sessions
from cosim.envs import spaces
from cosim.envs.gym import no_av
from cosim.envs.session import Session
from cosim.envs.spaces import Observation
from cosim.errors import BadInput, hint
from cosim.observation.view import View
from cosim.scenario import Scenario
from cosim.types import COMPACT, Bytes, MetaAction, ObservationConfig

MAX_AGENTS = 32  # slots: about twice the AVs of the shipped scenarios; SUMO drives further AVs
NATIVE_RANDOM = 0  # seed of the episode seeds, until reset(seed=...) replaces it

Step = tuple[
    dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]


def parallel_env(config: str | Scenario = "merge", **words: Any) -> SumoParallelEnv:
    """Make a `SumoParallelEnv` under PettingZoo's usual name; `words`: its options and `cosim.open`'s."""
    return SumoParallelEnv(config, **words)


class SumoParallelEnv(ParallelEnv):  # type: ignore[misc]
    """All AVs learn; a step is one decision (0.4 s); rewards are their SVO rewards (`cosim.rewards`).

    Agents are slots av_0, av_1, ...: slot k belongs to the k-th AV that departs in the episode.
    `vehicles[agent]` is its id in SUMO. An agent joins when its AV departs. It leaves when it is terminated
    (it or the mission vehicle crashed) or truncated (the duration is over, the AV left the road, another AV's
    collision ended the episode). While no agent is on the road, the environment drives on.

    Args:
        config: a scenario's name or folder, a `.sumocfg`, or a `Scenario`.
        max_agents: slots; SUMO drives further AVs.
        observation, flatten, render_mode, continuous: as of `SumoEnv`.
        padded: all agents are there from the reset on, as TorchRL and BenchMARL need it. An agent whose AV
            has not departed observes zeros, may only idle, and earns 0.
        **words: as of `cosim.open`.
    """

    metadata = {  # noqa: RUF012 - PettingZoo's own form
        "name": "cosim_v0",
        "render_modes": [*spaces.RENDER_MODES],
        "render_fps": 2.5,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        config: str | Scenario,
        *,
        max_agents: int = MAX_AGENTS,
        observation: ObservationConfig = COMPACT,
        flatten: str | None = None,
        render_mode: str | None = None,
        continuous: bool = False,
        padded: bool = False,
        **words: Any,
    ) -> None:
        observation = spaces.checked(observation, flatten, render_mode)
        self.render_mode = render_mode
        self.possible_agents = [f"av_{k}" for k in range(max_agents)]
        self.agents: list[str] = []
        self.observation_spaces = {
            a: spaces.observation_space(observation, flatten) for a in self.possible_agents
        }
        self.action_spaces = {a: spaces.action_space(continuous) for a in self.possible_agents}
        self._continuous, self._padded = continuous, padded
        self._config, self._flatten = observation, flatten
        self._rng = np.random.default_rng(NATIVE_RANDOM)
        self.vehicles: dict[str, str] = {}  # agent -> SUMO id, of all agents of this episode
        self._session: Session = sessions.open(config, observation=observation, **words)

    @property
    def session(self) -> Session:
        """The session below: snapshot, road, result."""
        return self._session

    def observation_space(self, agent: str) -> spaces.Space:
        """Of one agent; equal for all agents."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Of one agent: the five meta-actions, or acceleration and lane offset (`continuous`)."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin the episode `seed`, or one drawn from the training seeds. `options` is not used."""
        if seed is None:
            seed = spaces.training_seed(self._rng)
        else:
            self._rng = np.random.default_rng(seed)
        self.vehicles = {}
        self._views: dict[str, View] = {}
        self.agents = [*self.possible_agents] if self._padded else []
        views = self._session.reset(seed)
        self._join(views)
        self._drive_on()
        if not self._driving:
            raise no_av(seed)
        return self._observations(self.agents), {a: self._info(a) for a in self.agents}

    def step(self, actions: dict[str, Any]) -> Step:
        """One decision of every agent; an agent without an action is handed to SUMO for this step."""
        unknown = [agent for agent in actions if agent not in self.possible_agents]
        if unknown:
            problem = f"no such agent{hint(str(unknown[0]), self.agents)}"
            raise BadInput(problem, field="actions", value=unknown[0])
        driving, before = self._driving, self.agents
        step = self._session.act(
            {av: spaces.action_of(actions[a], self._continuous) for a, av in driving.items() if a in actions}
        )
        self.agents = [a for a in before if driving.get(a) not in step.ended]
        self._join(step.observations)
        self._drive_on()
        over = self._session.over
        everyone = list(dict.fromkeys((*before, *self.agents)))  # newly departed AVs last
        waiting = [a for a in everyone if a not in driving]
        rewards = dict.fromkeys(waiting, 0.0) | {a: step.rewards[av] for a, av in driving.items()}
        terminated = dict.fromkeys(waiting, False) | {a: step.terminated[av] for a, av in driving.items()}
        truncated = dict.fromkeys(waiting, over) | {a: step.truncated[av] for a, av in driving.items()}
        infos = {a: self._info(a) for a in everyone}
        for agent, av in driving.items():
            infos[agent] |= spaces.decision_info(step, av)
            if av in step.ended:
                infos[agent]["ended"] = step.ended[av]
        if over:
            self.agents = []
            result = self._session.result()
            for agent in driving:
                infos[agent]["episode_metrics"] = {key: m.value for key, m in result.metrics.items()}
                infos[agent]["trace_hash"] = result.trace_hash
        return self._observations(everyone), rewards, terminated, truncated, infos

    def render(self) -> Bytes | None:
        """[160, 640, 3] RGB from above, the first agent in the middle looking to the right."""
        if self.render_mode != "rgb_array":
            return None
        return self._session.picture(next(iter(self._driving.values()), None))

    def close(self) -> None:
        """End the simulation and its process."""
        self._session.close()

    # ---- inside ----

    def _join(self, views: dict[str, View]) -> None:
        """Assign the next slot to every new AV; store each agent's view."""
        departed = {name: k for k, name in enumerate(self._session.events.departed)}
        new = views.keys() - self.vehicles.values()
        free = self.possible_agents[len(self.vehicles) :]
        if not self._session.over:
            in_order = sorted(new, key=lambda n: (departed.get(n, -1), n))
            self.vehicles |= (joined := dict(zip(free, in_order, strict=False)))
            self.agents += [agent for agent in joined if agent not in self.agents]
        self._views |= {agent: views[av] for agent, av in self.vehicles.items() if av in views}

    @property
    def _driving(self) -> dict[str, str]:
        """Agent -> AV, for AVs on the road."""
        return {agent: self.vehicles[agent] for agent in self.agents if agent in self.vehicles}

    def _drive_on(self) -> None:
        waits = len(self.vehicles) < len(self.possible_agents)
        while waits and not self._driving and not self._session.over:
            self._join(self._session.act({}).observations)

    def _observations(self, agents: Sequence[str]) -> dict[str, Observation]:
        return {a: self._observation(a) for a in agents}

    def _observation(self, agent: str) -> Observation:
        if agent in self._views:
            return spaces.observation(self._views[agent], self._config, self._flatten)
        return spaces.nothing(self.observation_spaces[agent])

    def _info(self, agent: str) -> dict[str, Any]:
        seen = self._views.get(agent)
        mask = np.arange(len(MetaAction)) == MetaAction.IDLE if seen is None else seen.action_mask
        return {"action_mask": mask.astype(np.int8)}
