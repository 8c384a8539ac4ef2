"""The environments keep their promises to Gymnasium, PettingZoo and Stable-Baselines3, and to their user."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fake_worlds
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

import cosim
import cosim.envs
import sumo_scenarios
from cosim.envs.gym import SumoEnv
from cosim.envs.parallel import SumoParallelEnv, parallel_env
from cosim.envs.session import Session, StepResult
from cosim.errors import BadInput, SimulationCrashed
from cosim.types import KINEMATIC_FEATURES, SMOKE, MetaAction

FAST = {"observation": SMOKE, "timeout": 60.0}
Make = Callable[..., SumoEnv]


@pytest.fixture(scope="module")
def env() -> Iterator[SumoEnv]:
    """One Gymnasium environment on the fake platoon, shared by the tests that only reset and step."""
    env = SumoEnv(fake_worlds.scenario(), simulator=fake_worlds.platoon, **FAST)
    yield env
    env.close()


@pytest.fixture
def make() -> Iterator[Make]:
    """`make(simulator, ...)`: environments that are closed when the test is over.

    In this process unless `worker=True`: what an episode means does not hang on where it runs.
    """
    made: list[SumoEnv] = []

    def build(simulator: object, duration: float = 4.0, **words: Any) -> SumoEnv:
        words = FAST | {"worker": False} | words
        made.append(SumoEnv(fake_worlds.scenario(duration), simulator=simulator, **words))
        return made[-1]

    yield build
    for env in made:
        env.close()


def play(env: SumoEnv, seed: int, actions: list[int]) -> list[Any]:
    """Everything an episode says, as plain data."""
    said: list[Any] = [env.reset(seed=seed)]
    for action in actions:
        said.append(env.step(np.int64(action)))
        if said[-1][2] or said[-1][3]:
            break
    return said


def same(a: Any, b: Any) -> bool:
    """Equal to the last bit."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


# ---- the checkers the field trusts ----


@pytest.mark.parametrize("flatten", [None, "kinematics"])
def test_gymnasium_and_stable_baselines_accept_the_environment(make: Make, flatten: str | None) -> None:
    env = make(fake_worlds.platoon, flatten=flatten, render_mode="rgb_array")
    with warnings.catch_warnings():  # "no spec": it was not made by gymnasium.make
        warnings.filterwarnings("ignore", message=".*spec.*")
        check_env(env)
    check_env_of_sb3(env, warn=flatten is not None)


@pytest.mark.parametrize("padded", [False, True])
def test_pettingzoo_accepts_the_parallel_environment(padded: bool) -> None:
    words = {"simulator": fake_worlds.platoon, "max_agents": 5 if padded else 3, "padded": padded, **FAST}

    def build() -> SumoParallelEnv:
        return parallel_env(fake_worlds.scenario(), **words)

    env = build()
    parallel_api_test(env, num_cycles=30)
    env.close()
    parallel_seed_test(build, num_cycles=30)


def numbers(value: object) -> bool:
    """Whether numbers are all that it holds."""
    if isinstance(value, dict):
        return all(map(numbers, value.values()))
    return np.issubdtype(np.asarray(value).dtype, np.number) or isinstance(value, bool)


@pytest.mark.parametrize("padded", [False, True])
def test_what_a_decision_says_is_numbers_and_valid_has_one_axis(make: Make, padded: bool) -> None:
    env = make(fake_worlds.platoon)
    seen, _ = env.reset(seed=1)
    assert seen["valid"].shape == (SMOKE.frames * SMOKE.rows,) == env.observation_space["valid"].shape
    assert seen["valid"].reshape(SMOKE.frames, SMOKE.rows)[-1, :4].tolist() == [1, 1, 1, 0]  # of three AVs
    assert numbers(env.step(np.int64(1))[-1])
    words = {"simulator": fake_worlds.platoon, "worker": False, "max_agents": 5, "padded": padded, **FAST}
    several = parallel_env(fake_worlds.scenario(), **words)
    assert numbers(several.reset(seed=1)[1])
    assert several.vehicles == {"av_0": "a", "av_1": "b", "av_2": "c"}
    assert numbers(several.step(dict.fromkeys(several.agents, 1))[-1])
    several.close()


def test_agents_without_a_vehicle_wait_from_the_reset_on_where_it_is_padded() -> None:
    with_fake = {"simulator": fake_worlds.short_road, "max_agents": 4, "worker": False, **FAST}
    env = parallel_env(fake_worlds.scenario(), padded=True, **with_fake)
    seen, infos = env.reset(seed=1)
    waiting = ["av_2", "av_3"]  # two AVs are all that ever drive
    assert env.agents == ["av_0", "av_1", *waiting]
    assert [*env.vehicles] == ["av_0", "av_1"]
    gone: dict[str, int] = {}
    for step in range(1, 12):
        assert all(not value.any() for agent in waiting for value in seen[agent].values())
        assert all(env.observation_space(agent).contains(seen[agent]) for agent in seen)
        assert all(infos[agent]["action_mask"].tolist() == [0, 1, 0, 0, 0] for agent in waiting)
        seen, rewards, terminated, truncated, infos = env.step(dict.fromkeys(env.agents, 3))
        assert [rewards[agent] for agent in waiting] == [0.0, 0.0]
        gone |= {a: step for a in seen if terminated[a] or truncated[a]}
        if not env.agents:
            break
    assert gone["av_0"] < gone["av_1"] == gone["av_2"] == gone["av_3"] == 10, "the episode's 4 s of 0.4 s"
    env.close()


def test_without_any_av_a_padded_environment_says_so_too() -> None:
    env = parallel_env(
        fake_worlds.scenario(), simulator=fake_worlds.nobody, worker=False, padded=True, **FAST
    )
    with pytest.raises(BadInput, match="no AV was ever on the road"):
        env.reset(seed=1)
    env.close()


def test_the_checkers_accept_continuous_actions(make: Make) -> None:
    env = make(fake_worlds.platoon, continuous=True)
    with warnings.catch_warnings():  # Gymnasium would rather have actions from -1 to 1 than m/s2
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        check_env(env, skip_render_check=True)
    several = parallel_env(
        fake_worlds.scenario(), simulator=fake_worlds.platoon, worker=False, continuous=True, **FAST
    )
    several.reset(seed=1)
    several.step({agent: several.action_space(agent).sample() for agent in several.agents})
    several.close()


def test_an_acceleration_is_carried_out(make: Make) -> None:
    env = make(fake_worlds.platoon, continuous=True)
    env.reset(seed=1)
    session = env.session
    row = session.snapshot().row[env.learner]
    before = session.snapshot().speed[row]
    env.step(np.array([-2.0, 0.3], np.float32))
    assert session.snapshot().speed[row] == pytest.approx(before - 2.0 * 0.4)
    session.act({env.learner: (1.0, 0)})
    assert session.snapshot().speed[row] == pytest.approx(before - 2.0 * 0.4 + 1.0 * 0.4)
    for action in ((np.nan, 0), (1.0, 2), (1.0,), ("a", 0)):
        with pytest.raises(BadInput, match="is no continuous action"):
            session.act({env.learner: action})


def test_every_world_is_registered() -> None:
    names = {name for name in gymnasium.registry if name.startswith("cosim/")}
    assert names == {f"cosim/{world.capitalize()}-v0" for world in (*sumo_scenarios.names(), "sumo")}


# ---- seeds ----


def test_the_same_seed_and_actions_twice_are_bit_identical(env: SumoEnv) -> None:
    actions = [3, 0, 1, 4, 2, 1, 1, 1, 1, 1]
    first = play(env, 7, actions)
    play(env, 8, [1, 1, 1])
    assert same(first, play(env, 7, actions))
    assert first[-1][4]["trace_hash"] != play(env, 9, actions)[-1][4]["trace_hash"]


def test_without_a_seed_episodes_are_drawn_from_the_training_seeds(env: SumoEnv) -> None:
    env.reset(seed=1)
    drawn = [env.reset()[1]["seed"] for _ in range(5)]
    env.reset(seed=1)
    assert drawn == [env.reset()[1]["seed"] for _ in range(5)]
    assert len(set(drawn)) == 5
    assert all(0 <= seed < 100_000 for seed in drawn)


def test_two_environments_side_by_side_do_not_disturb_each_other(env: SumoEnv, make: Make) -> None:
    alone = play(env, 3, [3, 3, 1, 1])
    other = make(fake_worlds.platoon, worker=True)
    said_here, said_there = [env.reset(seed=3)], [other.reset(seed=4)]
    for here, there in zip([3, 3, 1, 1], [4, 4, 0, 1], strict=True):
        said_here.append(env.step(np.int64(here)))
        said_there.append(other.step(np.int64(there)))
    assert same(said_here, alone)
    assert same(said_there, play(env, 4, [4, 4, 0, 1]))
    assert other.session.pid != env.session.pid


# ---- what the episode means ----


def test_the_duration_truncates_and_brings_the_metrics(env: SumoEnv) -> None:
    said = play(env, 1, [1] * 20)
    _, _, terminated, truncated, info = said[-1]
    assert (len(said), terminated, truncated, info["ended"]) == (11, False, True, "duration")  # 4 s of 0.4 s
    assert info["episode_metrics"]["crashed"] is False
    assert info["episode_metrics"]["dt_mean_m"] == pytest.approx(80.0, abs=5.0)  # 4 s at about 20 m/s
    assert [*info["reward_terms"]] == ["ego", "av_social", "hv_social", "total"]


def test_the_learners_crash_terminates(make: Make) -> None:
    env = make(fake_worlds.wall, learner="a")
    said = play(env, 1, [1] * 10)
    _, reward, terminated, truncated, info = said[-1]
    assert (terminated, truncated, info["ended"]) == (True, False, "collision")
    assert reward < 0 < said[-2][1]
    assert info["episode_metrics"]["crashed"] is True


def test_a_learner_that_brakes_does_not_crash(make: Make) -> None:
    env = make(fake_worlds.wall, learner="a")
    env.reset(seed=1)
    *_, info = play(env, 1, [4] * 10)[-1]
    assert info["ended"] == "duration"


def test_the_crash_of_another_av_truncates(make: Make) -> None:
    from policy.agents.keep_lane import KeepLane

    env = make(fake_worlds.wall, learner="b", others=KeepLane)
    _, _, terminated, truncated, info = play(env, 1, [1] * 10)[-1]
    assert (terminated, truncated, info["ended"]) == (False, True, "collision of another AV")


def test_a_learner_that_leaves_the_road_truncates(make: Make) -> None:
    env = make(fake_worlds.short_road, learner="a")
    said = play(env, 1, [1] * 10)
    _, _, terminated, truncated, info = said[-1]
    assert (terminated, truncated, info["ended"]) == (False, True, "arrived")
    assert env.observation_space.contains(said[-1][0])


def test_without_any_av_the_error_says_how_to_get_one(make: Make) -> None:
    with pytest.raises(BadInput, match=r"no AV was ever on the road.*penetration"):
        make(fake_worlds.nobody).reset(seed=1)
    with pytest.raises(BadInput, match=r"learner='nobody'.*never on the road"):
        make(fake_worlds.platoon, learner="nobody").reset(seed=1)


def test_the_mask_forbids_lane_changes_off_the_road_and_during_a_change(make: Make) -> None:
    env = make(fake_worlds.platoon, learner="a")
    _, info = env.reset(seed=1)
    assert info["action_mask"].tolist() == [1, 1, 0, 1, 1]  # a drives on the right lane of two
    *_, info = env.step(np.int64(MetaAction.LANE_RIGHT))
    assert not info["executed"]
    assert env.session.receipts["a"].blocked == "no lane on that side"
    *_, info = env.step(np.int64(MetaAction.LANE_LEFT))
    assert info["executed"]
    assert info["action_mask"].tolist() == [0, 1, 0, 1, 1]
    *_, info = env.step(np.int64(MetaAction.LANE_LEFT))
    assert env.session.receipts["a"].blocked == "a lane change is under way"
    for _ in range(4):
        *_, info = env.step(np.int64(MetaAction.IDLE))
    assert info["action_mask"].tolist() == [0, 1, 1, 1, 1]


def test_a_session_takes_none_for_sumo_and_refuses_what_is_no_whole_number() -> None:
    words = {"simulator": fake_worlds.short_road, "worker": False, **FAST}
    with cosim.open(fake_worlds.scenario(), **words) as session:
        views = session.reset(1)
        first = next(iter(views))
        assert session.act({first: None}).receipts == {}
        assert list(session.act({first: np.int64(1)}).receipts) == [first]
        with pytest.raises(BadInput, match="is no meta-action"):
            session.act({first: 1.0})  # type: ignore[dict-item]


def test_agents_that_are_none_are_refused_and_so_is_a_step_before_the_reset() -> None:
    with_fake = {"simulator": fake_worlds.short_road, "max_agents": 2, "worker": False, **FAST}
    env = parallel_env(fake_worlds.scenario(), **with_fake)
    with pytest.raises(BadInput, match="call reset first"):
        env.step({})
    env.reset(seed=1)
    with pytest.raises(BadInput, match="actions='ghost': no such agent"):
        env.step({"ghost": 1})
    env.close()


def test_agents_leave_one_by_one() -> None:
    with_fake = {"simulator": fake_worlds.short_road, "max_agents": 2, "worker": False, **FAST}
    env = parallel_env(fake_worlds.scenario(), **with_fake)
    env.reset(seed=1)
    assert env.agents == ["av_0", "av_1"]
    gone: dict[str, str] = {}
    while env.agents:
        _, _, terminated, truncated, infos = env.step(dict.fromkeys(env.agents, 1))
        gone |= {a: infos[a]["ended"] for a in infos if terminated[a] or truncated[a]}
        assert not any(terminated.values()), "who leaves the road is cut short: no state is worth 0 for that"
        assert truncated.get("av_0", False) == (gone.get("av_0") == "arrived" and "av_0" in truncated)
    assert gone == {"av_0": "arrived", "av_1": "duration"}
    env.close()


# ---- the session underneath ----


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    with cosim.open(fake_worlds.scenario(), simulator=fake_worlds.platoon, **FAST) as session:
        yield session


def drive(session: Session, seed: int, action: MetaAction, steps: int) -> StepResult:
    session.reset(seed)
    for _ in range(steps):
        result = session.act(dict.fromkeys(session.observe(), action))
    return result


def test_maps_that_crossed_piecewise_are_what_the_simulation_drew(session: Session) -> None:
    steps = 7
    whole = drive(session, 1, MetaAction.IDLE, steps).observations
    views = session.reset(1)
    for k in range(steps):  # `see` nobody until the last step: then the maps cross whole
        last = k == steps - 1
        views = session.act(dict.fromkeys(session.avs, 1), see=None if last else ()).observations
    assert views.keys() == whole.keys() == {"a", "b", "c"}
    assert all(same(views[name], whole[name]) for name in views)
    assert all(view.velocity_map.any() for view in whole.values())


def test_a_view_knows_its_lanes_ahead(session: Session) -> None:
    view = session.reset(1)["a"]
    assert view.lane_exists.tolist() == [True, True, False]
    assert view.centre_lines[1, :, 0] == pytest.approx(np.arange(0, 101, 10), abs=0.01)
    assert view.centre_lines[0, :, 1] == pytest.approx(3.2)
    assert view.kinematics[-1, 0, KINEMATIC_FEATURES.index("speed")] == pytest.approx(view.ego_speed)
    assert view.to_dead_end.tolist() == [np.inf, np.inf, 0.0]


def test_an_action_for_nobody_or_no_action_is_refused(session: Session) -> None:
    session.reset(1)
    with pytest.raises(BadInput, match=r"actions='aa': no AV of that name.*'a'"):
        session.act({"aa": 1})
    with pytest.raises(BadInput, match="a=9: is no meta-action"):
        session.act({"a": 9})
    with pytest.raises(BadInput, match="no AV of that name"):
        session.act({"human": 1})


def test_after_the_end_the_next_act_asks_for_a_reset(session: Session) -> None:
    drive(session, 1, MetaAction.IDLE, 10)
    assert session.over
    with pytest.raises(BadInput, match="the episode is over: call reset"):
        session.act({})


def test_opening_nonsense_names_what_is_wrong() -> None:
    with pytest.raises(BadInput, match="svo=91"):
        cosim.open("merge", svo=91)
    with pytest.raises(BadInput, match=r"no such scenario.*merge"):
        cosim.open("merg")
    with pytest.raises(BadInput, match=r"demand.*contested"):
        cosim.open("merge", demand="contestd")


# ---- processes ----


def test_a_killed_simulation_is_noticed_and_the_next_reset_starts_afresh(make: Make) -> None:
    env = make(fake_worlds.platoon, worker=True)
    before = play(env, 5, [1, 1])
    pid = env.session.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(SimulationCrashed, match="SIGKILL"):
        env.step(np.int64(1))
    assert same(play(env, 5, [1, 1]), before)
    assert env.session.pid not in (None, pid)


def test_a_simulation_that_dies_by_itself_says_how(make: Make) -> None:
    env = make(fake_worlds.dying, worker=True)
    env.reset(seed=1)
    with pytest.raises(SimulationCrashed, match="SIGABRT"):
        env.step(np.int64(1))


def test_a_simulation_that_hangs_is_killed_after_its_timeout(make: Make) -> None:
    env = make(fake_worlds.hanging, worker=True)
    env.reset(seed=1)
    pid = env.session.pid
    env.session._caller._timeout = 0.5  # type: ignore[union-attr] - the start needs longer than this test
    began = time.monotonic()
    with pytest.raises(SimulationCrashed, match=r"no heartbeat for 0.5 s"):
        env.step(np.int64(1))
    assert time.monotonic() - began < 30.0
    assert not Path(f"/proc/{pid}").exists()


def test_closing_leaves_no_process_and_no_descriptor_behind(make: Make) -> None:
    make(fake_worlds.platoon, worker=True).close()  # what a first one opens for the whole process stays
    descriptors = len(os.listdir("/proc/self/fd"))
    env = make(fake_worlds.platoon, worker=True)
    pid = env.session.pid
    env.reset(seed=1)
    env.close()
    env.close()
    assert not Path(f"/proc/{pid}").exists()
    assert len(os.listdir("/proc/self/fd")) <= descriptors
    with pytest.raises(BadInput, match="closed"):
        env.reset(seed=1)


def test_fifty_resets_leak_neither_memory_nor_descriptors(env: SumoEnv) -> None:
    def in_use() -> tuple[int, int]:
        resident = int(Path(f"/proc/{env.session.pid}/statm").read_text().split()[1]) * 4096
        return len(os.listdir("/proc/self/fd")) + len(os.listdir(f"/proc/{env.session.pid}/fd")), resident

    play(env, 0, [1] * 3)
    descriptors, memory = in_use()
    for seed in range(50):
        play(env, seed, [1, 1])
    assert in_use()[0] == descriptors
    assert in_use()[1] - memory < 8e6  # bytes


def test_a_daemonic_process_runs_the_simulation_itself() -> None:
    """gymnasium's AsyncVectorEnv and SB3's SubprocVecEnv put environments into processes without children."""
    words = {"simulator": fake_worlds.platoon, "flatten": "kinematics", **FAST}
    envs = gymnasium.vector.AsyncVectorEnv(
        [lambda: SumoEnv(fake_worlds.scenario(), **words)] * 2, context="spawn", daemon=True
    )
    seen, _ = envs.reset(seed=[1, 1])
    assert np.array_equal(seen[0], seen[1])
    envs.step(np.array([1, 1]))
    envs.close()


# ---- the package ----


def test_importing_cosim_is_light() -> None:
    heavy = "{'torch', 'libsumo', 'numba', 'gymnasium', 'numpy'}"
    code = f"import sys, cosim; print(sorted({heavy} & set(sys.modules)), sorted(cosim.__all__))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[] ['Session', 'StepResult', 'View', '__version__', 'open']"


@pytest.mark.parametrize("first", ["sys", "cosim", "gymnasium, cosim", "cosim.envs", "cosim.envs.gym"])
def test_gymnasium_finds_the_worlds_by_cosim_whichever_is_imported_first(first: str) -> None:
    code = (
        f"import {first}; from gymnasium.envs.registration import _find_spec as of;"
        "print(*(of(f'{where}cosim/Merge-v0').entry_point for where in ('cosim:', 'cosim.envs:', '')))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["cosim.envs.gym:SumoEnv"] * 3


def test_opening_a_session_loads_neither_sumo_nor_the_agent_here() -> None:
    code = (
        "import sys, cosim, cosim.envs.gym, cosim.envs.parallel;"
        "print(sorted({'torch', 'libsumo', 'numba', 'policy'} & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[]"
