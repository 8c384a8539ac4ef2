"""The PettingZoo environment on the one loop: every AV is an agent, all act at once."""

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
from cosim.types import COMPACT, Bytes, ObservationConfig

MAX_AGENTS = 32  # slots: about twice the AVs on the road in our worlds; SUMO drives any further ones
NATIVE_RANDOM = 0  # the seed of the seeds, until reset(seed=...) gives another

Step = tuple[
    dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]


def parallel_env(config: str | Scenario = "merge", **words: Any) -> SumoParallelEnv:
    """PettingZoo's usual entry: `words` are SumoParallelEnv's and `cosim.open`'s."""
    return SumoParallelEnv(config, **words)


class SumoParallelEnv(ParallelEnv):  # type: ignore[misc]
    """All AVs learn; one step is one decision (0.4 s); rewards are their SVO rewards (cosim.rewards).

    `possible_agents` are slots av_0, av_1, ...: the k-th AV of the episode by departure (those that depart
    in the same step by id) has slot k, until the episode is over; `info["av"]` is its SUMO id. AVs beyond
    the last slot are driven by SUMO. An AV joins `agents` when it has departed and leaves when it is
    terminated (it or the mission vehicle crashed) or truncated (the duration is over, it left the road,
    another AV's collision ended the episode). While no agent is on the road and the episode goes on, it is
    driven on until one is.
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
        self._continuous = continuous
        self._config, self._flatten = observation, flatten
        self._rng = np.random.default_rng(NATIVE_RANDOM)
        self._slots: dict[str, str] = {}  # SUMO id -> agent, for all that had one in this episode
        self._session: Session = sessions.open(config, observation=observation, **words)

    @property
    def session(self) -> Session:
        """What is underneath: snapshot, road, result."""
        return self._session

    def observation_space(self, agent: str) -> spaces.Space:
        """Of one agent; all are alike."""
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
        self._slots = {}
        self._views: dict[str, View] = {}
        self.agents = []
        views = self._session.reset(seed)
        self._join(views)
        self._drive_on()
        if not self.agents:
            raise no_av(seed, None)
        return self._observations(self.agents), {a: self._info(a) for a in self.agents}

    def step(self, actions: dict[str, Any]) -> Step:
        """One decision of every agent; an agent without an action is handed to SUMO for this step."""
        unknown = [agent for agent in actions if agent not in self.possible_agents]
        if unknown:
            problem = f"no such agent{hint(str(unknown[0]), self.agents)}"
            raise BadInput(problem, field="actions", value=unknown[0])
        av_of = {agent: av for av, agent in self._slots.items()}
        acting = self.agents
        step = self._session.act(
            {av_of[a]: spaces.action_of(actions[a], self._continuous) for a in acting if a in actions}
        )
        terminated = {a: step.terminated[av_of[a]] for a in acting}
        truncated = {a: step.truncated[av_of[a]] for a in acting}
        rewards = {a: step.rewards[av_of[a]] for a in acting}
        self.agents = [a for a in acting if not (terminated[a] or truncated[a])]
        self._join(step.observations)
        infos = {a: self._info(a) for a in acting}
        for agent in acting:
            name = av_of[agent]
            infos[agent] |= spaces.decision_info(step, name)
            if name in step.ended:
                infos[agent]["ended"] = step.ended[name]
        self._drive_on()
        if self._session.over:
            result = self._session.result()
            for agent in acting:
                infos[agent]["episode_metrics"] = {key: m.value for key, m in result.metrics.items()}
                infos[agent]["trace_hash"] = result.trace_hash
        for agent in self.agents:
            if agent not in acting:  # departed in this step
                rewards[agent], terminated[agent], truncated[agent] = 0.0, False, False
                infos[agent] = self._info(agent)
        return self._observations(list(rewards)), rewards, terminated, truncated, infos

    def render(self) -> Bytes | None:
        """[160, 640, 3] RGB from above, the first agent in the middle looking to the right."""
        if self.render_mode != "rgb_array":
            return None
        av = next((name for name, agent in self._slots.items() if agent in self.agents), None)
        return self._session.picture(av)

    def close(self) -> None:
        """End the simulation and its process."""
        self._session.close()

    # ---- inside ----

    def _join(self, views: dict[str, View]) -> None:
        """Give every AV that is new on the road the next slot; remember what each agent sees."""
        departed = {name: k for k, name in enumerate(self._session.events.departed)}
        new = [name for name in views if name not in self._slots]
        if not self._session.over:
            for name in sorted(new, key=lambda n: (departed.get(n, -1), n))[: self._free()]:
                agent = self._slots[name] = self.possible_agents[len(self._slots)]
                self.agents.append(agent)
        for name, view in views.items():
            if name in self._slots:
                self._views[self._slots[name]] = view

    def _free(self) -> int:
        return len(self.possible_agents) - len(self._slots)

    def _drive_on(self) -> None:
        while not self.agents and not self._session.over and self._free():
            self._join(self._session.act({}).observations)

    def _observations(self, agents: Sequence[str]) -> dict[str, Observation]:
        return {a: spaces.observation(self._views[a], self._config, self._flatten) for a in agents}

    def _info(self, agent: str) -> dict[str, Any]:
        av = next(name for name, slot in self._slots.items() if slot == agent)
        return {"action_mask": self._views[agent].action_mask.astype(np.int8), "av": av}
