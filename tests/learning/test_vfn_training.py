"""Learning: what is recorded is what was seen, returns are what equation (2) says, a tiny world is solved,
the same seed twice gives the same losses, and a killed run goes on exactly."""

from __future__ import annotations

import json
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cosim.episode import Episode
from cosim.errors import BadInput
from cosim.learning.rollouts import drive_episode
from cosim.rewards import RewardConfig
from cosim.scenario import Mission, Scenario
from cosim.seeding import generator
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import SMOKE, MetaAction
from policy.agents.approaches import AgentConfig
from policy.chain.chain import ChainConfig
from policy.inputs.situation import SITUATION_INPUTS
from policy.inputs.tensors import KINEMATIC_INPUTS
from policy.networks.vfn import VfnConfig
from policy.safety import SafetyConfig
from policy.training import experience
from policy.training.a2c import A2cConfig, A2cLearner
from policy.training.curriculum import (
    Drive,
    DriveResult,
    Lesson,
    VfnTraining,
)
from policy.training.ddqn import DdqnConfig, DdqnLearner
from policy.training.experience import Trajectory
from policy.training.explorer import ExploreConfig, Explorer
from policy.training.replay_buffer import ReplayBuffer, ReplayConfig
from policy.training.vfn import TrainingRun

torch.set_num_threads(1)
TINY = VfnConfig(height=8, width=16, frames=3, rows=2, features=(4, 4, 4), hidden=16, joined=32, kinematic=32)
STEADY = 1  # frames per decision of the hand-made trajectories


def trajectory(
    actions: list[int],
    terms: list[tuple[float, float, float]],
    *,
    situation: list[int] | None = None,
    unsafe: np.ndarray | None = None,
    ending: str = "cut",
    vetoed: list[int] | None = None,
    near: bool = True,
) -> Trajectory:
    """A drive whose states differ in one number of the situation: `situation` [D+1]."""
    d = len(actions)
    states = np.zeros((d + 1, SITUATION_INPUTS), np.float32)
    for t, place in enumerate(situation or range(d + 1)):
        states[t, place] = 1.0
    return Trajectory(
        episode="hand",
        av="av",
        stride=STEADY,
        frames=np.arange(3 + d, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 8, 16), np.uint8),
        ahead=np.zeros((d + 1, 0, 4, 8, 16), np.uint8),
        kinematics=np.zeros((d + 1, 3, 2, KINEMATIC_INPUTS), np.float16),
        situation=states,
        unsafe=np.zeros((d + 1, 5), np.bool_) if unsafe is None else unsafe,
        action=np.array(actions, np.int8),
        vetoed=np.array(vetoed or [-1] * d, np.int8),
        terms=np.array(terms, np.float32),
        interacting=np.full(d, near),
        phi=0.0,
        ending=ending,  # type: ignore[arg-type]
    )


def only(config: ReplayConfig, one: Trajectory, seed: int = 0) -> tuple[ReplayBuffer, object]:
    replay = ReplayBuffer(config)
    replay.add([one])
    return replay, replay.sample(np.random.default_rng(seed))


def test_an_n_step_return_is_the_discounted_sum_and_stops_at_a_crash() -> None:
    terms = [(1.0, 10.0, 100.0), (2.0, 20.0, 200.0), (4.0, 40.0, 400.0), (8.0, 80.0, 800.0)]
    config = ReplayConfig(batch=200, n_step=3, gamma=0.5, relabel=0.0)
    for ending, bootstrap in (("crashed", 0.0), ("cut", 0.125), ("left", 0.125)):
        _, batch = only(config, trajectory([1, 1, 1, 1], terms, ending=ending))
        start = batch.now.situation.argmax(1).numpy()
        expected = {0: 1 + 1 + 1, 1: 2 + 2 + 2, 2: 4 + 4, 3: 8}  # phi = 0: the ego's terms alone
        assert set(start) == {0, 1, 2, 3}
        for b, t in enumerate(start):
            assert batch.reward[b] == pytest.approx(expected[t])
            # from 0 the third state is still driving; from 1 on the drive's end is reached
            steps = min(3, 4 - t)
            assert batch.discount[b] == pytest.approx(0.5**steps if t == 0 or ending != "crashed" else 0.0)
        assert batch.discount[start == 1][0] == pytest.approx(bootstrap)


def test_relabelling_learns_for_another_orientation_than_was_driven() -> None:
    config = ReplayConfig(batch=300, n_step=1, relabel=1.0)
    _, batch = only(config, trajectory([1], [(1.0, 10.0, 100.0)]))
    cos, sin = batch.now.phi.numpy().T
    assert batch.reward.numpy() == pytest.approx(cos + 110.0 * sin, rel=1e-5)
    phi = np.degrees(np.arctan2(sin, cos))
    assert (phi.min() < 5.0, phi.max() > 85.0) == (True, True)


def test_rare_moments_have_their_share_of_a_batch() -> None:
    far, near = trajectory([1] * 30, [(0, 0, 0)] * 30, near=False), trajectory([4], [(0, 0, 0)])
    replay = ReplayBuffer(ReplayConfig(batch=100, interaction=0.25))
    replay.add([far, near])
    actions = replay.sample(np.random.default_rng(0)).action
    assert [(actions == a).sum() for a in (4, 1)] == [25, 75]


def test_the_oldest_drives_are_forgotten_first() -> None:
    replay = ReplayBuffer(ReplayConfig(capacity=25))
    dropped = [replay.add([trajectory([k] * 10, [(0, 0, 0)] * 10)]) for k in range(5)]
    assert dropped == [0, 0, 1, 1, 1]
    assert replay.size == 20
    assert {int(t.action[0]) for t in replay.trajectories} == {3, 4}


def test_a_state_is_its_own_frames_and_no_other() -> None:
    one = trajectory([1, 1, 1], [(0, 0, 0)] * 3)
    maps = experience.states([(one, 0), (one, 2)], np.zeros(2, np.float32)).maps
    assert maps[:, :, 0, 0, 0].tolist() == [[0, 1, 2], [2, 3, 4]]


def test_a_corridor_is_walked_to_its_end() -> None:
    """Five places; accelerating leads on, anything else back; only the end pays. One-step returns."""
    rng, drives = np.random.default_rng(3), []
    for _ in range(60):
        place, situation, actions, terms = 0, [0], [], []
        while place < 4 and len(actions) < 20:
            action = int(MetaAction.ACCELERATE if rng.random() < 0.5 else rng.integers(5))
            place = place + 1 if action == MetaAction.ACCELERATE else max(place - 1, 0)
            actions.append(action)
            situation.append(place)
            terms.append((10.0 if place == 4 else 0.0, 0.0, 0.0))
        ending = "crashed" if place == 4 else "cut"  # the end is terminal
        drives.append(trajectory(actions, terms, situation=situation, ending=ending))
    replay = ReplayBuffer(ReplayConfig(batch=64, n_step=1, gamma=0.9, relabel=0.0))
    replay.add(drives)
    learner = DdqnLearner(TINY, DdqnConfig(learning_rate=3e-3, target_every=20), seed=0)
    draws = np.random.default_rng(0)
    for _ in range(250):
        losses = learner.update(replay.sample(draws))
    eye = torch.zeros(4, SITUATION_INPUTS)
    eye[range(4), range(4)] = 1.0
    with torch.no_grad():
        q = learner.online(
            torch.full((4, 3, 4, 8, 16), 3.0 / 255.0),
            torch.zeros(4, 3, 2, KINEMATIC_INPUTS),
            eye,
            torch.tensor([[1.0, 0.0]] * 4),
        )
    assert q.argmax(1).tolist() == [MetaAction.ACCELERATE] * 4
    assert q.max(1).values.tolist() == pytest.approx([0.9**3, 0.9**2, 0.9, 1.0], abs=0.15)  # reward x 0.1
    assert losses["td"] < 0.01


def test_what_the_prioritizer_masks_is_not_hoped_for() -> None:
    """The next state's best action is masked: its value must not enter the target."""
    unsafe = np.zeros((2, 5), np.bool_)
    unsafe[1, 3] = True
    one = trajectory([1], [(0.0, 0.0, 0.0)], unsafe=unsafe)
    learner = DdqnLearner(replace(TINY, dueling=False), DdqnConfig(), seed=1)
    for network in (learner.online, learner.target):
        with torch.no_grad():
            network.value.weight.zero_()
            network.value.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 100.0, 2.0]))
    _, batch = only(ReplayConfig(batch=8, n_step=1, gamma=0.5, relabel=0.0), one)
    td = learner.update(batch)["td"]
    assert td == pytest.approx(0.5 * 1.0**2)  # goal 0.5 * 2 against q = 0; with the masked one it were 49.5


def test_a_refused_action_is_worth_a_crash() -> None:
    one = trajectory([1], [(0.0, 0.0, 0.0)], vetoed=[3])
    learner = DdqnLearner(TINY, DdqnConfig(learning_rate=1e-2), seed=1)
    _, batch = only(ReplayConfig(batch=8, n_step=1, relabel=0.0), one)
    for _ in range(150):
        learner.update(batch)
    with torch.no_grad():
        q = learner.online(*batch.now)[0]
    assert q[3].item() == pytest.approx(-0.5, abs=0.05)
    assert q[1].item() > -0.1


def test_saved_and_loaded_a_learner_goes_on_exactly(tmp_path: Path) -> None:
    one = trajectory([1, 3, 4, 0], [(1, 2, 3)] * 4)
    replay, _ = only(ReplayConfig(batch=8), one)
    first = DdqnLearner(TINY, DdqnConfig(target_every=3), seed=2)
    draws = np.random.default_rng(1)
    for _ in range(4):
        first.update(replay.sample(draws))
    second = DdqnLearner(TINY, DdqnConfig(target_every=3), seed=9)
    second.restore(first.tensors())
    second.updates = first.updates
    batches = [replay.sample(draws) for _ in range(4)]
    assert [first.update(b) for b in batches] == [second.update(b) for b in batches]
    experience.save(tmp_path / "a.npz", [one])
    again = experience.load(tmp_path / "a.npz")[0]
    for name, value in vars(one).items():
        assert np.array_equal(value, getattr(again, name)), name


def agent(learners: int = 2) -> Explorer:
    chain = ChainConfig(source="gp_raster")
    vfn = VfnConfig(height=16, frames=14, features=(4, 8, 8), hidden=16, joined=16, kinematic=16)
    config = AgentConfig(observation=SMOKE, chain=chain, vfn=vfn, safety=SafetyConfig())
    return Explorer("vfn-p", config, ExploreConfig(learners=learners))


def fake_episode(*vehicles: FakeVehicle) -> Episode:
    scenario = Scenario(
        name="fake",
        config=Path(__file__),
        net=Path(__file__),
        demand=(),
        duration=8.0,
        mission=Mission(kind="none"),
    )
    return Episode(scenario, FakeSimulator(vehicles, length=3000.0), SMOKE)


class Recording(Explorer):
    """Keeps every map it was shown, to compare."""

    def reset(self, context):  # type: ignore[no-untyped-def]
        self.seen = []
        super().reset(context)

    def decide(self, histories):  # type: ignore[no-untyped-def]
        self.seen.append({name: h.velocity_map.copy() for name, h in histories.items()})
        return super().decide(histories)


def test_what_is_stored_is_what_was_seen() -> None:
    one = agent()
    one.__class__ = Recording
    episode = fake_episode(
        FakeVehicle("a", 100.0, 0, 20.0, is_av=True),
        FakeVehicle("b", 150.0, 1, 20.0, is_av=True),
        FakeVehicle("h", 200.0, 0, 15.0),
    )
    drove = drive_episode(episode, one, Drive(Lesson("fake"), 5, 0.7, 0.5, "", "", True), RewardConfig())
    assert {t.av for t in drove.trajectories} == {"a", "b"}
    for t in drove.trajectories:
        assert len(t) == 20  # 8 s of decisions
        assert t.ending == "cut"
        assert t.phi == pytest.approx(0.7)
        for k in range(21):
            assert np.array_equal(t.maps(k)[0], one.seen[k][t.av])
        assert (t.terms[:, 0] > 0).all()  # it drove


def test_what_is_drawn_is_kept_and_learned_from_once() -> None:
    one = agent()
    one.explore = ExploreConfig()
    episode = fake_episode(FakeVehicle("a", 100.0, 0, 20.0, is_av=True))
    (drove,) = drive_episode(
        episode, one, Drive(Lesson("fake"), 5, 0.7, 0.5, "", "", True, keep=4), RewardConfig()
    ).trajectories
    preferred = [int(a if v < 0 else v) for a, v in zip(drove.action, drove.vetoed, strict=True)]
    blocks = np.reshape(preferred, (5, 4))  # 20 decisions
    assert (blocks == blocks[:, :1]).all()
    assert len(set(blocks[:, 0])) > 1
    learner = A2cLearner(replace(TINY, critic=True), A2cConfig(keep=4, n_step=8, batch=1, scale=1.0), seed=0)
    learner.learn([trajectory([1] * 10, [(1.0, 0.0, 0.0)] * 10, ending="crashed")], np.random.default_rng(0))
    assert learner.updates == 3, "decisions 0, 4 and 8"


def test_a_crashed_av_ends_its_drive_and_the_others_are_cut() -> None:
    one = agent()
    episode = fake_episode(
        FakeVehicle("a", 100.0, 0, 25.0, is_av=True),
        FakeVehicle("b", 400.0, 1, 20.0, is_av=True),
        FakeVehicle("wall", 112.0, 0, 0.0, desired=0.1),  # 7 m ahead at 25 m/s: nobody can stop
    )
    drove = drive_episode(episode, one, Drive(Lesson("fake"), 5, 0.7, 0.0, "", "", True), RewardConfig())
    ends = {t.av: t for t in drove.trajectories}
    assert drove.figures["crashed"] == 1.0
    assert ends["a"].ending == "crashed"
    assert ends["b"].ending == "cut"
    assert ends["a"].terms[-1, 0] < -3.0  # crash: -5, and what speed it had


class Pretend:
    """Actors whose drives are made up from the seed."""

    def submit(self, drive: Drive) -> Future[DriveResult]:
        rng = generator(drive.seed, "pretend")
        drives = []
        if drive.record:
            actions = [int(a) for a in rng.integers(5, size=12)]
            drives = [trajectory(actions, [tuple(x) for x in rng.random((12, 3))])]
        future: Future[DriveResult] = Future()
        future.set_result(DriveResult(drives, {"reward": float(rng.random()), "crashed": 0.0}))
        return future


SHORT = VfnTraining(
    iterations=9,
    episodes=2,
    updates=3,
    prefill=40,
    validate_every=3,
    validation=2,
    save_every=2,
    disseminate=3,
    batch=8,
    capacity=100,
    target_every=4,
)


def losses(folder: Path) -> list[dict[str, float]]:
    lines = [json.loads(x) for x in (folder / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if not k.endswith("_s")} for line in lines]


def test_a_killed_run_goes_on_exactly(tmp_path: Path) -> None:
    TrainingRun(SHORT, TINY, Pretend(), tmp_path / "whole").run()
    killed = TrainingRun(SHORT, TINY, Pretend(), tmp_path / "killed")

    def die(done: float, _: float) -> None:
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        killed.run(die)
    again = TrainingRun(SHORT, TINY, Pretend(), tmp_path / "killed")
    assert again.resume()
    assert again.iteration == 6  # the last checkpoint; iteration 6 is driven once more
    again.run()
    assert losses(tmp_path / "killed") == losses(tmp_path / "whole")
    assert len(losses(tmp_path / "whole")) == 9
    assert (tmp_path / "killed" / "best.safetensors").is_file()
    assert (
        len(list((tmp_path / "killed" / "replay").glob("*.npz"))) == 8
    )  # 8 drives of 12 fit in 100; what left the replay is deleted


def test_a_killed_a2c_run_goes_on_exactly_too(tmp_path: Path) -> None:
    config = replace(SHORT, iterations=6)
    critic = replace(TINY, critic=True, kinematic=0)
    TrainingRun(config, critic, Pretend(), tmp_path / "whole").run()
    killed = TrainingRun(config, critic, Pretend(), tmp_path / "killed")

    def die(done: float, _: float) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        killed.run(die)
    again = TrainingRun(config, critic, Pretend(), tmp_path / "killed")
    assert again.resume()
    again.run()
    assert losses(tmp_path / "killed") == losses(tmp_path / "whole")
    learned = [line for line in losses(tmp_path / "whole") if "loss/entropy" in line]
    assert [line["iteration"] for line in learned] == list(range(6))
    assert learned[0]["replay"] == 0
    assert learned[0]["loss/entropy"] == pytest.approx(np.log(5.0), abs=0.05)


@pytest.mark.parametrize(("normalize", "reward"), [(False, 10.0), (True, 0.01)])
def test_actor_and_critic_learn_which_action_pays(normalize: bool, reward: float) -> None:
    """One place, one decision: accelerating pays, everything else nothing. Drives follow the policy."""
    config = A2cConfig(learning_rate=3e-3, n_step=1, normalize=normalize)
    learner = A2cLearner(replace(TINY, critic=True), config, seed=0)
    rng = np.random.default_rng(0)
    for _ in range(40):
        with torch.no_grad():
            one = trajectory([0], [(0.0, 0.0, 0.0)])
            preference, _ = learner.online.actor_critic(
                *experience.states([(one, 0)], np.zeros(1, np.float32))
            )
        chances = preference.softmax(1)[0].double().numpy()
        actions = rng.choice(5, size=32, p=chances / chances.sum())
        pay = [(reward if a == MetaAction.ACCELERATE else 0.0, 0.0, 0.0) for a in actions]
        drives = [trajectory([int(a)], [p], ending="crashed") for a, p in zip(actions, pay, strict=True)]
        learner.learn(drives, rng)
    assert chances[MetaAction.ACCELERATE] > 0.9


def test_another_configuration_is_not_gone_on_with(tmp_path: Path) -> None:
    TrainingRun(replace(SHORT, iterations=2), TINY, Pretend(), tmp_path).run()
    other = TrainingRun(replace(SHORT, updates=5), TINY, Pretend(), tmp_path)
    with pytest.raises(BadInput, match="updates"):
        other.resume()


def test_a_run_with_other_options_is_not_gone_on_with(tmp_path: Path) -> None:
    TrainingRun(replace(SHORT, iterations=2), TINY, Pretend(), tmp_path).run()
    state = json.loads((tmp_path / "state.json").read_text())
    state["config"]["a2c"]["gone"] = state["config"]["a2c"].pop("keep")
    (tmp_path / "state.json").write_text(json.dumps(state))
    with pytest.raises(BadInput, match=r"a2c\.gone, a2c\.keep"):
        TrainingRun(SHORT, TINY, Pretend(), tmp_path).resume()


def test_values_that_are_apart_are_weighed_by_phi() -> None:
    """Accelerating pays oneself 2, decelerating the others 2: whoever minds them chooses otherwise."""
    rng, drives = np.random.default_rng(3), []
    pays = {MetaAction.ACCELERATE: (2.0, 0.0, 0.0), MetaAction.DECELERATE: (0.0, 1.0, 1.0)}
    for _ in range(60):
        action = int(rng.integers(5))
        terms = [pays.get(MetaAction(action), (0.0, 0.0, 0.0))]
        drives.append(trajectory([action], terms, situation=[0, 0], ending="crashed"))
    replay = ReplayBuffer(ReplayConfig(batch=64, n_step=1, relabel=1.0))
    replay.add(drives)
    learner = DdqnLearner(replace(TINY, parts=2), DdqnConfig(learning_rate=3e-3), seed=0)
    draws = np.random.default_rng(0)
    for _ in range(250):
        learner.update(replay.sample(draws))
    batch = replay.sample(draws)
    phi = torch.deg2rad(torch.tensor([0.0, 30.0, 60.0, 90.0]))
    now = batch.now._replace(phi=torch.stack([phi.cos(), phi.sin()], 1).repeat(16, 1))
    with torch.no_grad():
        apart, q = learner.online.part_values(*now)[:4], learner.online(*now)[:4]
    fast, slow = int(MetaAction.ACCELERATE), int(MetaAction.DECELERATE)
    assert q.argmax(1).tolist() == [fast, fast, slow, slow]
    assert apart[:, 0, fast].tolist() == pytest.approx([0.2] * 4, abs=0.05)  # reward x 0.1
    assert apart[:, 1, slow].tolist() == pytest.approx([0.2] * 4, abs=0.05)
