"""Sessions and environments on real SUMO: the same episode through every interface."""

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

import cosim
import cosim.envs
from cosim.envs.parallel import parallel_env
from cosim.envs.session import Session
from cosim.episode import Episode
from cosim.host import Host
from cosim.scenario import Scenario, load
from cosim.simulation.sumo import SumoSimulator
from cosim.types import COMPACT, SMOKE, Decision, Kind, MetaAction
from cosim.workers.worker import Worker
from policy.agents import make

SEED = 200_011
DURATION = 6.0  # s


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    with cosim.open("merge", demand="contested", duration=DURATION) as session:
        yield session


class Loop:
    """The loop itself, without any environment around it; runs in a worker."""

    def __init__(self, scenario: Scenario) -> None:
        self._simulator = SumoSimulator(scenario, history=COMPACT.frames)
        self._episode = Episode(scenario, self._simulator, COMPACT)

    def drive(self, seed: int, plan: list[dict[str, int]]) -> str:
        self._episode.start(seed)
        for actions in plan:
            self._episode.advance({name: Decision(MetaAction(a)) for name, a in actions.items()})
        return self._episode.trace_hash()

    def close(self) -> None:
        self._simulator.close()


def test_an_episode_through_gymnasium_is_the_one_that_the_loop_drives() -> None:
    env: Any = gymnasium.make("cosim/Merge-v0", demand="contested", duration=DURATION)
    _, info = env.reset(seed=SEED)
    plan, over = [], False
    actions = iter([3, 3, 4, 1, 0, 1, 1, 4, 4, 3, 3, 1, 1, 1, 1, 1])
    while not over:
        action = next(actions)
        plan.append({info["learner"]: action} if not plan else {env.unwrapped.learner: action})
        *_, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    env.close()
    scenario = load("merge", demand=("contested",), duration=DURATION)
    with Worker(Loop, scenario) as worker:
        assert worker.call("drive", SEED, plan) == info["trace_hash"]
        assert worker.call("drive", SEED + 1, plan[:0]) != info["trace_hash"]


def test_drivers_err_alike_through_every_interface() -> None:
    """Draws are equal whoever drives: here nobody commands an AV."""
    asked: dict[str, Any] = {"demand": "contested", "duration": DURATION, "errors": "stress"}
    with cosim.open("merge", **asked) as session:
        session.reset(SEED)
        while not session.act({}).info["over"]:
            pass
        begun = [session.result().errors_begun]
    env = parallel_env("merge", **asked)
    env.reset(seed=SEED)
    while env.agents:
        env.step({})
    begun.append(env.session.result().errors_begun)
    env.close()
    with Worker(
        Host, load("merge", demand=("contested",), duration=DURATION, errors="stress"), "idm", 0.0
    ) as worker:
        begun.append(worker.call("run", SEED).errors_begun)
    assert len(begun[0]) > 3
    assert begun[0] == begun[1] == begun[2]


def test_both_checkers_accept_an_environment_on_sumo() -> None:
    env = gymnasium.make(
        "cosim/Merge-v0", demand="contested", duration=2.0, observation=SMOKE, render_mode="rgb_array"
    )
    check_env(env.unwrapped)
    check_env_of_sb3(env.unwrapped, warn=False)
    env.reset(seed=SEED)
    picture: Any = env.render()
    assert picture.shape == (160, 640, 3)
    middle = picture[80, 320]
    assert middle[2] > middle[0]  # the learner, blue, is in the middle
    env.close()


def test_avs_join_on_departure_in_the_parallel_environment() -> None:
    env = parallel_env("merge", demand="contested", duration=DURATION, flatten="kinematics", max_agents=24)
    with warnings.catch_warnings():  # slots whose AV departs after the episode's end, or never
        warnings.filterwarnings("ignore", message="No agents present but not all possible_agents")
        parallel_api_test(env, num_cycles=40)
    env.reset(seed=SEED)
    first = list(env.agents)
    assert first == [f"av_{k}" for k in range(len(first))]
    assert {env.vehicles[a] for a in first} == set(env.session.avs)
    everyone = set(first)
    while env.agents:
        _, rewards, *_ = env.step(dict.fromkeys(env.agents, int(MetaAction.IDLE)))
        everyone |= set(env.agents)
        assert all(np.isfinite(reward) for reward in rewards.values())
    assert len(everyone) > len(first)  # somebody departed meanwhile
    env.close()


def test_an_av_that_gets_no_action_is_driven_by_sumo_again(session: Session) -> None:
    views = session.reset(SEED)
    name = session.partner()
    for _ in range(5):
        step = session.act({name: MetaAction.DECELERATE})
    assert step.observations[name].target_speed == pytest.approx(0.0, abs=0.1)
    slow = step.observations[name].ego_speed
    for _ in range(5):
        step = session.act({})
    assert step.observations[name].ego_speed > slow + 1.0
    assert views[name].ego_speed > slow


def test_the_partner_meets_the_mission_vehicle(session: Session) -> None:
    views = session.reset(SEED)
    name = session.partner()
    snapshot = session.snapshot()
    (mission,) = np.flatnonzero(snapshot.mission)
    assert 0.0 < views[name].conflict_distance < np.inf
    assert snapshot.kind[mission] == Kind.HV
    # it is neither past the ramp nor far behind: it arrives within some seconds of the mission vehicle
    arrival = views[name].conflict_distance / views[name].ego_speed
    to_ramp = np.hypot(snapshot.x[mission], snapshot.y[mission])  # the acceleration lane begins at x = 0
    assert 0.0 <= arrival - to_ramp / snapshot.speed[mission] < 8.0


def test_two_sessions_live_side_by_side(session: Session) -> None:
    with cosim.open("merge", demand="contested", duration=DURATION, behavior="aggressive") as other:
        session.reset(SEED)
        other.reset(SEED)
        while not (session.over or other.over):
            session.act(dict.fromkeys(session.avs, MetaAction.IDLE))
            other.act(dict.fromkeys(other.avs, MetaAction.IDLE))
        together = session.result().trace_hash, other.result().trace_hash
    session.reset(SEED)
    while not session.over:
        session.act(dict.fromkeys(session.avs, MetaAction.IDLE))
    assert together[0] == session.result().trace_hash != together[1]


def test_others_are_driven_by_the_policy_that_was_handed_in() -> None:
    rule = partial(make, "keep-lane")
    with cosim.open("merge", demand="contested", duration=DURATION, others=rule) as session:
        views = session.reset(SEED)
        name = session.partner()
        step = session.act({name: MetaAction.DECELERATE})
        assert set(step.receipts) == set(views)  # everybody was commanded
        step = session.act({name: MetaAction.DECELERATE})
    assert step.observations[name].target_speed < min(
        view.target_speed for other, view in step.observations.items() if other != name
    )


@pytest.mark.parametrize(
    ("example", "arguments", "said"),
    [
        ("own_agent.py", [], r"(?s)sum of SVO rewards.*mission_success +(True|False)"),
        ("train_sb3_dqn.py", ["--steps", "60", "--episodes", "1"], r"(?s)before .*return.*after 60 steps"),
    ],
)
def test_the_examples_run(example: str, arguments: list[str], said: str) -> None:
    file = Path(__file__).parents[2] / "examples" / example
    run = subprocess.run([sys.executable, str(file), *arguments], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert re.search(said, run.stdout), run.stdout
