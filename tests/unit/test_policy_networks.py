"""The HPN's branches and the VFN: shapes at every size, what an untrained network says, what stays unread."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from policy_scenes import Car, histories, straight_road

from cosim.types import KINEMATIC_FEATURES
from policy.inputs.situation import MAX_DISTANCE, MISSION_START, PER_LANE, SITUATION_INPUTS, situation
from policy.inputs.tensors import KINEMATIC_INPUTS, kinematic_tensor, svo_tensor, to_batch, to_planes
from policy.networks import extractors
from policy.networks.hpn import HPN, HpnConfig
from policy.networks.kinematic_branch import KinematicBranch, KinematicConfig, confidence, correct
from policy.networks.map_branch import MapBranch, MapBranchConfig
from policy.networks.vfn import VFN, Frames, VfnConfig
from policy.prediction.vehicle_inputs import NEIGHBOUR_INPUTS, NEIGHBOURS, own_inputs


def step(config: MapBranchConfig, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random input, the predicted maps and kinematics, and the rendered maps shown to the network."""
    torch.manual_seed(0)
    network = MapBranch(config).eval()
    past = torch.rand(batch, config.seen * config.channels, config.height, config.width)
    rendered = torch.rand(batch, config.block * config.channels, config.height, config.width)
    kinematics = torch.rand(batch, config.seen, config.rows, KINEMATIC_INPUTS)
    with torch.inference_mode():
        maps, moved = network(past, kinematics, rendered if config.correct else None)
    return maps, moved, rendered


@pytest.mark.parametrize("reading", ["pool", "s2fc"])
@pytest.mark.parametrize(("height", "width", "block"), [(16, 128, 5), (32, 128, 5), (64, 512, 1)])
@pytest.mark.parametrize("correct", [True, False])
def test_the_map_branch_predicts_the_next_maps_and_kinematics_at_every_size(
    reading: str, height: int, width: int, block: int, correct: bool
) -> None:
    config = MapBranchConfig(height, width, block=block, reading=reading, correct=correct, skips=correct)  # type: ignore[arg-type]
    maps, moved, _ = step(config, batch=1)
    assert maps.shape == (1, block * 4, height, width)
    assert moved.shape == (1, block, 16, 4)


def test_at_paper_size_the_pooled_reading_needs_no_layer_to_reach_the_latent_dimension() -> None:
    network = MapBranch(MapBranchConfig(64, 512, block=1))
    parameters = sum(p.numel() for p in network.parameters())
    assert 0.40e6 < parameters < 0.46e6, "0.44 M, as T's sizes give"


def test_an_untrained_correction_changes_nothing() -> None:
    maps, _, rendered = step(MapBranchConfig(correct=True, skips=True))
    torch.testing.assert_close(maps, rendered, rtol=0.0, atol=0.0)


def test_the_map_branch_without_history_sees_the_current_frame_only() -> None:
    config = MapBranchConfig(history=False)
    assert config.seen == 1
    assert step(config)[0].shape == (2, 20, 32, 128)


def test_a_network_that_corrects_asks_for_the_rendered_map() -> None:
    network = MapBranch(MapBranchConfig(correct=True))
    with pytest.raises(ValueError, match="rendered"):
        network(torch.zeros(1, 40, 32, 128), torch.zeros(1, 10, 16, KINEMATIC_INPUTS))


@pytest.mark.parametrize("strides", ["temporal", "literal"])
@pytest.mark.parametrize(("height", "width", "frames"), [(16, 128, 14), (32, 128, 14), (32, 128, 10)])
def test_the_vfn_values_five_actions_at_every_size(
    strides: str, height: int, width: int, frames: int
) -> None:
    network = VFN(VfnConfig(height=height, width=width, frames=frames, strides=strides)).eval()  # type: ignore[arg-type]
    q = values(network, height, width, frames)
    assert q.shape == (2, 5)
    assert (q == 0.0).all(), "untrained: every action is worth the same"


def values(network: VFN, height: int, width: int, frames: int, phi: float = 0.0) -> torch.Tensor:
    torch.manual_seed(1)
    maps = torch.rand(2, frames, 4, height, width)
    kinematics = torch.rand(2, frames, 16, KINEMATIC_INPUTS)
    route = torch.rand(2, SITUATION_INPUTS)
    direction = torch.tensor([[np.cos(phi), np.sin(phi)]], dtype=torch.float32).expand(2, 2)
    with torch.inference_mode():
        q: torch.Tensor = network(maps, kinematics, route, direction)
    return q


def test_the_vfn_hears_the_social_value_orientation_and_sees_the_maps() -> None:
    torch.manual_seed(0)
    network = VFN(VfnConfig()).eval()
    torch.nn.init.normal_(network.value.weight)
    egoist, altruist = values(network, 32, 128, 14, 0.0), values(network, 32, 128, 14, np.pi / 2)
    assert not torch.equal(egoist, altruist)
    with torch.inference_mode():
        features = network.features(
            torch.zeros(2, 14, 4, 32, 128),
            torch.zeros(2, 14, 16, KINEMATIC_INPUTS),
            torch.zeros(2, SITUATION_INPUTS),
            torch.zeros(2, 2),
        )
        blind = network.value(features)
    assert features.shape == (2, 256)
    assert not torch.equal(blind, egoist)


def test_gradients_reach_every_layer_of_both_networks() -> None:
    torch.manual_seed(0)
    hpn, vfn = MapBranch(MapBranchConfig(16, 128, correct=True, skips=True)), VFN(VfnConfig(height=16))
    for head in (vfn.value, vfn.state):
        torch.nn.init.normal_(head.weight)  # type: ignore[union-attr]
    torch.nn.init.normal_(hpn.decoder[2].weight)  # type: ignore[arg-type]
    maps, moved = hpn(
        torch.rand(2, 40, 16, 128), torch.rand(2, 10, 16, KINEMATIC_INPUTS), torch.rand(2, 20, 16, 128)
    )
    q = vfn(
        torch.rand(2, 14, 4, 16, 128),
        torch.rand(2, 14, 16, KINEMATIC_INPUTS),
        torch.rand(2, SITUATION_INPUTS),
        torch.rand(2, 2),
    )
    (maps.square().mean() + moved.square().mean() + q.square().mean()).backward()
    for network in (hpn, vfn):
        for name, parameter in network.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name


def kinematic_input(vehicles: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(5)
    near = torch.randn(vehicles, NEIGHBOURS, NEIGHBOUR_INPUTS)
    near[..., 0] = 1.0
    return torch.randn(vehicles, own_inputs(10)), near


def test_an_untrained_kinematic_branch_leaves_the_forecast_along_the_lane_as_it_is() -> None:
    own, near = kinematic_input()
    raw = KinematicBranch(KinematicConfig())(own, near)
    assert raw.shape == (3, 20, 7)
    assert (raw == 0.0).all()
    lane = torch.randn(3, 20, 4).abs()
    torch.testing.assert_close(correct(raw, lane, lane), lane)
    aside = correct(raw, lane, lane + 1.0) - lane
    assert ((aside > 0.1) & (aside < 0.15)).all(), "an eighth of the way to the other forecast"
    assert (confidence(raw[..., 5], raw[..., 6]) > 0.97).all()


def test_a_correction_is_ahead_and_aside_of_where_the_vehicle_is_heading() -> None:
    raw = torch.zeros(1, 1, 7)
    raw[..., 1], raw[..., 2], raw[..., 3] = 2.0, 0.5, -50.0
    north = torch.tensor([[[10.0, 20.0, 15.0, np.pi / 2]]])
    x, y, speed, heading = correct(raw, north, north)[0, 0].tolist()
    assert (x, y) == (pytest.approx(9.5), pytest.approx(22.0))
    assert speed == 0.0, "nobody reverses"
    assert heading == pytest.approx(np.pi / 2)


def test_vehicles_share_the_weights_and_neighbours_have_no_order() -> None:
    torch.manual_seed(0)
    branch = KinematicBranch(KinematicConfig())
    torch.nn.init.normal_(branch.out.weight)
    own, near = kinematic_input()
    with torch.inference_mode():
        together = branch(own, near)
        alone = torch.cat([branch(own[k : k + 1], near[k : k + 1]) for k in range(3)])
        shuffled = branch(own, near.flip(1))
        near[:, 4:] = 0.0
        fewer = branch(own, near)
        near[:, 4:, 1:] = 7.0  # an empty place says nothing, whatever stands in it
        torch.testing.assert_close(branch(own, near), fewer)
    torch.testing.assert_close(together, alone)
    torch.testing.assert_close(together, shuffled)


def test_the_hpn_has_the_branches_that_its_maps_need() -> None:
    rendered = HPN(HpnConfig())
    assert rendered.kinematic is not None
    assert rendered.map_branch is None
    plain = HPN(HpnConfig(maps="plain"))
    assert plain.kinematic is None
    assert plain.map_branch is not None
    with pytest.raises(ValueError, match="corrects rendered maps"):
        HPN(HpnConfig(maps="corrected"))


def test_masked_and_nan_rows_reach_no_network() -> None:
    rows = np.full((1, 10, 16, len(KINEMATIC_FEATURES)), 50.0, np.float32)
    valid = np.ones((1, 10, 16), bool)
    valid[0, :, 3] = False
    rows[0, 4, 7, 2] = np.nan
    tensor = kinematic_tensor(rows, valid)
    assert torch.isfinite(tensor).all()
    assert (tensor[0, :, 3] == 0).all()
    assert (tensor[0, 4, 7] == 0).all()
    assert tensor[0, 5, 7, -1] == 1.0


def test_the_ego_gets_where_its_lanes_end() -> None:
    road = straight_road(3, dead_end=0, at=400.0)
    on_it, beside = (histories(road, [Car("e", 300.0, lane, 20.0, is_av=True)])["e"] for lane in (0, 1))
    assert to_batch([on_it, beside]).maps.shape == (2, 10, 4, 32, 128)
    known = situation([on_it, beside], road, shared=True)
    assert known.shape == (2, SITUATION_INPUTS)
    left, keep, right = (known[:, 7 + k * PER_LANE : 10 + k * PER_LANE] for k in range(3))
    assert keep[:, 1].tolist() == [1.0, 0.0], "only the right lane dead-ends"
    assert keep[0, 2] == pytest.approx(0.5), "100 m ahead, of 200"
    assert right[:, 0].tolist() == [0.0, 1.0]
    assert left[:, 0].tolist() == [1.0, 1.0]
    torch.testing.assert_close(svo_tensor(np.pi / 4, 2), torch.full((2, 2), float(np.sqrt(0.5))))


def test_the_ego_gets_who_drives_around_it() -> None:
    road = straight_road(2)
    cars = [
        Car("e", 300.0, 0, 20.0, is_av=True),
        Car("leader", 340.0, 0, 17.0),
        Car("follower", 275.0, 0, 23.0),
        Car("beside", 310.0, 1, 20.0),
    ]
    known = situation([histories(road, cars)["e"]], road, shared=True)[0]
    left, keep, right = (known[7 + (k + 1) * PER_LANE - 4 : 7 + (k + 1) * PER_LANE] for k in range(3))
    assert keep == pytest.approx([0.4, -0.1, 0.25, 0.1], abs=0.02)
    assert left == pytest.approx([0.1, 0.0, 1.0, 0.0], abs=0.02)
    assert not right.any(), "there is no lane"


def test_the_avs_know_in_which_order_they_reach_the_mission_vehicle() -> None:
    road = straight_road(2, dead_end=0, at=500.0)
    cars = [
        Car("m", 320.0, 0, 18.0, mission=True),
        Car("ahead", 340.0, 1, 20.0, is_av=True),
        Car("guide", 300.0, 1, 20.0, is_av=True),
        Car("later", 270.0, 1, 20.0, is_av=True),
    ]
    seen = histories(road, cars)
    order = ("ahead", "guide", "later")
    known = situation([seen[name] for name in order], road, shared=True)[:, MISSION_START:]
    assert known[:, 0].tolist() == [1.0] * 3, "their lanes lie side by side"
    assert np.diff(known[:, 1]) * MAX_DISTANCE == pytest.approx([40.0, 30.0])
    assert known[:, 2] == pytest.approx([-1.0, known[0, 1], known[1, 1]]), "who arrives next before it"
    assert known[:, 3:5].tolist() == [[0.0, 1.0]] * 3, "beside, from the right"
    assert known[:, 5] == pytest.approx([0.6] * 3)
    alone = situation([seen[name] for name in order], road, shared=False)[:, MISSION_START:]
    assert alone[:, 2].tolist() == [-1.0] * 3, "without V2V nobody knows of the others"


def test_frames_remembered_from_the_last_decision_give_the_same_values_to_the_bit() -> None:
    torch.manual_seed(0)
    network = VFN(VfnConfig()).eval()
    torch.nn.init.normal_(network.value.weight)
    pictures = torch.randint(0, 256, (3, 20, 4, 32, 128), dtype=torch.uint8)  # of three AVs, frame by frame
    memory, calls = network.memory(10, 2), []
    assert memory is not None
    convolve = network.maps.frames
    network.maps.frames = lambda maps: calls.append(len(maps)) or convolve(maps)
    # the second AV joins late; after the third decision the first one's past is another (it was away)
    for number, (names, start) in enumerate([("a", 0), ("ab", 2), ("abc", 4), ("ba", 8)]):
        rows = ["abc".index(name) for name in names]
        ahead = torch.randint(0, 256, (len(rows), 4, 4, 32, 128), dtype=torch.uint8)
        maps = torch.cat([pictures[rows, start : start + 10], ahead], 1)
        rest = (
            torch.rand(len(rows), 14, 16, 9),
            torch.rand(len(rows), SITUATION_INPUTS),
            torch.rand(len(rows), 2),
        )
        with torch.inference_mode():
            remembered = network(Frames(memory.frames(list(names), maps)), *rest)
            convolved = calls[-1]
            assert torch.equal(remembered, network(maps, *rest))
        assert convolved == (14, 6 + 14, 6 + 6 + 14, 14 + 14)[number]


def test_in_place_of_conv2d_the_encoder_sees_the_present_frame_alone() -> None:
    torch.manual_seed(0)
    network = VFN(VfnConfig(extractor="frame", frames=10)).eval()
    maps = torch.randint(0, 256, (2, 10, 4, 32, 128), dtype=torch.uint8)
    assert network.maps.flat == VfnConfig().latent
    with torch.inference_mode():
        present = network.maps(maps)
        maps[:, :-1] = 0
        assert torch.equal(network.maps(maps), present)
        maps[:, -1] = 0
        assert not torch.equal(network.maps(maps), present)


@pytest.mark.parametrize("extractor", ["conv3d", "frames"])
def test_a_citys_frames_are_read_in_parts_to_the_bit(
    extractor: Literal["conv3d", "frames"], monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    network = VFN(VfnConfig(extractor=extractor)).eval()
    maps = torch.randint(0, 256, (5, 14, 4, 32, 128), dtype=torch.uint8)

    def read() -> torch.Tensor:
        memory = network.memory(10, 2)
        assert memory is not None
        with torch.inference_mode():
            return memory.frames(list("abcde"), maps)

    whole = read()
    monkeypatch.setattr(extractors, "FRAMES_PER_BATCH", 40)  # two parts; below 16 some CPUs round
    assert torch.equal(read(), whole)


def test_maps_read_apart_say_who_is_where_and_how_fast() -> None:
    def pixel(relative_speed: float) -> int:
        return int(255 * (0.1 + 0.9 * (relative_speed + 30.0) / 60.0) + 0.5)

    maps = torch.zeros(1, 4, 8, 8, dtype=torch.uint8)
    maps[0, 2] = 255
    maps[0, 0, 2, 1], maps[0, 1, 3, 5], maps[0, 3, 3, 5], maps[0, 3, 4, 4] = (
        pixel(5.0), pixel(-10.0), pixel(-10.0), pixel(0.0)
    )  # fmt: skip
    *present, speed = to_planes(maps)[0]
    assert torch.equal(torch.stack(present), (maps[0] > 0).to(torch.float32))
    assert float(speed[2, 1]) == pytest.approx(5.0 / 15.0, abs=0.01)
    assert float(speed[3, 5]) == pytest.approx(-10.0 / 15.0, abs=0.01)
    assert int(speed.count_nonzero()) == 2
