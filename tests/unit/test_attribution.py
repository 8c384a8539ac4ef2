"""Counterfactuals of a value network: what it does not read changes nothing, what it reads does."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from policy_scenes import Car, histories, straight_road

from cosim.errors import BadInput
from cosim.learning.attribution import FIGURES, SHARED, closed_markdown, markdown, questioned, table
from cosim.types import COMPACT, MetaAction, PolicyContext, Timing
from policy.agents.approaches import AgentConfig, configure
from policy.agents.prediction_aware import PredictionAware
from policy.attribution import (
    OTHERS,
    SUMS,
    Questioned,
    Replaced,
    answer,
    questions,
    replacements,
)
from policy.chain.chain import ChainConfig
from policy.inputs.situation import SITUATION_INPUTS
from policy.inputs.tensors import States
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import VfnConfig

ROAD = straight_road(3)
FREE = [Car("a", 300.0, 1, 20.0, is_av=True), Car("b", 100.0, 1, 20.0, is_av=True)]  # 200 m apart, alike


def config(name: str) -> AgentConfig:
    """An untrained agent of convolutions, in whatever layout its weights ship."""
    return configure(name, COMPACT, ChainConfig(), HpnConfig(), VfnConfig())


def untrained(name: str = "vfn-p") -> Questioned:
    return Questioned(name, config(name))


NETWORK = untrained().vfn  # takes maps, kinematics and situation


def driven(
    agent: Questioned, svo: float = math.pi / 4, cars: list[Car] = FREE
) -> dict[str, dict[str, float]]:
    """`input: replacement` -> its sums after one joint decision."""
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, svo, np.random.default_rng(0)))
    agent.decide(histories(ROAD, cars, agent.observation))
    return {": ".join(k): dict(zip(SUMS, v.tolist(), strict=True)) for k, v in agent.answers.items()}


def led_by(agent: Questioned, column: int) -> Questioned:
    """Its values hang on one column of the joined layer's input alone: Accelerate is worth what that says."""
    with torch.no_grad():
        for layer in (agent.vfn.joined, agent.vfn.value):
            layer.weight.zero_()
            layer.bias.zero_()
        agent.vfn.joined.weight[0, column] = 1.0
        agent.vfn.value.weight[MetaAction.ACCELERATE, 0] = 1.0
        agent.vfn.value.bias[MetaAction.IDLE] = 0.5
    return agent


def test_a_network_that_reads_phi_alone_uses_nothing_else() -> None:
    found = driven(led_by(untrained(), -2))  # cos(phi): 0.71 at 45 degrees, more than Idle's 0.5
    for key, sums in found.items():
        assert sums["decisions"] == 2
        assert sums["spread"] == pytest.approx(2 * (math.cos(math.pi / 4) - 0.5), abs=1e-6)
        if key != "phi: 90 degrees":
            assert sums["choices_changed"] == sums["unmasked_changed"] == 0, key
        if not key.startswith("phi"):
            assert sums["mean_abs_dq"] == 0.0, key
    assert found["phi: 90 degrees"]["unmasked_changed"] == 2
    assert found["phi: 90 degrees"]["choices_changed"] == 2
    assert found["phi: 0 degrees"]["mean_abs_dq"] > 0.0


def test_every_input_is_replaced_where_the_approach_has_it() -> None:
    whole = {": ".join(key).split(":")[0] for key in _keys("vfn-p")}
    framed = {f"{span} {what}" for span in ("past", "predicted", "all") for what in ("maps", "kinematics")}
    assert whole == framed | {"situation", "map branch", "phi"}
    assert {name for name, _ in _keys("vfn")} == {
        "maps",
        "kinematics",
        "situation",
        "map branch",
        "phi",
    }
    assert {name for name, _ in _keys("safe-dqn")} == {"maps", "map branch", "phi"}


def _keys(name: str) -> list[tuple[str, str]]:
    agent = untrained(name)
    driven(agent)
    return list(agent.answers)


def test_an_agent_drives_by_what_it_answers_with_an_input_replaced() -> None:
    base = led_by(untrained(), -2)  # cos(phi): Accelerate at 45 degrees, Idle at 90
    ways = [(None, "ACCELERATE"), (("phi", "90 degrees"), "IDLE"), (("situation", OTHERS), "ACCELERATE")]
    for what, action in ways:
        agent = Replaced("vfn-p", config("vfn-p"), what)
        agent.vfn.load_state_dict(base.vfn.state_dict())
        agent.reset(PolicyContext(ROAD, Timing(), agent.observation, math.pi / 4, np.random.default_rng(0)))
        decisions = agent.decide(histories(ROAD, FREE, agent.observation))
        assert {d.action.name for d in decisions.values()} == {action}, what
    base.reset(PolicyContext(ROAD, Timing(), base.observation, math.pi / 4, np.random.default_rng(0)))
    states = base.perceive(histories(ROAD, FREE, base.observation)).states
    whole = replacements(base.vfn, base.observation.frames)
    asked = questions(base.vfn, states, base.observation.frames)
    assert set(whole) <= {(name, how) for name, how, _ in asked}
    assert ("predicted maps", "as at present") in whole


def test_an_av_that_decides_alone_has_no_other_to_swap_with() -> None:
    assert not [key for key in driven(untrained("vfn"), cars=FREE[:1]) if "another" in key]


def test_swapping_avs_that_see_the_same_changes_nothing() -> None:
    torch.manual_seed(0)
    twins = States(
        torch.randint(0, 255, (1, 14, 4, 32, 128), dtype=torch.uint8).expand(2, -1, -1, -1, -1),
        *(torch.rand(1, *size).expand(2, *size) for size in ((14, 16, 9), (SITUATION_INPUTS,), (2,))),
    )
    swapped = [states for _, how, states in questions(NETWORK, twins, 10) if how == "another AV's"]
    assert len(swapped) == 7
    for states in swapped:
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(states, twins, strict=True))


def test_replacements_touch_their_own_frames_and_nothing_else() -> None:
    torch.manual_seed(0)
    states = States(
        torch.randint(1, 255, (3, 14, 4, 8, 8), dtype=torch.uint8),
        *(torch.rand(3, *size) for size in ((14, 16, 9), (SITUATION_INPUTS,), (2,))),
    )
    asked = {(name, how): found for name, how, found in questions(NETWORK, states, 10)}
    zeroed, present = asked["predicted maps", "zeroed"][0], asked["predicted maps", "as at present"][0]
    assert torch.equal(zeroed[:, :10], states.maps[:, :10])
    assert not zeroed[:, 10:].any()
    assert torch.equal(present[:, 10:], states.maps[:, 9:10].expand(-1, 4, -1, -1, -1))
    still = asked["past kinematics", "as at present"][1]
    assert torch.equal(still[:, :10], states.kinematics[:, 9:10].expand(-1, 10, -1, -1))
    assert torch.equal(still[:, 10:], states.kinematics[:, 10:])
    other = asked["situation", "another AV's"][2]
    assert torch.equal(other[1], states.situation[0])
    assert torch.equal(asked["phi", "90 degrees"][3][0], torch.tensor([math.cos(math.pi / 2), 1.0]))


def test_no_maps_is_the_last_layer_of_their_branch_at_zero() -> None:
    agent = untrained()
    torch.manual_seed(0)
    torch.nn.init.normal_(agent.vfn.value.weight)
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0)))
    states = agent.perceive(histories(ROAD, FREE, agent.observation)).states
    without = answer(agent, (None, *states[1:]))
    with torch.no_grad():
        agent.vfn.hidden.weight.zero_()
        agent.vfn.hidden.bias.zero_()
    assert np.array_equal(without, answer(agent, states))


def test_the_questions_do_not_disturb_the_memory_of_commanded_lane_changes() -> None:
    agent = untrained()
    with torch.no_grad():
        agent.vfn.value.bias[MetaAction.LANE_LEFT] = 1.0
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0)))
    seen = histories(ROAD, FREE, agent.observation)
    assert agent.decide(seen)["a"].action == MetaAction.LANE_LEFT
    assert agent.decide(seen)["a"].blamed == "(lane change was refused)"


def test_shares_are_those_of_the_decisions_of_all_episodes_and_the_page_says_what_is_unused() -> None:
    about = {
        "scenario": "w",
        "demand": "d",
        "behavior": "mixed",
        "driver_model": "m",
        "preset": "p",
        "errors": None,
    }
    keys = [("maps", "zeroed"), ("maps", "another AV's"), ("phi", "0 degrees")]
    sums = [[10, 0, 0, 0.0, 5.0], [8, 0, 0, 0.0, 4.0], [10, 3, 4, 2.0, 5.0]]
    answers = [dict(zip(keys, map(np.array, sums), strict=True)) for _ in range(2)]
    del answers[1]["maps", "another AV's"]  # an episode in which one AV decided at a time
    episodes = [{**about, "svo_deg": 45.0, "policy": "x", "answers": found} for found in answers]
    rows = table(episodes)
    assert [row["decisions"] for row in rows] == [20, 8, 20]
    assert rows[2]["choices_changed"] == 0.3
    assert rows[2]["choices_changed_low"] < 0.3 < rows[2]["choices_changed_high"]
    assert (rows[2]["unmasked_changed_count"], rows[2]["mean_abs_dq"], rows[2]["spread"]) == (8, 0.2, 0.5)
    page = markdown(episodes, {"x": rows}, "cosim bench attribution ...")
    assert "| `x` | maps | phi 30 % |" in page
    assert "2 episodes a policy" in page
    answers[0].pop(("maps", "another AV's"))  # it comes in the last episode only, after another input
    late = np.array([8.0, 8.0, 8.0, 1.0, 4.0])
    episodes[1]["answers"] = {keys[0]: np.array(sums[0]), keys[2]: np.array(sums[2]), keys[1]: late}
    rows = table(episodes)
    assert [(row["input"], row["decisions"]) for row in rows] == [("maps", 20), ("maps", 8), ("phi", 20)]
    assert "| `x` | none | " in markdown(episodes, {"x": rows}, "cosim bench attribution ...")


def test_a_mask_of_another_clock_is_refused() -> None:
    agent = Questioned("vfn-p")
    slow = PolicyContext(ROAD, Timing(frame=0.1), agent.observation, 0.0, np.random.default_rng(0))
    with pytest.raises(BadInput, match=r"safety\.dt"):
        agent.reset(slow)


def test_what_an_encoder_makes_of_maps_is_replaced_as_the_maps_are() -> None:
    agent = Questioned("vfn-p")
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0)))
    seen = histories(ROAD, FREE, agent.observation)
    past = agent.observation.frames
    maps, latents = PredictionAware.perceive(agent, seen).states, agent.perceive(seen).states
    assert (maps.maps.dim(), latents.maps.dim()) == (5, 3)
    pairs = list(zip(*(questions(agent.vfn, states, past) for states in (maps, latents)), strict=True))
    assert len(pairs) > 10
    for (*asked, of_maps), (*same, of_latents) in pairs:
        assert asked == same
        np.testing.assert_allclose(
            answer(agent, of_latents), answer(agent, of_maps), atol=1e-5, err_msg=str(asked)
        )


def test_drives_are_compared_world_by_world_and_tested_over_all_of_them() -> None:
    def rows(world: str, lost: float) -> list[dict[str, object]]:
        figures = dict.fromkeys(FIGURES, 1.0)
        return [
            {"policy": "x", "scenario": world, "input": what, "replacement": how, "seed": k}
            | dict.fromkeys(SHARED, False)
            | figures
            | {"dt_mission_m": 500.0 + k - (lost + k if what else 0.0)}
            for what, how in (("", ""), ("maps", OTHERS))
            for k in range(8)
        ]

    found = [row | {"input": row["input"] or "nothing"} for row in rows("a", 9.0) + rows("b", 0.0)]
    page = closed_markdown(found)
    assert page.index("### x, a, 8 episodes") < page.index("### x, b, 8 episodes")
    lines = [line for line in page.splitlines() if line.startswith("| maps")]
    p = [float(line.split("|")[-2]) for line in lines]
    assert p == pytest.approx([2 * 2 / 2**8, 0.016], abs=5e-4)


def test_a_policy_without_a_network_is_refused() -> None:
    with pytest.raises(BadInput, match="policy='idm'"):
        questioned("idm")
