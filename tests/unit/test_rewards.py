"""Who is rewarded for whose driving: equation (6) with its terms apart, in both papers' variants."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cosim.errors import BadInput
from cosim.rewards import RewardConfig, RewardTerms, rewards
from cosim.types import Collision, Events, Kind, MetaAction, Snapshot

P = RewardConfig()
T = RewardConfig(variant="t")
IDLE = {"av": MetaAction.IDLE, "ally": MetaAction.IDLE}


def scene(time: float = 0.0, **cars: tuple[float, float, Kind, bool]) -> Snapshot:
    """Cars on one line: name = (x m, speed m/s, kind, is the mission vehicle)."""
    ids = tuple(sorted(cars))
    n = len(ids)
    x, speed = (np.array([cars[name][k] for name in ids], np.float64) for k in (0, 1))
    return Snapshot(
        time=time, ids=ids, kind=np.array([cars[name][2] for name in ids], np.int8),
        mission=np.array([cars[name][3] for name in ids], np.bool_), x=x, y=np.zeros(n),
        heading=np.zeros(n), speed=speed, accel=np.zeros(n), length=np.full(n, 5.0), width=np.full(n, 2.0),
        lane=np.zeros(n, np.int32), lane_position=x + 2.5,
    )  # fmt: skip


def decide(
    svo_deg: float = 45.0,
    config: RewardConfig = P,
    *,
    av_speed: float = 20.0,
    hv_speed: float = 20.0,
    hv_at: float = 30.0,
    ally_speed: float = 20.0,
    mission: bool = False,
    action: MetaAction = MetaAction.IDLE,
    crashed: tuple[str, str] | None = None,
) -> RewardTerms:
    """The AV's reward at x = 0 with an HV at `hv_at` m and another AV 50 m behind."""
    snapshot = scene(
        av=(0.0, av_speed, Kind.AV, False),
        ally=(-50.0, ally_speed, Kind.AV, False),
        hv=(hv_at, hv_speed, Kind.HV, mission),
    )
    if crashed:
        made = Collision(0.4, *crashed, False, False, "collision", "sumo", "", 0.0, 0.0)
        snapshot = replace(snapshot, events=Events(collisions=(made,)))
    return rewards(
        snapshot,
        snapshot,
        ["av", "ally"],
        IDLE | {"av": action},
        float(np.radians(svo_deg)),
        config,
        snapshot.events.collisions,
    )["av"]


@pytest.mark.parametrize("config", [P, T])
def test_an_egoist_does_not_care_how_others_drive(config: RewardConfig) -> None:
    assert decide(0.0, config, hv_speed=0.0, ally_speed=0.0).total == decide(0.0, config).total
    assert decide(0.0, config, av_speed=10.0).total < decide(0.0, config).total


@pytest.mark.parametrize("config", [P, T])
def test_a_pure_altruist_does_not_care_how_it_drives_itself(config: RewardConfig) -> None:
    slow = decide(90.0, config, av_speed=5.0, action=MetaAction.LANE_LEFT)
    assert slow.total == pytest.approx(decide(90.0, config).total)
    assert decide(90.0, config, hv_speed=5.0).total < decide(90.0, config).total
    assert decide(90.0, config, ally_speed=5.0).total < decide(90.0, config).total


def test_the_total_is_the_svo_mix_of_the_reported_terms() -> None:
    for degrees in (0.0, 30.0, 45.0, 90.0):
        terms = decide(degrees)
        phi = np.radians(degrees)
        mixed = np.cos(phi) * terms.ego + np.sin(phi) * (terms.av_social + terms.hv_social)
        assert terms.total == pytest.approx(mixed)


def test_papers_p_values_by_hand() -> None:
    """20 of 30 m/s: speed and distance count 2/3 each; the HV 30 m off, the ally 50 m off."""
    terms = decide()
    assert terms.ego == pytest.approx(4 / 3)
    assert terms.hv_social == pytest.approx(4 / 3 / 30.0)
    assert terms.av_social == pytest.approx(4 / 3 / 50.0)


def test_p_decays_with_distance_down_to_five_metres_and_t_does_not_decay() -> None:
    near_to_far = [decide(hv_at=d).hv_social for d in (5.0, 10.0, 40.0, 120.0)]
    assert all(a > b for a, b in pairwise(near_to_far))
    assert decide(hv_at=2.0).hv_social == decide(hv_at=5.0).hv_social
    assert (
        decide(config=T, hv_at=10.0).hv_social
        == decide(config=T, hv_at=120.0).hv_social
        == pytest.approx(4 / 3)
    )


@pytest.mark.parametrize("config", [P, T])
def test_whoever_is_out_of_perception_does_not_count(config: RewardConfig) -> None:
    assert decide(config=config, hv_at=126.0).hv_social == 0.0
    assert decide(config=config, hv_at=124.0).hv_social > 0.0


def test_only_t_charges_for_lane_changes_and_speed_changes() -> None:
    for action, cost in ((MetaAction.LANE_LEFT, T.lane_change), (MetaAction.DECELERATE, T.acceleration)):
        assert decide(config=T, action=action).ego == pytest.approx(decide(config=T).ego + cost)
        assert decide(config=P, action=action).ego == decide(config=P).ego


def test_a_mission_vehicles_gain_counts_as_twenty_bystanders() -> None:
    gain = decide(mission=True).hv_social - decide(mission=True, hv_speed=0.0).hv_social
    bystander = decide().hv_social - decide(hv_speed=0.0).hv_social
    assert gain == pytest.approx(20.0 * bystander)
    assert decide(mission=True).total > decide(mission=True, hv_speed=10.0).total


def test_a_crash_costs_whoever_is_in_it_and_whoever_cares() -> None:
    assert decide(crashed=("av", "ally")).ego == pytest.approx(decide().ego + P.crash)
    struck = decide(crashed=("hv", "ally"))
    assert struck.ego == decide().ego
    assert struck.hv_social < 0.0
    assert struck.av_social < 0.0


def test_a_collision_in_an_earlier_frame_of_the_decision_is_paid_for() -> None:
    snapshot = scene(av=(0.0, 20.0, Kind.AV, False), hv=(4.0, 20.0, Kind.HV, False))
    made = Collision(0.2, "av", "hv", True, False, "collision", "sumo", "", 0.0, 0.0)
    frames = (replace(snapshot, events=Events(collisions=(made,), departed=("hv",))), snapshot)
    events = Events.of(frames)
    assert events.departed == ("hv",)
    terms = rewards(snapshot, snapshot, ["av"], {}, 0.0, P, events.collisions)["av"]
    assert terms.ego == pytest.approx(4 / 3 + P.crash)


def test_newcomers_do_not_count_and_a_vanished_av_gets_only_its_crash() -> None:
    before = scene(av=(0.0, 20.0, Kind.AV, False), gone=(50.0, 20.0, Kind.AV, False))
    after = scene(av=(8.0, 20.0, Kind.AV, False), newcomer=(30.0, 20.0, Kind.HV, False))
    terms = rewards(before, after, ["av", "gone"], {}, float(np.pi / 4), P, ())
    assert terms["av"].hv_social == 0.0
    assert terms["gone"] == (0.0, 0.0, 0.0, 0.0)


def test_distance_counts_what_was_driven_and_speed_what_is_driven_now() -> None:
    before, after = (scene(av=(0.0, v, Kind.AV, False)) for v in (10.0, 20.0))
    assert rewards(before, after, ["av"], {}, 0.0, P, ())["av"].ego == pytest.approx(20 / 30 + 15 / 30)


@pytest.mark.parametrize(
    ("field", "value"),
    [("variant", "q"), ("perception_range", 0.0), ("crash", float("nan"))],
)
def test_a_wrong_weight_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(BadInput, match=field):
        RewardConfig(**{field: value})  # type: ignore[arg-type]


def test_what_others_gain_can_count_undiminished_and_less() -> None:
    flat = replace(P, eta=0.0, social=0.02, mission=150.0, perception_range=250.0)
    far, near = (decide(config=flat, hv_at=at, mission=True) for at in (200.0, 30.0))
    bystander = decide(config=flat, hv_at=30.0)
    assert far.hv_social == pytest.approx(near.hv_social), "distance makes no difference"
    assert bystander.hv_social == pytest.approx(0.02 * bystander.ego), (
        "an HV at the ego's speed, times social"
    )
    assert near.hv_social == pytest.approx(150.0 * bystander.hv_social)
    assert near.ego == bystander.ego
