"""The car without an agent: every AV asks for more speed at every decision, whatever it sees."""

from policy_scenes import Car, histories, straight_road

from cosim.policies import make
from cosim.types import MetaAction


def test_it_asks_for_more_speed_behind_a_standing_car_too() -> None:
    road = straight_road()
    seen = histories(road, [Car("av", 0.0, 0, 20.0, is_av=True), Car("hv", 15.0, 0, 0.0)])
    decisions = make("car-alone").decide(seen)
    assert {av: decision.action for av, decision in decisions.items()} == {"av": MetaAction.ACCELERATE}
