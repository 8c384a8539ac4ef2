"""The assembly of simulator, episode and policy in one process."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.control import courtesy
from cosim.episode import Episode, Hook, Progress, Step, run_episode
from cosim.files import code
from cosim.metrics import MetricFactory, joined
from cosim.metrics import read as read_metric
from cosim.policies import compensator, make
from cosim.recording.recorder import MAX_DRAWN_FRAMES, Recorder
from cosim.recording.replay_data import ReplayData, replay_data
from cosim.rewards import Reward, RewardTerms, rewards
from cosim.rewards import read as read_reward
from cosim.scenario import ALWAYS, Scenario
from cosim.scenario.manifest import POLICY_FILES, digests
from cosim.scenario.sumo_outputs import drafts
from cosim.sensing.perception import PREDICTED
from cosim.types import EpisodeResult, LooksAhead, Metric, ObservationConfig, Policy, Simulator
from cosim.workers.determinism import make_torch_deterministic

SimulatorFactory = Callable[[Scenario, Mapping[str, str], int], Simulator]  # ..., AV parameters, frames kept


class Host:
    """One scenario, one policy (a name or an object), any number of episodes; runs in a worker process.

    Args:
        scenario: the vetted scenario.
        policy: commands the AVs.
        svo: phi in rad, passed to the policy.
        observation: of the AVs; by default the policy's.
        simulator: builds a replacement of SUMO.
        metrics: additional to `cosim.metrics.METRICS`: factories, or FILE.py:NAME.
        reward: reported as the figure `reward_mean`: an object, or a text that `cosim.rewards.read` accepts.

    Raises BadInput for an unknown policy and for input that SUMO refuses.
    """

    def __init__(
        self,
        scenario: Scenario,
        policy: str | Policy,
        svo: float,
        *,
        observation: ObservationConfig | None = None,
        simulator: SimulatorFactory | None = None,
        metrics: Sequence[str | MetricFactory] = (),
        reward: str | Reward | None = None,
    ) -> None:
        self.policy = make(policy) if isinstance(policy, str) else policy
        scenario = replace(scenario, preset=ALWAYS.get(self.policy.name, scenario.preset))
        self.svo = svo
        wanted = observation or self.policy.observation
        measured = [read_metric(metric) for metric in metrics]
        self._reward = None if reward is None else read_reward(reward)
        own = code.files_of([*metrics, reward])
        self._policy_files = digests([*getattr(self.policy, "files", ()), *own])
        make_torch_deterministic()
        self.simulator = (simulator or sumo)(scenario, self.policy.av_parameters, wanted.frames)
        if scenario.sensing is not None and scenario.sensing.parameters.compensation in PREDICTED:
            sensing: Any = self.simulator  # only SUMO's simulator has percepts
            how = scenario.sensing.parameters.compensation
            sensing.compensator = compensator(how, self.simulator.road, scenario.timing)
        self.simulator.courtesy = courtesy(svo)
        if isinstance(self.policy, LooksAhead):
            self.policy.looks_ahead(self.simulator.ahead)
        self.episode = Episode(scenario, self.simulator, wanted, measured)

    def policy_files(self) -> dict[str, str]:
        """SHA-256 by file name, of the policy's weights and code and a user's metrics and reward."""
        return self._policy_files

    def run(
        self,
        seed: int,
        progress: Progress | None = None,
        *,
        hooks: Sequence[Hook] = (),
        outputs: Sequence[str] = (),
        folder: Path | None = None,
    ) -> EpisodeResult:
        """One whole episode; SUMO's own `outputs` (`cosim.scenario.sumo_outputs`) go into `folder`."""
        with drafts(outputs, folder) as files:
            simulator: Any = self.simulator  # only SUMO's simulator writes files
            if files:
                simulator.write_outputs(files)
            try:
                earned = None if self._reward is None else Earnings(self._reward, self.svo)
                every = [*hooks, *filter(None, [earned])]
                result = run_episode(
                    self.episode, self.policy, seed, svo=self.svo, progress=progress, hooks=every
                )
                paid = {} if earned is None else {"reward_mean": Metric(earned.mean, "", "higher")}
                return replace(
                    result,
                    metrics=joined(result.metrics, paid),
                    manifest=result.manifest | {POLICY_FILES: self._policy_files},
                )
            finally:
                if files:
                    simulator.finish_outputs()

    def run_recorded(
        self,
        seed: int,
        progress: Progress | None = None,
        *,
        outputs: Sequence[str] = (),
        folder: Path | None = None,
    ) -> tuple[EpisodeResult, ReplayData]:
        """`run` with a recording: the same result, and the data of a replay."""
        recorder = Recorder(self.policy, MAX_DRAWN_FRAMES)
        result = self.run(seed, progress, hooks=[recorder], outputs=outputs, folder=folder)
        return result, replay_data(recorder, self.simulator, result.document())

    def close(self) -> None:
        """End the simulation."""
        self.simulator.close()


class Earnings(Hook):
    """Rewards of the AVs on the road, decision by decision; `svo` (phi) in rad."""

    def __init__(self, reward: Reward, svo: float) -> None:
        self.reward, self.svo = reward, svo
        self.totals: list[float] = []

    def on_step(self, episode: Episode, step: Step) -> None:
        """Reward every AV on the road for one decision."""
        self.totals += [terms.total for terms in self.pay(step, step.before.avs).values()]

    def pay(self, step: Step, avs: Sequence[str]) -> dict[str, RewardTerms]:
        """The reward of each of `avs` in this step."""
        actions = {av: decision.action for av, decision in step.decisions.items()}
        happened = step.events.collisions
        return rewards(step.before, step.after, avs, actions, self.svo, self.reward, happened)

    @property
    def mean(self) -> float | None:
        """Mean per AV and decision; None without an AV on the road."""
        return float(np.mean(self.totals)) if self.totals else None


class Hosts:
    """A cache of one host: a new seed costs a reset, another host a start of SUMO."""

    def __init__(self) -> None:
        self._host: Host | None = None
        self._key: object = None

    def host(self, key: object, build: Callable[[], Host]) -> Host:
        """The present host if it has this `key`, else the result of `build`."""
        if self._host is None or key != self._key:
            self.close()  # libsumo allows one simulation per process
            self._host, self._key = build(), key
        return self._host

    def close(self) -> None:
        """End the simulation."""
        host, self._host = self._host, None
        if host is not None:
            host.close()


def sumo(scenario: Scenario, av_parameters: Mapping[str, str], history: int) -> Simulator:
    """SUMO in this process; `history`: frames of the warm-up that a reset returns."""
    from cosim.simulation.sumo import SumoSimulator  # libsumo: in the worker's process only

    return SumoSimulator(scenario, av_parameters=av_parameters, history=history)


def serving(port: int, clients: int) -> SimulatorFactory:
    """SUMO in this process, shared with `clients` TraCI programs at `port` (docs/guides/traci.md)."""

    def simulator(scenario: Scenario, av_parameters: Mapping[str, str], history: int) -> Simulator:
        from cosim.simulation.shared import ServingSimulator

        return ServingSimulator(scenario, port, clients, av_parameters=av_parameters, history=history)

    return simulator


def joining(client: Any) -> SimulatorFactory:
    """The SUMO of a joined `cosim.simulation.client.Client`."""

    def simulator(scenario: Scenario, av_parameters: Mapping[str, str], history: int) -> Simulator:
        from cosim.simulation.shared import TraciSimulator

        return TraciSimulator(scenario, client, av_parameters=av_parameters, history=history)

    return simulator
