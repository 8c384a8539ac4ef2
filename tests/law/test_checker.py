"""The checker of the law counts what was made to happen, and nothing where SUMO drives."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.law import Case, cases, differences, driven
from cosim.simulation.net import NetReader
from cosim.types import Preset
from cosim.workers.worker import Worker
from tests.law.checker import Law, Net, Program, check
from tests.worlds.build import NAMES

FIRST = 120_000  # seed
# A road from west to east (13 m/s) crosses one from south to north (10 m/s) on junction J.
NET = """<net version="1.20">
<edge id=":J_0" function="internal"><lane id=":J_0_0" index="0" speed="8" length="10"/></edge>
<edge id=":J_1" function="internal"><lane id=":J_1_0" index="0" speed="13" length="10"/></edge>
<edge id="s" from="S" to="J"><lane id="s_0" index="0" speed="10" length="200"/></edge>
<edge id="n" from="J" to="N"><lane id="n_0" index="0" speed="10" length="200"/></edge>
<edge id="w" from="W" to="J"><lane id="w_0" index="0" speed="13" length="200"/></edge>
<edge id="e" from="J" to="E"><lane id="e_0" index="0" speed="13" length="200"/></edge>
<edge id=":J_c0" function="crossing" crossingEdges="w">
<lane id=":J_c0_0" index="0" allow="pedestrian" speed="3" length="6" width="4" shape="200,-3 200,3"/></edge>
{logic}
<junction id="J" type="{kind}" incLanes="s_0 w_0" intLanes=":J_0_0 :J_1_0 :J_c0_0">
<request index="0" response="010" foes="010" cont="0"/><request index="1" response="100" foes="101" cont="0"/>
<request index="2" response="000" foes="010" cont="0"/>
</junction>
<connection from="s" to="n" fromLane="0" toLane="0" via=":J_0_0" {s}/>
<connection from="w" to="e" fromLane="0" toLane="0" via=":J_1_0" {w}/>
<connection from=":J_0" to="n" fromLane="0" toLane="0" state="M"/>
<connection from=":J_1" to="e" fromLane="0" toLane="0" state="M"/>
</net>"""
WAYS = {"s": ("s_0", ":J_0_0", "n_0"), "w": ("w_0", ":J_1_0", "e_0")}
LENGTHS = (200.0, 10.0, 200.0)  # m
AV, HV = "cosim.av", "car"
Vehicle = tuple[str, str, float, Sequence[float]]  # type, way, m at the first step, speeds of the steps


def phases(*parts: tuple[float, str]) -> str:
    """A signal program."""
    rows = "".join(f'<phase duration="{duration}" state="{state}"/>' for duration, state in parts)
    return f'<tlLogic id="T" type="static" programID="0" offset="0">{rows}</tlLogic>'


def drive(
    folder: Path,
    vehicles: dict[str, Vehicle],
    *,
    state: str = "m",
    major: str = "M",
    program: str = "",
    collisions: Sequence[tuple[str, str, float]] = (),
    person: tuple[float, float] | None = None,
) -> Law:
    """Write the outputs of an episode in which these vehicles drive like this, and have them checked."""
    signal = ('tl="T" linkIndex="0"', 'tl="T" linkIndex="1"') if program else ("", "")
    net = folder / "net.xml"
    net.write_text(
        NET.format(
            logic=program,
            kind="traffic_light" if program else "priority",
            s=f'state="{state}" {signal[0]}',
            w=f'state="{"w" if state == "w" else major}" {signal[1]}',
        )
    )
    steps: list[list[str]] = [[] for _ in range(max(len(v[3]) for v in vehicles.values()))]
    trips, ways = [], []
    for name, (kind, way, begin, speeds) in vehicles.items():
        x, arrived = begin, -1.0
        for k, speed in enumerate(speeds):
            x += 0.1 * speed if k else 0.0
            part = int(np.searchsorted(np.cumsum(LENGTHS), x, side="right"))
            if part == len(LENGTHS):
                arrived = 0.1 * k
                break
            pos = x - sum(LENGTHS[:part])
            there = f'lane="{WAYS[way][part]}" pos="{pos:.6f}" speed="{speed:.6f}"'
            steps[k].append(f'<vehicle id="{name}" type="{kind}" {there}/>')
        trips.append(f'<tripinfo id="{name}" arrival="{arrived}"/>')
        ways.append(f'<vehicle id="{name}"><route edges="{way} {"n" if way == "s" else "e"}"/></vehicle>')
    if person:
        for found in steps:
            found.append(f'<person id="p" x="{person[0]}" y="{person[1]}"/>')
    rows = [f'<timestep time="{0.1 * k:.2f}">{"".join(found)}</timestep>' for k, found in enumerate(steps)]
    hits = [f'<collision time="{t}" collider="{a}" victim="{b}"/>' for a, b, t in collisions]
    files = {"fcd": rows, "tripinfo": trips, "vehroute": ways, "collision": hits}
    for name, lines in files.items():
        (folder / f"{name}.xml").write_text(f"<root>{''.join(lines)}</root>")
    return check(net, folder)


def steady(speed: float, seconds: float) -> list[float]:
    """A constant speed."""
    return [speed] * (round(10 * seconds) + 1)


def braking(speed: float, after: float, deceleration: float, seconds: float) -> list[float]:
    """A constant speed, then braking to a stand."""
    times = np.arange(round(10 * seconds) + 1) * 0.1
    return [float(v) for v in np.clip(speed - deceleration * np.clip(times - after, 0.0, None), 0.0, speed)]


def kinds(law: Law) -> list[str]:
    """What was found, without speeding."""
    return [v.kind for v in law.violations if v.kind != "speeding"]


GREEN_THEN_RED = phases((20.0, "GG"), (40.0, "rr"))
RED_THEN_GREEN = phases((20.0, "rr"), (40.0, "GG"))


def test_an_av_that_passes_the_stop_line_on_red_is_counted_once(tmp_path: Path) -> None:
    law = drive(tmp_path, {"a": (AV, "s", 150.0, steady(8.0, 15.0))}, program=RED_THEN_GREEN)

    assert law.red_light_violations == 1
    assert kinds(law) == ["red_light"]


def test_who_passes_on_green_or_is_no_av_is_not_counted(tmp_path: Path) -> None:
    green = drive(tmp_path, {"a": (AV, "s", 150.0, steady(8.0, 15.0))}, program=GREEN_THEN_RED)
    human = drive(tmp_path, {"a": (HV, "s", 150.0, steady(8.0, 15.0))}, program=RED_THEN_GREEN)

    assert kinds(green) == []
    assert (human.avs, kinds(human)) == (0, [])


def test_the_state_counts_at_the_step_in_which_the_bumper_passes(tmp_path: Path) -> None:
    """The front passes 200 m in the step that begins at 19.9 s, or at 20.0 s."""
    program = phases((20.0, "GG"), (40.0, "rr"))
    late = {"a": (AV, "s", 200.05 - 8.0 * 20.0, steady(8.0, 25.0))}
    early = {"a": (AV, "s", 200.05 - 8.0 * 19.9, steady(8.0, 25.0))}

    assert drive(tmp_path, late, program=program).red_light_violations == 1
    assert drive(tmp_path, early, program=program).red_light_violations == 0


@pytest.mark.parametrize(("distance", "violations"), [(30.0, 1), (16.0, 0)])
def test_yellow_is_for_those_who_can_stop_with_3_mps2(
    tmp_path: Path, distance: float, violations: int
) -> None:
    """At 10 m/s that takes 16.7 m."""
    program = phases((5.0, "GG"), (4.0, "yy"), (40.0, "rr"))
    begin = 200.0 - distance - 49 * 1.0  # so that it is `distance` from the line after the step before 5.0 s

    law = drive(tmp_path, {"a": (AV, "s", begin, steady(10.0, 12.0))}, program=program)

    assert law.red_light_violations == violations


@pytest.mark.parametrize("state", ["s", "w"])
def test_a_stop_sign_asks_for_half_a_metre_a_second_within_ten_metres(tmp_path: Path, state: str) -> None:
    stops = braking(8.0, 1.0, 2.0, 5.0) + [0.0] * 5 + steady(5.0, 10.0)
    rolls = braking(8.0, 1.0, 2.0, 4.5) + steady(5.0, 10.0)  # down to 1 m/s
    early = {"a": (AV, "s", 200.0 - 8.0 - 16.0 - 12.0, stops)}
    in_time = {"a": (AV, "s", 200.0 - 8.0 - 16.0 - 3.0, stops)}
    rolling = {"a": (AV, "s", 200.0 - 8.0 - 16.0 - 3.0, rolls)}

    found = [drive(tmp_path, case, state=state).stop_sign_violations for case in (early, in_time, rolling)]

    assert found == [1, 0, 1]


# The AV enters at 5 s and is out of the junction before 8 s; the foe comes from the west.
ENTERS = (AV, "s", 160.0, steady(8.0, 10.0))


def test_a_foe_that_has_to_brake_hard_was_not_given_way(tmp_path: Path) -> None:
    foe = (HV, "w", 120.0, braking(12.0, 5.5, 5.0, 10.0))

    assert kinds(drive(tmp_path, {"a": ENTERS, "b": foe})) == ["right_of_way"]


@pytest.mark.parametrize(
    "foe",
    [
        (HV, "w", 120.0, braking(12.0, 5.5, 2.9, 10.0)),  # comfortably
        (HV, "w", 120.0, braking(12.0, 4.0, 5.0, 10.0)),  # harder before
        (HV, "w", 20.0, braking(12.0, 5.5, 5.0, 10.0)),  # 120 m away
        (HV, "w", 120.0, braking(12.0, 8.0, 5.0, 10.0)),  # afterwards
        (HV, "w", 160.0, braking(12.0, 5.5, 5.0, 10.0)),  # has passed the junction
    ],
)
def test_a_foe_that_does_not_brake_hard_for_the_entry_was_given_way(tmp_path: Path, foe: Vehicle) -> None:
    assert kinds(drive(tmp_path, {"a": ENTERS, "b": foe})) == []


def test_a_foe_that_brakes_for_its_leader_was_given_way(tmp_path: Path) -> None:
    foe = (HV, "w", 110.0, braking(12.0, 5.5, 5.0, 10.0))
    leader = (HV, "w", 128.0, braking(12.0, 5.4, 5.0, 10.0))
    far = (HV, "w", 190.0, steady(12.0, 10.0))

    assert kinds(drive(tmp_path, {"a": ENTERS, "b": foe, "c": far})) == ["right_of_way"]
    alone = drive(tmp_path, {"a": ENTERS, "b": foe, "c": leader})
    assert [v.what.split()[0] for v in alone.violations if v.kind == "right_of_way"] == ["c"]


def test_a_foe_that_brakes_before_its_own_stop_sign_was_given_way(tmp_path: Path) -> None:
    vehicles = {"a": ENTERS, "b": (HV, "w", 120.0, braking(12.0, 5.5, 5.0, 10.0))}

    assert kinds(drive(tmp_path, vehicles, major="s")) == []


@pytest.mark.parametrize(("x", "count"), [(200.0, 0), (209.9, 0), (210.1, 1)])
def test_a_foe_that_brakes_for_persons_was_given_way(tmp_path: Path, x: float, count: int) -> None:
    near = {"a": ENTERS, "b": (HV, "w", 120.0, braking(12.0, 5.5, 5.0, 10.0))}
    far = {"a": ENTERS, "b": (HV, "w", 90.0, braking(12.0, 5.5, 5.0, 10.0))}

    assert drive(tmp_path, near, person=(x, 0.0)).right_of_way_violations == count
    assert drive(tmp_path, far, person=(x, 0.0)).right_of_way_violations == 1


def test_a_foe_with_a_red_signal_has_no_right_of_way(tmp_path: Path) -> None:
    vehicles = {"a": ENTERS, "b": (HV, "w", 120.0, braking(12.0, 5.5, 5.0, 10.0))}

    assert kinds(drive(tmp_path, vehicles, program=phases((60.0, "gr"), (30.0, "rG")))) == []
    assert kinds(drive(tmp_path, vehicles, program=phases((60.0, "gG"), (30.0, "rr")))) == ["right_of_way"]


def test_a_touched_foe_was_not_given_way_even_where_all_stop(tmp_path: Path) -> None:
    vehicles = {"a": ENTERS, "b": (HV, "w", 120.0, braking(12.0, 5.5, 5.0, 10.0))}
    touch = [("a", "b", 6.0), ("a", "b", 6.1)]

    untouched = drive(tmp_path, vehicles, state="w")
    touched = drive(tmp_path, vehicles, state="w", collisions=touch)

    assert untouched.right_of_way_violations == 0
    assert touched.right_of_way_violations == 1
    assert (touched.av_involved_collisions, touched.collisions) == (1, 1)


def test_lanes_inside_a_junction_have_limits_too(tmp_path: Path) -> None:
    law = drive(tmp_path, {"a": (AV, "s", 180.0, steady(9.5, 6.0))})

    assert law.worst_speeding_mps == pytest.approx(1.5)
    assert 9 <= law.speeding_steps <= 11  # 10 m at 9.5 m/s
    assert [v.kind for v in law.violations] == ["speeding"]


def test_who_stands_for_a_minute_without_cause_is_stuck(tmp_path: Path) -> None:
    stands = (AV, "s", 170.0, steady(0.0, 70.0))

    assert drive(tmp_path, {"a": stands}).avs_stuck == 1
    assert drive(tmp_path, {"a": (AV, "s", 170.0, steady(0.0, 59.0))}).avs_stuck == 0


def test_who_waits_for_red_or_behind_who_waits_for_it_is_not_stuck(tmp_path: Path) -> None:
    red, green = phases((90.0, "rr"), (5.0, "GG")), phases((90.0, "GG"), (5.0, "rr"))
    queue = {"a": (AV, "s", 185.0, steady(0.0, 70.0)), "b": (HV, "s", 198.0, steady(0.0, 70.0))}

    assert drive(tmp_path, queue, program=red).avs_stuck == 0
    assert drive(tmp_path, queue, program=green).avs_stuck == 0, "behind a human, who needs no reason"
    queue["b"] = (AV, *queue["b"][1:])
    assert drive(tmp_path, queue, program=green).avs_stuck == 2
    assert drive(tmp_path, queue).avs_stuck == 2, "who stands behind somebody that stands without cause"


@pytest.mark.parametrize(("y", "count"), [(4.9, 0), (5.1, 1)])
def test_who_waits_for_persons_on_a_crossing_is_not_stuck(tmp_path: Path, y: float, count: int) -> None:
    stands = (AV, "w", 199.0, [0.0] * 701)

    assert drive(tmp_path, {"a": stands}, person=(200.0, y)).avs_stuck == count
    assert drive(tmp_path, {"a": (AV, "s", 199.0, [0.0] * 701)}, person=(200.0, 0.0)).avs_stuck == 1


def test_trips_brakings_and_distance_are_counted(tmp_path: Path) -> None:
    arrives = (AV, "s", 350.0, steady(10.0, 10.0))
    brakes = (AV, "w", 0.0, braking(10.0, 2.0, 4.0, 10.0))
    law = drive(tmp_path, {"a": arrives, "b": brakes, "c": (HV, "s", 10.0, steady(5.0, 10.0))})

    assert (law.avs, law.av_trips_completed, law.trips_completed) == (2, 1, 1)
    assert law.hard_brakings_av == 1
    assert law.distance_mean_m == pytest.approx((59.0 + 32.0 + 50.0) / 3, abs=1.0)


@pytest.mark.parametrize("offset", [0, 7, -4])
def test_a_program_is_in_the_state_that_sumo_says(
    law_worlds: dict[str, Path], tmp_path: Path, offset: int
) -> None:
    """SUMO's SaveTLSStates, which stamps a step like floating-car data: with the time at its begin."""
    import sumo

    world = law_worlds["arterial"].parent
    text = (world / "net.net.xml").read_text().replace('offset="0"', f'offset="{offset}"')
    (tmp_path / "net.net.xml").write_text(text)
    (tmp_path / "states.add.xml").write_text(
        '<additional><timedEvent type="SaveTLSStates" source="a" dest="states.xml"/></additional>'
    )
    command = [str(Path(sumo.__file__).parent / "bin" / "sumo"), "-n", "net.net.xml", "-a", "states.add.xml"]
    subprocess.run(
        [*command, "--end", "100", "--step-length", "0.1", "--no-step-log", "true"],
        check=True,
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    )
    program: Program = Net(tmp_path / "net.net.xml").programs["a"]
    rows = list(ET.parse(tmp_path / "states.xml").getroot().iter("tlsState"))

    assert len(rows) >= 1000
    assert all(program.at(float(row.attrib["time"]))[0] == row.attrib["state"] for row in rows)


def test_every_link_of_every_world_has_its_row_in_the_table(law_worlds: dict[str, Path]) -> None:
    for configuration in law_worlds.values():
        net = Net(configuration.with_name("net.net.xml"))
        places = [(link.junction, link.index) for link in net.links]

        assert all(index >= 0 for _, index in places), configuration
        assert len(set(places)) == len(places), configuration
        known = [(link.signal[1], link.index) for link in net.links if link.signal is not None]
        assert all(a == b for a, b in known), configuration  # a signal of one junction counts alike


@pytest.mark.parametrize("world", ["arterial", "crossing_signals", "priority", "roundabout2"])
def test_links_give_way_to_those_of_the_right_of_way_table(law_worlds: dict[str, Path], world: str) -> None:
    net = Net(law_worlds[world].with_name("net.net.xml"))
    reader = Worker(NetReader, law_worlds[world].with_name("net.net.xml"))
    try:
        road = reader.call("road")
    finally:
        reader.close()
    name = [f"{road.lanes[link.origin].id} {road.lanes[link.target].id}" for link in road.links]
    wanted = {
        f"{link.origin} {link.target}": {
            f"{other.origin} {other.target}"
            for other in net.links
            if other.junction == link.junction and other.index in link.yields & link.meets
        }
        for link in net.links
    }

    assert {name[k]: {name[foe] for foe in link.foes} for k, link in enumerate(road.links)} == wanted
    assert any(wanted.values())


@pytest.mark.soak
def test_where_sumo_drives_nobody_passes_on_red_or_through_a_stop_sign(
    law_worlds: dict[str, Path],
) -> None:
    episodes = cases(law_worlds, ["idm"], (0.2, 1.0), range(FIRST, FIRST + 1), Preset.LAWFUL)

    rows = driven(episodes, 1, None, None)

    assert {row["world"] for row in rows} == set(NAMES)
    for row in rows:
        law, where = row["law"], (row["world"], row["penetration"], row["law"]["violations"])
        assert law["red_light_violations"] == law["stop_sign_violations"] == 0, where
        assert law["speeding_steps"] == law["collisions"] == law["avs_stuck"] == 0, where
        assert law["av_trips_completed"] > 0, where


def keep_lane(worlds: dict[str, Path], names: Sequence[str], seeds: int) -> list[Case]:
    """Episodes in which nobody guards the AVs."""
    chosen = {name: worlds[name] for name in names}
    found = cases(chosen, ["keep-lane"], (0.2, 1.0), range(FIRST, FIRST + seeds), Preset.UNGUARDED)
    return [case for case in found if case.policy == "keep-lane"]


@pytest.mark.soak
def test_on_keep_lane_the_checker_counts_what_the_figures_count(law_worlds: dict[str, Path]) -> None:
    rows = driven(keep_lane(law_worlds, NAMES, 1), 1, None, None)

    law = {
        name: sum(row["law"][name] for row in rows)
        for name in ("red_light_violations", "stop_sign_violations")
    }
    assert min(law.values()) >= 5  # there is something to count
    assert [
        (row["world"], row["seed"], row["penetration"], d) for row in rows if (d := differences(row))
    ] == []
