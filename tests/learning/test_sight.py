"""The frame encoder: its labels are what stands on the map, it learns them, its latents stand for maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cosim.errors import BadInput
from cosim.learning.rollouts import drive_episode
from cosim.rewards import RewardConfig
from cosim.simulation.fake import FakeVehicle
from cosim.types import COMPACT, KINEMATIC_FEATURES, SMOKE
from policy import checkpoint
from policy.agents.approaches import AgentConfig, configure
from policy.chain.chain import ChainConfig
from policy.inputs.situation import PER_LANE, SITUATION_INPUTS
from policy.inputs.tensors import kinematic_tensor
from policy.networks.extractors import EncodedMaps
from policy.networks.frame_encoder import EncoderConfig
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import VFN, VfnConfig
from policy.training import sight
from policy.training.curriculum import Drive, Lesson, VfnTraining
from policy.training.ddqn import DdqnConfig, DdqnLearner
from policy.training.explorer import ExploreConfig, Explorer
from policy.training.replay_buffer import ReplayBuffer, ReplayConfig
from policy.training.sight import ALONG_SCALE, MAX_GAP, READINGS, SPEED_SCALE, Seen, SightTask
from policy.training.trainers import make_trainer
from tests.learning.test_vfn_training import TINY, fake_episode, trajectory

torch.set_num_threads(1)
SMALL = EncoderConfig(height=16, width=128, features=(4, 4, 4), latent=16)


def rows(*vehicles: tuple[float, float, float, float, float], heading: float = 0.0) -> np.ndarray:
    """[1,R,F+1] scaled: x, y, speed, is_av, is_mission of each, the ego first; all head as the ego does."""
    out = np.zeros((1, len(vehicles), len(KINEMATIC_FEATURES)), np.float32)
    for k, (x, y, speed, av, mission) in enumerate(vehicles):
        out[0, k] = x, y, speed, heading, 5.0, 1.8, av, mission
    return kinematic_tensor(out, np.ones(out.shape[:2], np.bool_)).numpy()


def read(values: np.ndarray, name: str) -> float:
    return float(values[0, READINGS.index(name)])


def test_a_band_tells_of_the_nearest_vehicle_ahead_and_behind() -> None:
    found = sight.bands(
        rows(
            (0, 0, 20, 1, 0),
            (30, 0.4, 15, 0, 0),
            (50, 0, 25, 0, 0),
            (-40, 3.2, 26, 0, 0),
            (10, -9.0, 0, 0, 1),
        )
    )
    assert read(found, "gap ahead, own band") == pytest.approx(30 / MAX_GAP, abs=1e-3)
    assert read(found, "speed ahead, own band") == pytest.approx(-5 / SPEED_SCALE, abs=1e-3)
    assert read(found, "gap behind, left band") == pytest.approx(40 / MAX_GAP, abs=1e-3)
    assert read(found, "speed behind, left band") == pytest.approx(6 / SPEED_SCALE, abs=1e-3)
    assert read(found, "gap ahead, right band") == 1.0, "nobody"
    assert read(found, "mission vehicle, presence") == 1.0
    assert read(found, "mission vehicle, along") == pytest.approx(10 / ALONG_SCALE, abs=1e-3)


def test_a_frame_later_is_seen_from_where_the_ego_is_then() -> None:
    """The rows stay in the frame of the newest perceived instant; a predicted map is drawn around the ego."""
    turned = rows((40, 20, 10, 1, 0), (40, 45, 12, 0, 0), heading=np.pi / 2)
    assert read(sight.bands(turned), "gap ahead, own band") == pytest.approx(25 / MAX_GAP, abs=1e-3)


def test_without_a_mission_vehicle_there_is_no_place_to_tell() -> None:
    found = sight.bands(rows((0, 0, 20, 1, 0), (30, 0, 15, 0, 0)))
    assert read(found, "mission vehicle, presence") == 0.0
    assert np.isnan(read(found, "mission vehicle, along"))


def test_the_lanes_are_those_of_the_situation() -> None:
    known = np.zeros((1, SITUATION_INPUTS), np.float32)
    known[0, 7 + PER_LANE + 0] = 1.0  # the own lane exists,
    known[0, 7 + PER_LANE + PER_LANE - 4] = 0.25  # and somebody is 25 m ahead in it
    found = np.full((1, len(READINGS)), np.nan)
    first = READINGS.index("existence, left lane")
    found[0, first : first + len(sight.LANES)] = sight.lanes(known)[0]
    assert read(found, "existence, own lane") == 1.0
    assert read(found, "gap ahead, own lane") == 0.25
    assert read(found, "existence, left lane") == 0.0


def test_it_learns_to_read_a_gap_off_the_map_and_nothing_off_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sight, "LEARNING_RATE", 3e-3)
    rng = np.random.default_rng(0)

    def drawn(count: int) -> Seen:
        maps, wanted = np.zeros((count, 4, 16, 128), np.uint8), np.full((count, len(READINGS)), np.nan)
        gaps = rng.integers(4, 60, count)
        for k, gap in enumerate(gaps):
            maps[k, 1, 7:9, 64 + gap : 67 + gap] = 140
        wanted[:, READINGS.index("gap ahead, own band")] = gaps / 60
        return Seen(maps, wanted.astype(np.float32), np.zeros(count, np.int64))

    task = SightTask(SMALL, 250, 0, drawn(600), drawn(100))
    for number in range(250):
        task.update(number)
    unseen = drawn(200)
    r2 = sight.explained(unseen.readings, sight.read_all(task.network, unseen.maps))
    assert set(r2) == {"gap ahead, own band"}, "what is never known has no R2"
    assert r2["gap ahead, own band"] > 0.8
    blind = sight.explained(unseen.readings, sight.read_all(task.network, np.zeros_like(unseen.maps)))
    assert blind["gap ahead, own band"] < 0.1, "it reads the map"
    sight.save(tmp_path / "e.safetensors", task.network, {}, {})
    again = sight.load(tmp_path / "e.safetensors", SMALL)
    assert all(torch.equal(a, b) for a, b in zip(again.parameters(), task.network.parameters(), strict=True))


def encoded(**changes: object) -> VfnConfig:
    sizes = VfnConfig(height=16, frames=14, hidden=16, joined=16, kinematic=16, extractor="frames", latent=16)
    return replace(sizes, **changes)  # type: ignore[arg-type]


def test_latents_stand_for_their_maps() -> None:
    torch.manual_seed(0)
    network = VFN(encoded()).eval()
    torch.nn.init.normal_(network.value.weight)
    maps = torch.randint(0, 256, (3, 14, 4, 16, 128), dtype=torch.uint8)
    rest = torch.rand(3, 14, 16, 9), torch.rand(3, SITUATION_INPUTS), torch.rand(3, 2)
    memory = network.memory(10, 2)
    assert memory is not None
    with torch.inference_mode():
        latents = memory.frames(["a", "b", "c"], maps).flatten(2)
        assert latents.shape == (3, 14, 16)
        assert torch.allclose(network(latents, *rest), network(maps, *rest), atol=1e-5)
        assert not torch.allclose(network(latents.roll(1, 0), *rest), network(maps, *rest), atol=1e-3)


def test_the_encoder_learns_no_more_and_the_rest_does() -> None:
    learner = DdqnLearner(encoded(frames=3, height=16, width=128, rows=2), DdqnConfig(), seed=0)
    before = {k: v.clone() for k, v in learner.online.state_dict().items()}
    one = trajectory([1, 3], [(1.0, 0.0, 0.0)] * 2)
    rng = np.random.default_rng(0)
    one = replace(one, frames=rng.random((5, 16)).astype(np.float16), ahead=np.zeros((3, 0, 16), np.float16))
    replay = ReplayBuffer(ReplayConfig(batch=8))
    replay.add([one])
    for _ in range(5):
        learner.update(replay.sample(rng))
    changed = {k for k, v in learner.online.state_dict().items() if not torch.equal(v, before[k])}
    assert "hidden.weight" in changed
    assert not any(name.startswith("maps.encoder") for name in changed)


def test_an_effect_is_seen_of_what_decides_and_of_nothing_else() -> None:
    learner = DdqnLearner(replace(TINY, dueling=False), DdqnConfig(), seed=0)
    one = trajectory([1] * 8, [(0, 0, 0)] * 8, situation=list(range(9)))
    replay = ReplayBuffer(ReplayConfig(batch=64, n_step=1, relabel=0.0))
    replay.add([one])
    q = torch.zeros(5, TINY.joined)
    torch.manual_seed(1)
    torch.nn.init.normal_(q)
    with torch.no_grad():  # values that follow from the joined layer, which hears the situation alone
        learner.online.value.weight.copy_(q)
        joined = learner.online.joined.weight
        joined[:, : TINY.hidden + 3 * TINY.kinematic] = 0.0
        joined[:, -2:] = 0.0
        for layer in (learner.online.situation[0], learner.online.situation[2]):
            torch.nn.init.normal_(layer.weight)
    found = learner.effects(replay.sample(np.random.default_rng(0)), 3)
    assert found["situation"] > 0.05
    assert {v for k, v in found.items() if k != "situation"} == {0.0}


def explorer(learners: int = 2) -> Explorer:
    config = AgentConfig(observation=SMOKE, chain=ChainConfig(source="gp_raster"), vfn=encoded())
    return Explorer("vfn-p", config, ExploreConfig(learners=learners))


def test_a_drive_stores_what_the_encoder_made_of_its_maps() -> None:
    one = explorer()
    episode = fake_episode(
        FakeVehicle("a", 100.0, 0, 20.0, is_av=True),
        FakeVehicle("b", 150.0, 1, 20.0, is_av=True),
        FakeVehicle("h", 200.0, 0, 15.0),
    )
    seen: list[dict[str, np.ndarray]] = []
    decide = one.decide
    one.decide = lambda h: seen.append({k: v.velocity_map.copy() for k, v in h.items()}) or decide(h)  # type: ignore[method-assign, func-returns-value]
    drove = drive_episode(episode, one, Drive(Lesson("fake"), 5, 0.7, 0.5, "", "", True), RewardConfig())
    assert isinstance(one.vfn.maps, EncodedMaps)
    assert {t.av for t in drove.trajectories} == {"a", "b"}
    for t in drove.trajectories:
        assert t.frames.dtype == np.float16
        assert t.ahead.shape == (21, 4, 16)
        for k in (0, 7, 20):
            with torch.inference_mode():
                wanted = one.vfn.maps.frames(torch.from_numpy(seen[k][t.av]))[..., 0, 0].numpy()
            assert np.allclose(t.maps(k)[0], wanted, atol=2e-3)


def test_a_network_with_an_encoder_wants_one_that_sees(tmp_path: Path) -> None:
    config = VfnTraining()
    with pytest.raises(BadInput, match="taught to see"):
        make_trainer(config, encoded(), "cpu")
    with pytest.raises(BadInput, match="missing weights file"):
        make_trainer(replace(config, encoder=str(tmp_path / "none.safetensors")), encoded(), "cpu")
    network = sight.Sight(EncoderConfig(16, 128, latent=16), len(READINGS))
    sight.save(tmp_path / "e.safetensors", network, {}, {})
    trainer = make_trainer(replace(config, encoder=str(tmp_path / "e.safetensors")), encoded(), "cpu")
    mine = trainer.learner.online.maps.encoder.state_dict()
    assert all(torch.equal(mine[k], v) for k, v in network.encoder.state_dict().items())


def test_the_shipped_encoder_is_the_one_of_the_shipped_configuration() -> None:
    card = json.loads((checkpoint.SHIPPED / "encoder.json").read_text())
    assert card["measured"]["R2 on tuning seeds"]["gap ahead, own lane"] > 0.9
    agent = configure("vfn-p", COMPACT, ChainConfig(), HpnConfig(), VfnConfig(extractor="frames"))
    assert sight.encoder("encoder", EncoderConfig(latent=agent.vfn.latent))
