"""MOBIL and IDM as pure functions: hand-computed traffic situations (no SUMO is started)."""

import math

import pytest

from cosim.errors import BadInput
from cosim.scenario.behaviors import IdmParameters, MobilParameters, load_behaviors
from cosim.simulation.mobil import (
    FREE_ROAD,
    Car,
    Nearby,
    Situation,
    accelerations,
    best_incentive,
    change_gain,
    idm_acceleration,
    incentive,
    is_safe,
)
from sumo_scenarios import BEHAVIORS

MODERATE_IDM = IdmParameters(1.0, 2.0, 3.0, 7.0)
MODERATE = MobilParameters(0.3, 0.1, 6.0)
EGOIST = MobilParameters(0.0, 0.1, 6.0)
ALTRUIST = MobilParameters(1.0, 0.1, 6.0)


def car(speed: float, desired: float = 25.0) -> Car:
    return Car(speed, desired, 5.0, MODERATE_IDM)


def test_a_car_at_rest_on_a_free_road_takes_its_full_acceleration() -> None:
    assert idm_acceleration(MODERATE_IDM, 0.0, 25.0) == pytest.approx(3.0)


def test_a_car_at_its_desired_speed_neither_accelerates_nor_brakes() -> None:
    assert idm_acceleration(MODERATE_IDM, 25.0, 25.0) == pytest.approx(0.0)


def test_idm_equals_the_equation_computed_by_hand() -> None:
    # v = 20, v0 = 25, dv = 5, d = 40: d* = 2 + 20 + 20*5/(2 sqrt 21) = 32.9109; a = 3 (1 - .4096 - .67695)
    assert idm_acceleration(MODERATE_IDM, 20.0, 25.0, 40.0, 15.0) == pytest.approx(-0.25963, abs=2e-4)


def test_a_leader_who_pulls_away_does_not_shrink_the_wished_gap_below_the_minimum_gap() -> None:
    pulled = idm_acceleration(MODERATE_IDM, 20.0, 25.0, 10.0, 60.0)
    assert pulled == pytest.approx(3.0 * (1 - 0.8**4 - (2.0 / 10.0) ** 2))


def test_steady_following_keeps_the_minimum_gap_plus_the_time_headway() -> None:
    for driver in load_behaviors().classes.values():
        idm, speed = driver.idm, 10.0
        gap = (idm.minimum_gap + speed * idm.time_headway) / math.sqrt(1 - (speed / 1000.0) ** 4)
        assert idm_acceleration(idm, speed, 1000.0, gap, speed) == pytest.approx(0.0, abs=1e-9)


def test_a_blocked_lane_beside_a_free_lane_is_worth_leaving() -> None:
    s = Situation(car(20.0), Nearby(20.0, car(10.0)), None, None, None)
    a = accelerations(s)
    assert a.ego < -5.0
    assert a.ego_after == pytest.approx(3.0 * (1 - 0.8**4))
    assert change_gain(a, MODERATE) is not None
    assert incentive(a, 0.3) == pytest.approx(a.ego_after - a.ego)


def test_two_equally_free_lanes_give_no_reason_to_change() -> None:
    a = accelerations(Situation(car(20.0), None, None, None, None))
    assert incentive(a, 0.0) == 0.0
    assert change_gain(a, MobilParameters(0.0, 0.0, 12.0)) is None


def test_a_fast_follower_close_behind_in_the_new_lane_forbids_the_change_whatever_it_is_worth() -> None:
    s = Situation(car(15.0), Nearby(5.0, car(5.0)), None, None, Nearby(10.0, car(28.0, 30.0)))
    a = accelerations(s)
    assert incentive(a, 0.0) > 10.0
    assert a.new_follower_after < -6.0
    assert not is_safe(a, EGOIST)
    assert change_gain(a, EGOIST) is None
    far_back = accelerations(s._replace(new_follower=Nearby(90.0, car(28.0, 30.0))))
    assert change_gain(far_back, EGOIST) is not None


def test_an_aggressive_driver_takes_a_gap_that_a_conservative_one_refuses() -> None:
    drivers = load_behaviors().classes
    s = Situation(car(20.0), Nearby(12.0, car(12.0)), None, None, Nearby(14.0, car(22.0)))
    a = accelerations(s)
    assert -12.0 < a.new_follower_after < -2.0
    assert change_gain(a, drivers["aggressive"].mobil) is not None
    assert not is_safe(a, drivers["conservative"].mobil)


def test_full_politeness_refuses_a_change_that_costs_the_follower_more_than_it_gains() -> None:
    s = Situation(car(22.0), Nearby(60.0, car(22.0)), None, Nearby(200.0, car(24.0)), Nearby(30.0, car(24.0)))
    a = accelerations(s)
    own, cost = a.ego_after - a.ego, a.new_follower - a.new_follower_after
    assert own > 0.1
    assert cost > own
    assert is_safe(a, ALTRUIST)
    assert change_gain(a, EGOIST) is not None
    assert change_gain(a, ALTRUIST) is None


def test_full_politeness_moves_over_for_a_pressing_follower_behind() -> None:
    s = Situation(car(20.0, 20.0), None, Nearby(12.0, car(24.0, 30.0)), None, None)
    a = accelerations(s)
    assert a.ego_after == a.ego  # nothing in it for the driver itself
    assert change_gain(a, ALTRUIST) is not None
    assert change_gain(a, EGOIST) is None


def test_no_politeness_makes_a_driver_brake_harder_than_the_safe_limit_for_others() -> None:
    s = Situation(car(25.0, 30.0), None, Nearby(3.0, car(30.0, 35.0)), Nearby(8.0, car(10.0)), None)
    a = accelerations(s)
    assert incentive(a, 1.0) > 0.1
    assert change_gain(a, ALTRUIST) is None


def test_the_new_follower_follows_the_new_leader_across_the_changers_place_until_the_change() -> None:
    s = Situation(car(20.0), None, None, Nearby(30.0, car(20.0)), Nearby(15.0, car(20.0)))
    a = accelerations(s)
    assert a.new_follower == pytest.approx(idm_acceleration(MODERATE_IDM, 20.0, 25.0, 50.0, 20.0))
    assert a.new_follower_after == pytest.approx(idm_acceleration(MODERATE_IDM, 20.0, 25.0, 15.0, 20.0))


def test_an_empty_lane_bounds_what_any_lane_can_offer() -> None:
    own = Situation(car(20.0), Nearby(30.0, car(18.0)), Nearby(10.0, car(21.0)), None, None)
    for gap_ahead in (5.0, 20.0, 80.0, FREE_ROAD):
        for gap_behind in (5.0, 20.0, 80.0):
            beside = own._replace(
                new_leader=Nearby(gap_ahead, car(19.0)), new_follower=Nearby(gap_behind, car(22.0))
            )
            for p in (0.0, 0.3, 1.0):
                assert incentive(accelerations(beside), p) <= best_incentive(own, p) + 1e-9


def test_overlapping_vehicles_are_never_a_safe_gap() -> None:
    a = accelerations(Situation(car(20.0), None, None, None, Nearby(-2.0, car(20.0))))
    assert not is_safe(a, MobilParameters(0.0, 0.0, 12.0))


# ---------------------------------------------------------------- behaviors.yaml

TABLE_II = {  # p, a_th, b_safe, T, d0, a_max, a_des
    "aggressive": (0.0, 0.0, 12.0, 0.5, 1.0, 7.0, 12.0),
    "moderate": (0.3, 0.1, 6.0, 1.0, 2.0, 3.0, 7.0),
    "conservative": (1.0, 0.4, 2.0, 3.0, 6.0, 1.0, 2.0),
}


def test_the_shipped_behaviors_are_table_ii() -> None:
    behaviors = load_behaviors()
    found = {
        name: (
            c.mobil.politeness,
            c.mobil.threshold,
            c.mobil.safe_deceleration,
            c.idm.time_headway,
            c.idm.minimum_gap,
            c.idm.max_acceleration,
            c.idm.comfortable_deceleration,
        )
        for name, c in behaviors.classes.items()
    }
    assert found == TABLE_II
    assert [round(share, 9) for _, share in behaviors.mixed] == [round(1 / 3, 9), round(2 / 3, 9), 1.0]


def test_the_desired_speed_follows_its_distribution_and_its_bounds() -> None:
    desired = load_behaviors().desired_speed
    assert desired.draw(0.5) == pytest.approx(1.0)
    assert desired.draw(0.8413447) == pytest.approx(1.1, abs=1e-4)
    assert desired.draw(1e-12) == 0.8
    assert desired.draw(1 - 1e-12) == 1.2


@pytest.mark.parametrize(
    ("old", "new", "field", "value"),
    [
        ("lcAssertive: 1", "lcAssertivness: 1", "lc2013", "lcAssertivness"),
        ("time_headway: 0.5", "time_headway: .nan", "classes.aggressive.idm.time_headway", "nan"),
        ("time_headway: 0.5", "time_headway: -1", "classes.aggressive.idm.time_headway", "-1"),
        ("politeness: 0.3", "politeness: much", "classes.moderate.mobil.politeness", "much"),
        ("politeness: 0.3, ", "", "classes.moderate.mobil.politeness", ""),
        ("  aggressive: 1", "  angry: 1", "mixed", "angry"),
        ("mobil_period: 1.0", "mobil_period: 0", "mobil_period", "0"),
        ("  deviation: 0.1", "  deviation: [1", "", ""),
    ],
)
def test_a_wrong_behaviors_file_is_refused_by_file_field_and_value(tmp_path, old, new, field, value) -> None:
    text = BEHAVIORS.read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(BadInput) as refused:
        load_behaviors(file)
    message = str(refused.value)
    assert "mine.yaml" in message
    assert field in message
    assert value in message


def test_a_missing_behaviors_file_is_named(tmp_path) -> None:
    with pytest.raises(BadInput, match=r"nowhere\.yaml"):
        load_behaviors(tmp_path / "nowhere.yaml")
