"""Commanded AVs in real SUMO: what a meta-action does to the car, and what becomes of refused ones."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from conftest import Start, vehicle

import cosim
from cosim.errors import BadInput
from cosim.geometry import boxes, overlapping_pairs
from cosim.scenario import Scenario, load
from cosim.scenario.sensing import read
from cosim.simulation.backend import sumo
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Collision, Command, Receipt, Snapshot
from cosim.workers.worker import Worker

HOLD = 0.4  # s


def drive(
    worker: Worker, commands: list[Command], decisions: int = 1
) -> tuple[list[tuple[Receipt, ...]], list[Snapshot]]:
    """The same commands for some decisions: receipts of each, all frames."""
    receipts, frames = [], []
    for _ in range(decisions):
        r, f = worker.call("advance", commands)
        receipts.append(r)
        frames += f
    return receipts, frames


def of(frames: list[Snapshot], name: str, field: str) -> np.ndarray:
    return np.array([getattr(f, field)[f.row[name]] for f in frames if name in f.row])


def collisions(frames: list[Snapshot]) -> list[Collision]:
    return [c for f in frames for c in f.events.collisions]


def test_braking_by_two_steps_uses_eight_at_most_and_settles_ten_below(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0, speed=20.0)])
    _, frames = drive(worker, [Command("a", 10.0, 0, HOLD)], 10)
    speed = of(frames, "a", "speed")
    assert of(frames, "a", "accel").min() == pytest.approx(-8.0, abs=1e-6)
    assert speed[-1] == pytest.approx(10.0, abs=0.1)
    assert (np.diff(speed) <= 1e-9).all(), "it never speeds up again on the way"


def test_accelerating_is_limited_to_three(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0, speed=10.0)])
    _, frames = drive(worker, [Command("a", 25.0, 0, HOLD)], 5)
    assert of(frames, "a", "accel").max() == pytest.approx(3.0, abs=1e-6)
    assert of(frames, "a", "speed")[-1] == pytest.approx(10.0 + 3.0 * 2.0, abs=0.1)


def test_a_lane_change_takes_two_seconds_and_turns_the_car_meanwhile(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0, speed=20.0)])
    first, early = drive(worker, [Command("a", 20.0, 1, HOLD)])
    rest, late = drive(worker, [Command("a", 20.0, 0, HOLD)], 6)
    y = of(early + late, "a", "y")
    assert first[0][0].executed
    assert all(r[0].executed for r in rest)
    assert y[9] - y[0] == pytest.approx(3.2 * 1.8 / 2.0, abs=0.25), "1.6 m/s sideways"
    assert y[-1] == pytest.approx(y[-2], abs=0.05), "and then straight on"
    assert of(early + late, "a", "heading").max() > 0.05
    assert of(late, "a", "lane")[-1] != of(early, "a", "lane")[0]


BUS = (
    '<vType id="av@bus" vClass="bus" emissionClass="HBEFA3/Bus" height="3.2" mass="12000" length="12"/>'
    '<vehicle id="a" type="av@bus" route="main" depart="0" departPos="100" departSpeed="10"/>'
)


class Bodies(SumoSimulator):
    """It tells what SUMO takes a vehicle for."""

    def body(self, name: str) -> tuple[object, ...]:
        fields = "Length", "Height", "ShapeClass", "EmissionClass", "Mass", "VehicleClass"
        return tuple(getattr(sumo.vehicle, f"get{field}")(name) for field in fields)


def test_a_commanded_bus_stays_a_bus(start: Start) -> None:
    """Its emissions and its picture too: only the driver is another one."""
    worker = start([BUS], simulator=Bodies, preset="lawful")
    before = worker.call("body", "a")
    drive(worker, [Command("a", 12.0, 0, HOLD)], 3)
    assert before == (12.0, 3.2, "bus", "HBEFA3/Bus", 12000.0, "bus")
    assert worker.call("body", "a") == before


def test_a_second_lane_change_meanwhile_and_one_off_the_road_are_refused_with_a_reason(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0)])
    drive(worker, [Command("a", 20.0, 1, HOLD)])
    (during,), _ = drive(worker, [Command("a", 20.0, -1, HOLD)])
    assert during[0] == Receipt("a", False, "a lane change is under way")
    drive(worker, [Command("a", 20.0, 0, HOLD)], 5)
    (off,), _ = drive(worker, [Command("a", 20.0, 1, HOLD)])
    assert off[0] == Receipt("a", False, "no lane on that side")


def test_where_lane_changes_are_forbidden_the_map_shows_no_lane_beside_and_the_receipt_says_why(
    start: Start,
) -> None:
    """The entry edges, on which demand settles: changeLeft and changeRight allow nobody."""
    entering = (
        '<route id="far" edges="entry main_in main_acc main_out"/><vehicle id="a" type="av" route="far" '
        'depart="0" departPos="20" departSpeed="20"/>'
    )
    (receipts,), frames = drive(start([entering]), [Command("a", 20.0, 1, HOLD)])
    assert receipts == (Receipt("a", False, "lane changes are forbidden here"),)
    assert np.ptp(of(frames, "a", "y")) == pytest.approx(0.0, abs=0.01)
    with cosim.open("merge") as session:
        lanes = {lane.id: lane for lane in session.road().lanes}
    for name, left, right in (
        ("entry_0", False, False),
        ("entry_1", False, False),
        ("main_in_0", True, False),
    ):
        assert (lanes[name].left >= 0, lanes[name].right >= 0) == (left, right)


def test_a_command_for_a_car_that_is_not_there_says_so(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0)])
    (receipts,), _ = drive(worker, [Command("ghost", 20.0, 0, HOLD)])
    assert receipts == (Receipt("ghost", False, "not on the road"),)


def test_an_av_that_nobody_commands_keeps_the_headway_that_its_policy_names(start: Start) -> None:
    cars = [vehicle(f"leader{lane}", "av", 150.0, lane, speed=10.0) for lane in (0, 1)]  # nobody overtakes
    slow = [Command(f"leader{lane}", 10.0, 0, HOLD) for lane in (0, 1)]
    gaps = []  # m, bumper to bumper
    for headway in ("0.8", "2.2"):
        simulator = partial(SumoSimulator, av_parameters={"tau": headway})
        worker = start([*cars, vehicle("a", "av", 110.0, speed=10.0)], simulator)
        _, frames = drive(worker, slow, 50)
        gaps.append(of(frames, "leader0", "x")[-1] - of(frames, "a", "x")[-1] - 5.0)
    free = 1.0 - (10.0 / 25.0) ** 4  # IDM's gap at a constant speed is wider by the root of it
    assert gaps == pytest.approx([(2.0 + 8.0) / np.sqrt(free), (2.0 + 22.0) / np.sqrt(free)], abs=0.5)


def test_an_av_parameter_that_is_no_number_is_refused_by_name(start: Start) -> None:
    with pytest.raises(BadInput, match=r"av_parameters\.tau='soon': must be a number above 0"):
        start([vehicle("a", "av", 100.0)], partial(SumoSimulator, av_parameters={"tau": "soon"}))


def test_unguarded_the_agent_can_run_into_a_stopped_car_and_is_blamed_once(start: Start) -> None:
    stop = '><stop lane="main_in_0" endPos="200" duration="100"/></vehicle>'
    stopped = vehicle("s", "hv", 190.0, speed=0.0).removesuffix("/>") + stop
    worker = start([vehicle("a", "av", 100.0, speed=20.0), stopped])
    _, frames = drive(worker, [Command("a", 20.0, 0, HOLD)], 16)
    (crash,) = collisions(frames)
    assert (crash.collider, crash.victim) == ("a", "s")
    assert crash.collider_is_av
    assert not crash.victim_is_av
    assert crash.av_caused
    assert crash.lane == "main_in_0"


def test_guarded_the_same_agent_is_stopped_by_sumo(start: Start) -> None:
    stop = '><stop lane="main_in_0" endPos="200" duration="100"/></vehicle>'
    stopped = vehicle("s", "hv", 190.0, speed=0.0).removesuffix("/>") + stop
    worker = start([vehicle("a", "av", 100.0, speed=20.0), stopped], preset="guarded")
    _, frames = drive(worker, [Command("a", 20.0, 0, HOLD)], 25)
    assert not collisions(frames)
    assert of(frames, "a", "speed")[-1] < 0.5


def test_unguarded_a_change_into_a_neighbour_crashes_guarded_it_is_refused(start: Start) -> None:
    cars = [vehicle("a", "av", 100.0, lane=0), vehicle("b", "hv", 101.0, lane=1)]
    _, frames = drive(start(cars), [Command("a", 20.0, 1, HOLD)], 6)
    crash = collisions(frames)[0]
    assert {crash.collider, crash.victim} == {"a", "b"}
    (receipts, *_), frames = drive(start(cars, preset="guarded"), [Command("a", 20.0, 1, HOLD)], 6)
    assert not collisions(frames)
    assert not receipts[0].executed
    assert "lane-change safety" in str(receipts[0].blocked)


def test_cutting_in_close_before_a_faster_car_is_the_av_s_fault(start: Start) -> None:
    cars = [vehicle("a", "av", 112.0, lane=0, speed=10.0), vehicle("h", "hv", 90.0, lane=1, speed=25.0)]
    worker = start(cars)
    drive(worker, [Command("a", 10.0, 0, HOLD)], 2)
    _, frames = drive(worker, [Command("a", 10.0, 1, HOLD)], 6)
    crash = collisions(frames)[0]
    assert {crash.collider, crash.victim} == {"a", "h"}
    assert crash.av_caused


def test_a_cut_in_stays_the_av_s_fault_when_it_is_handed_back_to_sumo(start: Start) -> None:
    cars = [vehicle("a", "av", 112.0, lane=0, speed=10.0), vehicle("h", "hv", 90.0, lane=1, speed=25.0)]
    worker = start(cars)
    drive(worker, [Command("a", 10.0, 0, HOLD)], 2)
    _, first = drive(worker, [Command("a", 10.0, 1, HOLD)])
    _, frames = drive(worker, [], 5)
    crash = collisions(first + frames)[0]
    assert (crash.collider, crash.victim) == ("h", "a")
    assert crash.av_caused


@pytest.mark.parametrize("options", [(), (("max-depart-delay", "3"),)], ids=["waits", "given up"])
def test_who_found_no_room_is_counted_also_when_sumo_has_given_him_up(
    start: Start, options: tuple[tuple[str, str], ...]
) -> None:
    cars = [vehicle(f"h{k:02}", "hv", 5.0) for k in range(30)]
    worker = start(cars, options=options)
    drive(worker, [], 25)
    counts = worker.call("counts")
    assert 1 < counts["inserted"] < 15
    assert counts["inserted"] + counts["waiting"] == 30


def test_passing_the_tail_of_a_car_that_changed_lanes_at_a_crawl_is_no_crash(start: Start) -> None:
    """SUMO leaves it 30 degrees askew, its tail in the lane it has left; its drivers do not see that tail."""
    cars = [vehicle("slow", "av", 130.0, lane=0, speed=0.4), vehicle("a", "av", 110.0, lane=0, speed=0.0)]
    worker = start(cars)
    _, changing = drive(worker, [Command("slow", 0.4, 1, HOLD), Command("a", 0.0, 0, HOLD)])
    _, waiting = drive(worker, [Command("slow", 0.4, 0, HOLD), Command("a", 0.0, 0, HOLD)], 5)
    _, passing = drive(worker, [Command("slow", 0.4, 0, HOLD), Command("a", 5.0, 0, HOLD)], 20)
    assert np.degrees(of(waiting, "slow", "heading").max()) > 25.0
    both = [overlapping_pairs(boxes(f)) for f in passing]
    assert any(len(pairs) for pairs in both), "the boxes as drawn do touch"
    assert of(passing, "a", "x")[-1] > of(passing, "slow", "x")[-1], "it has passed"
    assert not collisions(changing + waiting + passing)


def test_an_av_that_is_released_follows_its_leader_again(start: Start) -> None:
    cars = [
        vehicle("a", "av", 100.0, speed=20.0),
        vehicle("l", "hv", 130.0, speed=12.0, more='arrivalSpeed="12"'),
    ]
    worker = start(cars)
    drive(worker, [Command("a", 20.0, 0, HOLD)])
    _, frames = drive(worker, [], 20)
    assert not collisions(frames)
    assert worker.call("commanded", "a") == (None, 0)
    gap = of(frames, "l", "x") - of(frames, "a", "x") - 5.0
    assert gap.min() > 1.0


def test_an_av_that_reaches_the_end_of_its_lane_stops_and_that_is_no_crash(start: Start) -> None:
    ramp = (
        '<route id="up" edges="ramp main_acc main_out"/><vehicle id="a" type="av" route="up" depart="0" '
        'departPos="420" departSpeed="20"/>'
    )
    worker = start([ramp])
    _, frames = drive(worker, [Command("a", 20.0, 0, HOLD)], 40)
    assert not collisions(frames)
    assert of(frames, "a", "speed")[-1] < 0.1
    assert any("a" in f.events.emergency_stopped for f in frames)


def test_the_centre_is_half_a_length_behind_sumo_s_front_bumper(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0, speed=0.0)], warmup=0.1)
    snapshot = worker.call("reset", 1)[-1]
    row = snapshot.row["a"]
    along = snapshot.lane_position[row]
    assert snapshot.x[row] == pytest.approx(-600.0 + along - 2.5, abs=0.01)
    assert snapshot.heading[row] == pytest.approx(0.0, abs=1e-6)


class Getters:
    """Both ways to read the same vehicle, in the process that holds the simulation."""

    def __init__(self, scenario: Scenario) -> None:
        self._simulator = SumoSimulator(scenario)

    def read(self, name: str) -> list[tuple[object, object]]:
        import libsumo

        from cosim.simulation.backend import sumo
        from cosim.simulation.convert import READ

        self._simulator.reset(0)
        pairs = [(sumo.getter("vehicle", read), getattr(libsumo.vehicle, f"get{read}")) for read in READ]
        return [(fast(name), slow(name)) for fast, slow in pairs]


def test_the_compiled_getters_read_what_the_public_ones_do() -> None:
    with Worker(Getters, load("highway")) as worker:
        pairs = worker.call("read", "right.0")
    assert len(pairs) == 9
    assert all(fast == slow for fast, slow in pairs)


def test_an_acceleration_is_held_from_decision_to_decision(start: Start) -> None:
    worker = start([vehicle("a", "av", 50.0)])
    _, frames = drive(worker, [Command("a", 0.0, 0, HOLD, accel=-1.5)], 5)
    assert frames[-1].speed[0] == pytest.approx(20.0 - 1.5 * 5 * HOLD, abs=0.01)


@pytest.mark.parametrize("latency", [0.1, 0.2, 0.3, 0.4])
def test_a_decision_acts_as_much_later_as_it_takes_to_compute(start: Start, latency: float) -> None:
    sensing = read(f"ideal,decision_latency={latency:g}")
    worker = start([vehicle("a", "av", 100.0, speed=20.0)], sensing=sensing)
    _, frames = drive(worker, [Command("a", 20.0, 0, HOLD, accel=0.0)], 2)
    speed = of(frames, "a", "speed")[-1]  # m/s, and it stays
    (receipts, then), frames = drive(worker, [Command("a", 19.2, 0, HOLD, accel=-2.0)], 2)
    assert receipts == then == (Receipt("a", True),)
    since = 0.2 * np.arange(1, 5)  # s since the decision, of the frames
    braked = np.maximum(since - latency, 0.0)  # s
    assert of(frames, "a", "speed") == pytest.approx(speed - 2.0 * braked, abs=1e-3)


def test_with_a_decision_latency_a_refusal_is_known_when_the_command_has_had_its_time(start: Start) -> None:
    cars = [vehicle("a", "av", 100.0, speed=20.0), vehicle("beside", "hv", 100.0, lane=1, speed=20.0)]
    late = read("ideal,decision_latency=0.2")
    worker = start(cars, preset="guarded", sensing=late)
    (first, second, third), _ = drive(worker, [Command("a", 20.0, 1, HOLD)], 3)
    assert first == ()
    assert "lane-change safety" in str(second[0].blocked)
    assert second[0] == third[0]


def test_a_decision_cannot_take_longer_than_until_the_next_one(start: Start) -> None:
    with pytest.raises(BadInput, match=r"decision_latency.*at most the 0\.4 s between decisions"):
        start([], sensing=read("ideal,decision_latency=0.5"))
