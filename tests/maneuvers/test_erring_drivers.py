"""Human drivers and persons who err: what each kind does to a vehicle, and that all of it is given back."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
from conftest import Start, vehicle

from cosim.host import Host
from cosim.scenario import Fleet, load
from cosim.scenario.human_errors import (
    AbortedCutIn,
    CutIn,
    Errors,
    FailureToYield,
    ForcedEntry,
    HardBraking,
    Inattention,
    Kinds,
    RedLight,
    StalledCar,
    StepOut,
)
from cosim.scenario.vet import vetted
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Collision, Command, HumanError, Snapshot
from cosim.workers.worker import Worker

HOLD = 0.4  # s
UNTOUCHED = (31, 1621, -1.0)  # SUMO's own speed mode and lane-change mode, no speed of ours
AHEAD = vehicle("a", "av", 130.0, speed=20.0)
ALONE = vehicle("h", "hv", 100.0, speed=20.0)


class Watched(SumoSimulator):
    """Says what SUMO's driver of a vehicle heeds."""

    def modes(self, name: str) -> tuple[int, int, float]:
        vehicle = libsumo.vehicle
        held = vehicle.getSpeedWithoutTraCI(name) != vehicle.getSpeed(name)
        return vehicle.getSpeedMode(name), vehicle.getLaneChangeMode(name), 1.0 if held else -1.0


class Seen:
    """Runs in a worker: the frames of an episode of any scenario that SUMO drives."""

    def __init__(
        self, what: str, kinds: Kinds, share: float | None = None, demand: str = "", policy: str = "idm"
    ) -> None:
        fleet = None if share is None else Fleet(penetration=share)
        scenario = load(what, demand=[demand] if demand else (), fleet=fleet, warmup=0.0 if share else None)
        scenario = vetted(replace(scenario, errors=Errors("test", "", kinds, Path("test"))))
        self._host = Host(scenario, policy, 0.8)
        self._modes: list[tuple[float, dict[str, tuple[int, int]]]] = []

    def modes(self) -> list[tuple[float, dict[str, tuple[int, int]]]]:
        """After every decision of `frames`: s, and what every vehicle's driver heeds."""
        return self._modes

    def frames(self, seed: int, decisions: int) -> list[Snapshot]:
        episode = self._host.episode
        self._host.policy.reset(episode.context(seed, 0.0))
        episode.start(seed)
        found: list[Snapshot] = [episode.snapshot]
        for _ in range(decisions):
            episode.advance(self._host.policy.decide(episode.histories))
            found += episode.frames
            get = libsumo.vehicle
            modes = {name: (get.getSpeedMode(name), get.getLaneChangeMode(name)) for name in get.getIDList()}
            self._modes.append((found[-1].time, modes))
            if episode.over:
                break
        return found

    def road(self) -> Any:
        return self._host.simulator.road

    def restored(self, person: str) -> tuple[str, ...]:
        """What a person's own type says about signals and vehicles at crossings."""
        kind = libsumo.person.getTypeID(person)
        names = ("jmDriveAfterRedTime", "jmIgnoreFoeProb", "jmIgnoreFoeSpeed")
        return tuple(libsumo.vehicletype.getParameter(kind, f"junctionModel.{name}") for name in names)

    def close(self) -> None:
        self._host.close()


def level(**kinds: object) -> Errors:
    return Errors("test", "", Kinds(**kinds), Path("test"))  # type: ignore[arg-type]


def drive(
    worker: Worker, decisions: int, commands: list[Command] | None = None, watched: str = ""
) -> tuple[list[Snapshot], list[Any]]:
    """Every frame, and the modes of `watched` after every decision while it is on the road."""
    frames: list[Snapshot] = []
    modes = []
    for _ in range(decisions):
        frames += worker.call("advance", commands or [])[1]
        if watched in frames[-1].row:
            modes.append((frames[-1].time, worker.call("modes", watched)))
    return frames, modes


def errors(frames: list[Snapshot]) -> list[HumanError]:
    return [error for frame in frames for error in frame.events.errors]


def collisions(frames: list[Snapshot]) -> list[Collision]:
    return [c for frame in frames for c in frame.events.collisions]


def of(frames: list[Snapshot], name: str, field: str, since: float, until: float) -> np.ndarray[Any, Any]:
    return np.array(
        [
            getattr(f, field)[f.row[name]]
            for f in frames
            if since - 1e-6 <= f.time <= until + 1e-6 and name in f.row
        ]
    )


def given_back(frames: list[Snapshot], modes: list[Any]) -> bool:
    """Whether the driver is SUMO's own at every time at which no error is under way."""
    spans = [(e.time, e.until) for e in errors(frames)]
    free = [mode for t, mode in modes if all(not a - 1e-6 <= t <= b + 0.11 for a, b in spans)]
    return bool(free) and set(free) == {UNTOUCHED}


def through(frames: list[Snapshot], road: Any, error: HumanError) -> float:
    """s at which who errs has left the junction that it was before; `until` where it has not."""
    edges = [
        (f.time, road.lanes[int(f.lane[f.row[error.who]])].edge)
        for f in frames
        if f.time >= error.time - 1e-6 and error.who in f.row and f.lane[f.row[error.who]] >= 0
    ]
    own = edges[0][1]
    return next((t for t, edge in edges if edge != own and edge[0] != ":"), error.until)


def given_back_behind(frames: list[Snapshot], road: Any, modes: list[Any]) -> bool:
    """Whether all who erred at a junction drive as SUMO's own drivers as soon as they have left it."""
    spans = [(e.who, e.time, min(through(frames, road, e), e.until)) for e in errors(frames)]
    found = [
        here[who]
        for who, _, end in spans
        for t, here in modes
        if t > end + 0.11 and who in here and all(w != who or not a <= t <= b + 0.11 for w, a, b in spans)
    ]
    return bool(found) and set(found) == {UNTOUCHED[:2]}


def test_an_inattentive_driver_keeps_its_speed_while_its_leader_brakes(start: Start) -> None:
    kind = Inattention(rate=0.3, duration=(2.0, 2.0))
    worker = start([AHEAD, ALONE], Watched, errors=level(inattention=kind))
    frames, modes = drive(worker, 2, [Command("a", 20.0, 0, HOLD)], "h")
    assert not errors(frames)
    more = drive(worker, 28, [Command("a", 14.0, 0, HOLD)], "h")
    frames, modes = frames + more[0], modes + more[1]
    first = errors(frames)[0]
    assert (first.who, first.kind, first.near) == ("h", "inattention", "a")
    assert np.ptp(of(frames, "h", "speed", first.time, first.until)) <= 0.1
    assert np.ptp(of(frames, "a", "speed", first.time, first.until)) > 1.0
    assert of(frames, "h", "speed", first.until + 0.2, first.until + 1.0).max() < 20.0
    assert given_back(frames, modes)


def test_who_drives_alone_is_not_inattentive(start: Start) -> None:
    worker = start([ALONE], Watched, errors=level(inattention=Inattention(rate=1.0)))
    assert not errors(drive(worker, 20)[0])


def test_a_driver_brakes_hard_for_no_reason_and_drives_on(start: Start) -> None:
    kind = HardBraking(rate=0.2, deceleration=(5.0, 5.0), duration=(1.0, 1.0))
    worker = start([ALONE], Watched, errors=level(hard_braking=kind))
    frames, modes = drive(worker, 30, watched="h")
    first = errors(frames)[0]
    speed = of(frames, "h", "speed", first.time, first.until)
    assert speed[0] - speed[-1] == pytest.approx(5.0, abs=0.3)
    later = of(frames, "h", "speed", first.until + 0.4, first.until + 1.0)
    assert np.diff(later).min() > 0.0
    assert given_back(frames, modes)


def test_a_stalled_car_stops_in_its_lane_and_stands(start: Start) -> None:
    kind = StalledCar(rate=0.3, deceleration=(4.0, 4.0), duration=(5.0, 5.0))
    worker = start([ALONE], Watched, errors=level(stalled_car=kind))
    frames, modes = drive(worker, 60, watched="h")
    first = errors(frames)[0]
    standing = of(frames, "h", "speed", first.until - 4.8, first.until)
    assert standing.max() < 1e-6
    assert np.ptp(of(frames, "h", "y", first.time, first.until)) == 0.0
    assert of(frames, "h", "speed", first.until + 2.0, first.until + 2.2).min() > 1.0
    assert given_back(frames, modes)


def closing(gap: float) -> list[str]:
    """An AV at 22 m/s in the left lane, `gap` m behind a human at 16 m/s in the right."""
    return [
        vehicle("h", "hv", 100.0, speed=16.0, more='speedFactor="0.64"'),
        vehicle("a", "av", 95.0 - gap, lane=1, speed=22.0, more='speedFactor="0.88"'),
    ]


def test_a_cut_in_takes_a_gap_that_the_follower_can_just_manage(start: Start) -> None:
    worker = start(closing(11.0), Watched, errors=level(cut_in=CutIn(rate=1.0)))
    frames, modes = drive(worker, 12, watched="h")
    (found,) = errors(frames)
    assert found.near == "a"
    before = next(f for f in frames if f.time >= found.time - 1e-6)
    h, a = before.row["h"], before.row["a"]
    gap = before.x[h] - before.x[a] - 5.0
    asked = (before.speed[a] - before.speed[h]) ** 2 / (2.0 * gap)
    assert 3.0 <= asked <= 8.0
    across = of(frames, "h", "y", found.time, found.until + 0.2)
    assert across[-1] - across[0] == pytest.approx(3.2, abs=0.3)
    assert not collisions(frames), "who comes brakes in time"
    assert given_back(frames, modes)


def test_nobody_cuts_in_where_the_follower_has_time_enough(start: Start) -> None:
    worker = start(closing(60.0), Watched, errors=level(cut_in=CutIn(rate=1.0)))
    assert not errors(drive(worker, 10)[0])


def test_an_aborted_cut_in_ends_in_its_own_lane(start: Start) -> None:
    worker = start(closing(11.0), Watched, errors=level(aborted_cut_in=AbortedCutIn(rate=1.0)))
    frames, modes = drive(worker, 20, watched="h")
    first = errors(frames)[0]
    across = of(frames, "h", "y", first.time, first.until + 0.2)
    assert across.max() - across[0] > 2.5
    assert across[-1] == pytest.approx(across[0], abs=0.2)
    assert given_back(frames, modes)


def contested(
    world: str, seed: int, decisions: int, **kinds: object
) -> tuple[list[Snapshot], Any, list[Any]]:
    """Frames, road and `Seen.modes` of a contested episode."""
    worker = Worker(Seen, world, Kinds(**kinds), None, "contested")  # type: ignore[arg-type]
    try:
        return worker.call("frames", seed, decisions), worker.call("road"), worker.call("modes")
    finally:
        worker.close()


@pytest.mark.parametrize("patience", [3.0, 6.0])
def test_who_forces_its_way_in_has_lost_its_patience(patience: float) -> None:
    kind = ForcedEntry(rate=1.0, patience=patience, lag=0.0)
    frames, _, modes = contested("merge", 100000, 80, forced_entry=kind)
    first = next(e for e in errors(frames) if e.who == "mission.0")
    waited = re.search(r"after (\d+) s", first.what)
    assert waited is not None
    assert patience + 1 <= int(waited[1]) <= patience + 3
    lanes = of(frames, "mission.0", "lane", first.time, first.time + 3.0)
    assert lanes[0] != lanes[-1]
    assert given_back(frames, [(t, (*here["mission.0"], -1.0)) for t, here in modes if "mission.0" in here])


def test_who_refuses_every_gap_in_which_somebody_comes_stays_in_its_lane() -> None:
    begun = []
    for lag in (0.0, 100.0):
        kind = ForcedEntry(rate=1.0, patience=3.0, lag=lag)
        frames, _, _ = contested("merge", 100000, 60, forced_entry=kind)
        begun.append([e for e in errors(frames) if e.who == "mission.0"])
    assert begun[0]
    assert "must brake" in begun[0][0].what
    assert all("nobody comes" in e.what for e in begun[1])
    lanes = of(frames, "mission.0", "lane", begun[0][0].time, begun[0][0].time + 3.0)
    assert np.ptp(lanes) == 0, "it waits where the other one forces its way in"


def test_who_forces_its_way_in_at_a_line_enters_and_goes_through() -> None:
    kind = ForcedEntry(rate=1.0, patience=3.0, lag=0.0)
    frames, road, modes = contested("intersection", 100000, 100, forced_entry=kind)
    first = next(e for e in errors(frames) if e.who == "mission.0")
    before = of(frames, first.who, "speed", first.time - 2.0, first.time)
    assert before.max() < 3.0, "it has waited"
    through_at = through(frames, road, first)
    assert first.time < through_at < first.until
    after = of(frames, first.who, "speed", first.time, through_at)
    assert np.diff(after).min() > -0.5, "it does not stop again"
    assert given_back_behind(frames, road, modes)


def test_the_longer_one_has_waited_the_likelier_it_forces_its_way_in() -> None:
    from cosim.simulation.driver_errors.crossing import hazard

    kind = ForcedEntry(rate=0.03, patience=3.0)
    assert [hazard(kind, s) for s in (1, 3, 4, 13, 60)] == pytest.approx([0.0, 0.0, 0.03, 0.3, 1.0])


def test_a_driver_who_does_not_yield_enters_without_slowing_down() -> None:
    kind = FailureToYield(rate=1.0)
    frames, road, modes = contested("intersection", 100001, 100, failure_to_yield=kind)
    first = next(e for e in errors(frames) if e.who == "mission.0")
    assert first.near
    inside = next(
        f for f in frames if f.time > first.time and road.lanes[f.lane[f.row[first.who]]].edge.startswith(":")
    )
    assert inside.time - first.time < 4.0
    assert of(frames, first.who, "speed", first.time, inside.time).min() > 5.0
    assert given_back_behind(frames, road, modes)


def test_who_runs_a_red_light_passes_within_the_seconds_that_its_kind_allows(
    law_worlds: dict[str, Path],
) -> None:
    late = 2.0
    worker = Worker(
        Seen, str(law_worlds["grid_signals"]), Kinds(red_light=RedLight(rate=1.0, late=late)), 0.1
    )
    try:
        frames: list[Snapshot] = worker.call("frames", 3, 300)
        road, modes = worker.call("road"), worker.call("modes")
    finally:
        worker.close()
    found = errors(frames)
    assert len(found) > 3
    signal_of = {link.origin: link.signal for link in road.links}
    for error in found:
        before = next(f for f in frames if f.time >= error.time)
        lane = int(before.lane[before.row[error.who]])
        passed = next(f for f in frames if f.time > error.time and f.lane[f.row[error.who]] != lane)
        states = [
            (f.time, chr(f.signals[signal_of[lane]])) for f in frames if error.time <= f.time <= passed.time
        ]
        red = [t for t, state in states if state == "r"]
        assert red, "on red"
        assert passed.time - red[0] <= late + 0.5
    assert given_back_behind(frames, road, modes)


def test_a_person_steps_out_and_looks_again_afterwards(law_worlds: dict[str, Path], tmp_path: Path) -> None:
    """As its own type says, where that says something."""
    config = law_worlds["crossing_signals"]
    demand = (config.parent / "demand.rou.xml").read_text()
    own = '<vType id="careless" vClass="pedestrian" jmIgnoreFoeProb="0.25"/>'
    demand = demand.replace("<routes>", f"<routes>{own}")
    demand = demand.replace('<personFlow id="p_we"', '<personFlow id="p_we" type="careless"')
    (tmp_path / "walks.rou.xml").write_text(demand)
    kind = StepOut(rate=1.0, duration=(4.0, 4.0))
    worker = Worker(Seen, str(config), Kinds(step_out=kind), 0.1, str(tmp_path / "walks.rou.xml"))
    try:
        frames: list[Snapshot] = worker.call("frames", 3, 200)
        found = errors(frames)
        assert found
        walks = [of(frames, e.who, "speed", e.time + 0.4, e.time + 3.0).max() > 0.5 for e in found]
        assert np.mean(walks) > 0.7
        last = frames[-1]
        over = {e.who for e in found if e.until < last.time - 0.2 and e.who in last.row}
        over -= {e.who for e in found if e.until >= last.time - 0.2}
        assert {"p_we" in who for who in over} == {False, True}
        for who in over:
            own = "0.25" if "p_we" in who else "0"
            assert worker.call("restored", who.removeprefix("person:")) == ("-1", own, "0")
    finally:
        worker.close()


@pytest.mark.parametrize("errs", [False, True])
def test_a_driver_with_mobil_changes_no_lanes_while_it_errs(start: Start, errs: bool) -> None:
    """It would: somebody slow is ahead and the next lane is empty."""
    slow = vehicle("s", "av", 150.0, speed=10.0)
    kinds = level(inattention=Inattention(rate=1.0, duration=(3.0, 3.0))) if errs else None
    more = {"behavior": "aggressive", "driver_model": "mobil"}
    worker = start([slow, vehicle("h", "hv", 115.0, speed=10.0)], Watched, errors=kinds, **more)
    frames, _ = drive(worker, 20, [Command("s", 8.0, 0, HOLD)])
    begun = errors(frames)[0].time if errs else frames[0].time
    across = of(frames, "h", "y", begun + 2.0 * errs, begun + (3.0 if errs else 8.0))
    assert (np.ptp(across) > 2.0) != errs


def test_two_humans_who_crash_become_wrecks_and_the_episode_goes_on(start: Start) -> None:
    """`on_collision` is `end`: only an AV or the mission vehicle ends it."""
    kinds = level(inattention=Inattention(rate=1.0, duration=(8.0, 8.0)))
    stands = vehicle("s", "hv", 160.0, speed=0.0).removesuffix("/>")
    stands += '><stop lane="main_in_0" endPos="170" duration="1000"/></vehicle>'
    worker = start([stands, vehicle("h", "hv", 110.0, speed=20.0)], Watched, errors=kinds)
    frames, _ = drive(worker, 40)
    (crash,) = collisions(frames)
    assert {crash.collider, crash.victim} == {"h", "s"}
    assert crash.human_error_involved
    assert not crash.crash
    gone = [name for f in frames for name in f.events.wrecks_removed]
    assert sorted(gone) == ["h", "s"]


@pytest.mark.parametrize("errs", [False, True])
def test_whoever_errs_ahead_of_a_collision_has_a_part_in_it(start: Start, errs: bool) -> None:
    kind = HardBraking(rate=1.0 if errs else 1e-12, deceleration=(5.0, 5.0), duration=(2.0, 2.0))
    cars = [ALONE, vehicle("v", "av", 70.0, speed=20.0), vehicle("a", "av", 45.0, speed=20.0)]
    worker = start(cars, Watched, errors=level(hard_braking=kind))
    frames, _ = drive(worker, 20, [Command("v", 14.0, 0, HOLD), Command("a", 28.0, 0, HOLD)])
    crash = collisions(frames)[0]
    assert {crash.collider, crash.victim} == {"a", "v"}
    assert crash.human_error_involved == errs


def test_another_policy_meets_the_same_errors() -> None:
    """All that could begin in both: a driver brakes for no reason wherever it drives."""
    begun = []
    for policy in ("idm", "altruist-rule"):
        kinds = Kinds(hard_braking=HardBraking(rate=0.01))
        worker = Worker(Seen, "merge", kinds, None, "contested", policy)
        try:
            frames: list[Snapshot] = worker.call("frames", 100001, 50)
        finally:
            worker.close()
        begun.append({(e.who, e.time) for e in errors(frames)})
    assert len(begun[0]) > 3
    assert len(begun[0] & begun[1]) >= 0.8 * len(begun[0] | begun[1])


def test_avs_never_err(start: Start) -> None:
    worker = start([vehicle("a", "av", 100.0)], Watched, errors=level(hard_braking=HardBraking(rate=1.0)))
    assert not errors(drive(worker, 10)[0])
