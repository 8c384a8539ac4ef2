"""The whole prediction-aware agent on a small scene: explained, repeatable, strict about its input."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from policy_scenes import Car, histories, straight_road

from cosim.errors import BadInput
from cosim.learning.configuration import configuration
from cosim.types import COMPACT, PAPER, SMOKE, Decision, MetaAction, PolicyContext, Timing
from policy.agents import APPROACHES, TRAINABLE
from policy.agents.approaches import AgentConfig, compact, paper
from policy.agents.prediction_aware import PredictionAware
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import VfnConfig
from policy.training.config import agent_config

ROAD = straight_road(3)
CARS = [
    Car("a", 300.0, 1, 20.0, is_av=True),
    Car("b", 250.0, 0, 20.0, is_av=True),
    Car("slow", 328.0, 1, 8.0),
    Car("new", 270.0, 2, 20.0, frames=1),
]


def context(agent: PredictionAware, svo: float = 0.0) -> PolicyContext:
    return PolicyContext(ROAD, Timing(), agent.observation, svo, np.random.default_rng(0))


def untrained(name: str) -> PredictionAware:
    """The approach with its initial weights, whatever is shipped for it."""
    return PredictionAware(name, dataclasses.replace(compact(name), vfn_weights=None, hpn_weights=None))


def decide(agent: PredictionAware) -> dict[str, Decision]:
    agent.reset(context(agent))
    return agent.decide(histories(ROAD, CARS, agent.observation))


@pytest.mark.parametrize("name", ["vfn-p", "vfn"])
def test_every_av_gets_an_explained_decision(name: str) -> None:
    agent = untrained(name)
    assert agent.label == "untrained"
    decisions = decide(agent)
    assert list(decisions) == ["a", "b"]
    for decision in decisions.values():
        for explained in (decision.q, decision.ttc, decision.safety_score, decision.unsafe):
            assert explained is not None
            assert explained.shape == (5,)
            assert np.isfinite(explained).all()
    assert decisions["a"].action == MetaAction.DECELERATE
    assert decisions["a"].vetoed
    assert decisions["a"].blamed == "slow"
    assert decisions["b"].action == MetaAction.IDLE


def test_two_agents_built_alike_have_the_same_weights_and_do_not_change_torchs_generator() -> None:
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    first, second = PredictionAware("vfn-p"), PredictionAware("vfn-p")
    assert torch.equal(torch.rand(1), expected)
    for x, y in zip(first.vfn.parameters(), second.vfn.parameters(), strict=True):
        assert torch.equal(x, y)


def test_the_network_decides_where_the_mask_allows_it() -> None:
    agent = untrained("vfn-p")
    with torch.no_grad():
        agent.vfn.value.bias[MetaAction.ACCELERATE] = 1.0
    decisions = decide(agent)
    assert decisions["b"].action == MetaAction.ACCELERATE
    assert decisions["a"].action == MetaAction.DECELERATE, "closing on a slow car it may not"


def test_a_lane_change_that_did_not_begin_is_not_tried_again_at_once() -> None:
    agent = untrained("vfn-p")
    with torch.no_grad():
        agent.vfn.value.bias[MetaAction.LANE_LEFT] = 1.0
    agent.reset(context(agent))
    seen = histories(ROAD, CARS, agent.observation)
    assert agent.decide(seen)["a"].action == MetaAction.LANE_LEFT
    later = {name: h._replace(time=0.4) for name, h in seen.items()}
    assert agent.decide(later)["a"].action != MetaAction.LANE_LEFT
    assert agent.decide(later)["a"].blamed == "(lane change was refused)"
    much_later = {name: h._replace(time=3.0) for name, h in seen.items()}
    assert agent.decide(much_later)["a"].action == MetaAction.LANE_LEFT


def test_it_refuses_an_observation_it_was_not_built_for() -> None:
    agent = PredictionAware("vfn-p")
    with pytest.raises(BadInput, match="observation"):
        agent.reset(dataclasses.replace(context(agent), observation=PAPER))


def test_weights_that_went_wrong_do_not_drive() -> None:
    agent = PredictionAware("vfn-p")
    with torch.no_grad():
        agent.vfn.value.bias[0] = float("nan")
    with pytest.raises(FloatingPointError):
        decide(agent)


def test_smoke_size_runs_the_same_path() -> None:
    config = AgentConfig(
        observation=SMOKE, hpn=HpnConfig(), vfn=VfnConfig(height=16), chain=compact("vfn-p").chain
    )
    decisions = decide(PredictionAware("vfn-p", config))
    assert decisions["a"].action == MetaAction.DECELERATE


def test_the_paper_configuration_is_the_papers() -> None:
    config = paper("vfn-p")
    assert (config.observation.height, config.observation.width) == (64, 512)
    assert config.chain.hypotheses == 20
    assert config.hpn.maps == "rendered", "whatever the size: the pictures are drawn, not decoded"
    assert config.vfn.frames == 30
    assert config.vfn.strides == "literal"
    assert compact("vfn-p").observation == COMPACT
    assert compact("vfn").predictor == "hold"
    with pytest.raises(BadInput, match="policy='conv4d'"):
        compact("conv4d")


def test_every_approach_is_a_policy_and_sees_what_table_iii_says() -> None:
    for name in APPROACHES:
        config = compact(name)
        assert config.vfn.frames == (14 if name.startswith("vfn-p") else 10)
        assert bool(config.vfn.kinematic) == name.startswith("vfn")
        assert config.mask == name.startswith(("vfn", "safe"))


def test_a_frozen_encoder_stands_for_the_convolutions_of_all_six() -> None:
    sizes = configuration("papers").file
    layouts = {name: agent_config(name, sizes).vfn for name in TRAINABLE}
    assert all(layout.encoded for layout in layouts.values())
    assert [name for name, layout in layouts.items() if layout.extractor == "frame"] == ["conv2d-dqn"]


def test_without_a_mask_the_best_valued_action_is_taken() -> None:
    agent = PredictionAware("conv3d-dqn")
    q = np.array([[0.0, 1.0, 3.0, 2.0, 0.0]], np.float32)
    scene = SimpleNamespace(agents=("a",), histories=(None,))
    agent._context = None  # type: ignore[assignment]
    decision = agent.choose(q, SimpleNamespace(scene=scene))["a"]  # type: ignore[arg-type]
    assert decision.action == MetaAction.LANE_RIGHT
    assert decision.unsafe is None
