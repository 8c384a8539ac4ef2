"""`cosim metrics`: floating-car data become the same snapshots, and bad files one clear sentence."""

from __future__ import annotations

import gzip
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.fcd import Analysis, Roles, analyse
from cosim.fcd.vehicle_types import Size, read_sizes, size_of
from cosim.road import Lane, RoadMap
from cosim.simulation.fake import straight_road

HEAD = '<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n'


def car(name: str, x: float, speed: float, *, y: float = 1.6, angle: float = 90.0, more: str = "") -> str:
    """A vehicle heading east whose front bumper is at x."""
    return (
        f'<vehicle id="{name}" x="{x:.3f}" y="{y:.3f}" angle="{angle:.2f}" type="car" speed="{speed:.3f}" '
        f'pos="{x:.3f}" lane="road_0" slope="0.00" {more}/>'
    )


def step(time: float, *vehicles: str) -> str:
    return f'<timestep time="{time:.2f}">{"".join(vehicles)}</timestep>\n'


def following(count: int = 11, interval: float = 0.2) -> str:
    """A car at 20 m/s closes in on one at 10 m/s, bumpers 50 m apart at first."""
    return "".join(
        step(t, car("fast", 100 + 20 * t, 20.0), car("slow", 155 + 10 * t, 10.0))
        for t in (interval * k for k in range(count))
    )


@pytest.fixture
def fcd(tmp_path: Path) -> Any:
    """Writes a file of these steps."""

    def write(body: str, name: str = "fcd.xml") -> Path:
        path = tmp_path / name
        text = HEAD + body + "</fcd-export>\n"
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
        return path

    return write


def value(found: Analysis, name: str) -> Any:
    return found.figures[name].value


def test_front_bumpers_and_degrees_become_the_gap_between_two_cars(fcd: Any) -> None:
    found = analyse(fcd(following()))
    assert value(found, "min_ttc_s") == pytest.approx((50 - 20) / 10)  # 2 s later the gap is 30 m
    assert value(found, "max_drac_mps2") == pytest.approx(10**2 / (2 * 30), rel=1e-3)
    assert value(found, "min_headway_s") == pytest.approx(30 / 20, rel=1e-3)
    assert (found.frames, found.vehicles, found.watched, found.interval) == (11, 2, 2, 0.2)


def test_every_single_conflict_is_listed_once_with_its_worst_moment(fcd: Any, tmp_path: Path) -> None:
    apart = "".join(
        step(t, car("fast", 140.0, 10.0), car("slow", 400.0, 10.0)) for t in (2.2, 2.4, 2.6, 2.8, 3.0, 3.2)
    )
    again = step(3.4, car("fast", 140.0, 10.0), car("slow", 155.0, 0.0))
    path = fcd(following() + apart + again)
    first, second = analyse(path, critical=4.0).encounters
    assert (first["ego"], first["foe"]) == ("fast", "slow")
    assert (first["begin_s"], first["end_s"], first["at_s"]) == (1.2, 2.0, 2.0)
    assert first["min_ttc_s"] == pytest.approx(3.0)
    assert first["max_drac_mps2"] == pytest.approx(10**2 / (2 * 30), rel=1e-3)
    assert (first["ego_speed_mps"], first["foe_speed_mps"]) == (20.0, 10.0)
    assert (second["begin_s"], second["min_ttc_s"]) == (3.4, pytest.approx(1.0))
    assert first["type"] == second["type"] == "following"
    assert math.isnan(first["pet_s"]), "who follows has no PET"
    assert analyse(path, critical=0.5).encounters == ()
    out = tmp_path / "deep" / "conflicts.csv"
    assert main(["metrics", str(path), "--conflicts", str(out), "--json"]) == 0
    head, only = out.read_text().splitlines()
    assert head.startswith("begin_s,end_s,ego,foe,min_ttc_s")
    assert only.startswith("3.4,3.4,fast,slow,1,3.4")
    assert main(["metrics", str(path), "--conflicts", str(out), "--ttc", "0.1"]) == 0
    assert out.read_text().splitlines() == [head]
    assert main(["metrics", str(path), "--conflicts", str(tmp_path)]) == 2


def meeting(angle: float, lane: str, *, first: float, last: float = 14.0) -> str:
    """At 10 m/s: `a` goes east along y = 0 through the origin at 10 s, `b` passes it at `first` s on a course
    of `angle` degrees and ends on `lane`."""

    def at(name: str, reached: float, course: float, now: float, where: str) -> str:
        along = 10.0 * (now - reached)
        x, y = along * math.sin(math.radians(course)), along * math.cos(math.radians(course))
        return car(name, x, 10.0, y=y, angle=course).replace("road_0", where)

    times = (8.0 + 0.2 * k for k in range(round((last - 8.0) / 0.2) + 1))
    return "".join(step(t, at("a", 10.0, 90.0, t, "road_0"), at("b", first, angle, t, lane)) for t in times)


@pytest.mark.parametrize(
    ("angle", "lane", "first", "kind"),
    [
        (0.0, "side_0", 10.6, "crossing"),
        (45.0, "side_0", 10.3, "crossing"),
        (270.0, "road_1", 10.0, "oncoming"),
        (88.0, "road_1", 10.05, "lane change"),
        (90.0, "road_0", 10.3, "following"),
    ],
)
def test_a_conflict_has_its_type(fcd: Any, angle: float, lane: str, first: float, kind: str) -> None:
    (found,) = analyse(fcd(meeting(angle, lane, first=first)), critical=1.5).encounters
    assert found["type"] == kind


def test_two_ways_into_one_lane_merge(fcd: Any) -> None:
    shape = np.array([[0.0, 0.0], [1.0, 0.0]])
    lanes = [Lane(name, "", 0, shape, 1e6, 3.2, 20.0, successors=(2,)) for name in ("road_0", "side_0")]
    road = RoadMap((*lanes, Lane("out_0", "", 0, shape, 1e6, 3.2, 20.0)))
    (found,) = analyse(fcd(meeting(60.0, "side_0", first=10.3)), road=road, critical=1.5).encounters
    assert found["type"] == "merging"


def test_a_crossing_conflict_has_the_time_between_both_passages(fcd: Any) -> None:
    """On a collision course at first; then `b` is late, and reaches the path 0.32 s after `a` has left it."""
    slowed = meeting(0.0, "side_0", first=10.5, last=9.0)
    text = slowed + "".join(
        step(t, car("a", 10 * (t - 10), 10.0), car("b", 0.0, 10.0, y=10 * (t - 11.0), angle=0.0))
        for t in (9.2 + 0.2 * k for k in range(40))
    )
    (found,) = analyse(fcd(text.replace('y="1.600"', 'y="0.000"')), critical=1.5).encounters
    assert found["pet_s"] == pytest.approx(1.0 - (5.0 + 1.8) / 10.0, abs=0.05)
    assert (found["ego_speed_mps"], found["foe_speed_mps"]) == (10.0, 10.0)


def test_a_lane_change_that_takes_no_time_makes_no_conflict_at_that_moment(fcd: Any) -> None:
    def frame(k: int) -> str:
        there = k == 5  # for one frame, so that nothing else of it can be seen
        jumper = car("b", 107.0 + 4.0 * k, 10.0, y=1.6 if there else 4.8)
        jumper = jumper if there else jumper.replace("road_0", "road_1")
        return step(0.2 * k, car("a", 100.0 + 4.0 * k, 20.0), jumper)

    found = analyse(fcd("".join(map(frame, range(6)))), critical=1.5)
    assert value(found, "min_ttc_s") is None
    assert value(found, "max_drac_mps2") == 0.0
    assert [(row["ego"], row["foe"], row["lane_jump"]) for row in found.encounters] == [("a", "b", True)]
    assert any(note.startswith("1 lane changes that took no time") for note in found.notes)
    usual = following(11).replace("slow", "b").replace("fast", "a")
    assert [row["lane_jump"] for row in analyse(fcd(usual), critical=10.0).encounters] == [False]
    slowly = "".join(
        step(0.2 * k, car("a", 100.0 + 4.0 * k, 20.0), car("b", 140.0, 10.0, y=4.8 - 0.32 * k))
        for k in range(9)
    )
    assert not any("took no time" in note for note in analyse(fcd(slowly)).notes)


@pytest.mark.parametrize("interval", [0.2, 1.0])
def test_what_follows_a_jump_in_two_seconds_is_no_headline(fcd: Any, interval: float) -> None:
    """A car at 10 m/s is put 20 m in front of one at 20 m/s: 1.3 s and less to the collision."""

    def frame(t: float) -> str:
        jumper = car("b", 128.0 + 10.0 * t, 10.0, y=1.6 if t > 0.5 else 4.8)
        jumper = jumper if t > 0.5 else jumper.replace("road_0", "road_1")
        return step(t, car("a", 100.0 + 20.0 * t, 20.0), jumper)

    found = analyse(fcd("".join(frame(interval * k) for k in range(round(2.0 / interval) + 1))), critical=1.5)
    assert value(found, "min_ttc_s") is None
    assert [row["lane_jump"] for row in found.encounters] == [True]
    assert any(note.startswith("1 lane changes that took no time") for note in found.notes)


def test_heading_north_is_no_other_thing_than_heading_east(fcd: Any) -> None:
    turned = re.sub(r'x="([\d.]+)" y="([\d.]+)" angle="90.00"', r'x="\2" y="\1" angle="0.00"', following())
    assert value(analyse(fcd(turned)), "min_ttc_s") == pytest.approx(3.0)


def test_the_types_file_gives_sizes_and_the_rest_is_said(fcd: Any) -> None:
    found = analyse(fcd(following()), sizes={"car": Size(15.0, 2.0)})
    assert value(found, "min_ttc_s") == pytest.approx(2.0)  # 10 m less between them
    assert not any("taken as" in note for note in found.notes)
    assert any("every vehicle is taken as 5 x 1.8 m" in note for note in analyse(fcd(following())).notes)
    other = analyse(fcd(following()), sizes={"bus": Size(12.0, 2.5)})
    assert any("taken as 5 x 1.8 m: car" in note for note in other.notes)


def test_a_type_of_one_vehicle_has_the_size_of_its_origin() -> None:
    sizes = {"hv": Size(4.0, 1.7), "odd@name": Size(9.0, 2.0)}
    assert size_of("hv@veh.7", sizes) == size_of("hv/moderate", sizes) == size_of("hv", sizes) == sizes["hv"]
    assert size_of("odd@name", sizes) == sizes["odd@name"]
    assert size_of("lorry", sizes) is None


def test_sizes_are_read_with_sumo_s_defaults_of_the_class(tmp_path: Path) -> None:
    path = tmp_path / "types.add.xml"
    path.write_text(
        '<additional><vType id="a" length="4"/><vType id="b" vClass="bus" width="3"/></additional>'
    )
    assert read_sizes([path]) == {"a": Size(4.0, 1.8), "b": Size(12.0, 3.0)}
    path.write_text('<routes><vType id="a" length="-4"/></routes>')
    with pytest.raises(
        BadInput, match=r"length='-4': must be a positive number of metres \(vType 'a', line 1\)"
    ):
        read_sizes([path])


def test_only_the_chosen_vehicles_are_watched(fcd: Any) -> None:
    path = fcd(following().replace('id="fast" ', 'id="fast" ').replace("car", "av", 1))
    nobody = analyse(path, roles=Roles(av_type="lorry"))
    assert nobody.watched == 0
    assert value(nobody, "min_headway_s") is None
    assert any("nothing to count" in note for note in nobody.notes)
    ours = fcd(re.sub('(id="fast".*?type=")car', r"\1cosim.av.car/lawful@fast", following()))
    assert analyse(ours, roles=Roles(av_type="cosim.")).watched == 1
    one = analyse(path, roles=Roles(av_ids=re.compile("fast")))
    assert one.watched == 1
    assert value(one, "min_headway_s") == pytest.approx(1.5, rel=1e-3)
    slow = analyse(path, roles=Roles(mission=re.compile("slow")))
    assert value(slow, "min_headway_s") is None  # headways are those of AVs
    assert value(slow, "min_ttc_s") == pytest.approx(3.0)


def test_another_net_is_refused_by_the_lane_that_it_lacks(fcd: Any) -> None:
    path = fcd(following().replace('lane="', 'lane="elsewhere_'))
    with pytest.raises(BadInput, match=r"vehicle\.lane='elsewhere_.*': no such lane in --net"):
        analyse(path, road=straight_road(2, 2000.0, 25.0))


def test_fine_steps_are_thinned_to_the_frames_of_an_episode(fcd: Any) -> None:
    fine = analyse(fcd(following(21, 0.1)))
    assert (fine.frames, fine.interval) == (11, 0.2)
    assert any("thinned" in note for note in fine.notes)
    assert analyse(fcd(following(21, 0.1)), frame=0.1).frames == 21
    assert analyse(fcd(following(5, 0.5))).interval == 0.5
    with pytest.raises(
        BadInput, match=r"--frame='0.25': must be a whole number of the file's steps of 0.1 s"
    ):
        analyse(fcd(following(21, 0.1)), frame=0.25)


def test_steps_without_vehicles_may_be_left_out(fcd: Any) -> None:
    hard = [step(0, car("a", 100, 20)), step(0.2, car("a", 104, 20)), step(5.0, car("a", 200, 1))]
    found = analyse(fcd("".join(hard)))
    assert found.frames == 26
    assert value(found, "hard_brakings") == 0  # nobody saw how it came to 1 m/s


def test_a_window_of_time_is_all_that_counts(fcd: Any) -> None:
    found = analyse(fcd(following()), begin=0.4, end=1.0)
    assert (found.begin, found.end, found.frames) == (0.4, 1.0, 4)
    assert value(found, "min_ttc_s") == pytest.approx(4.0)


def test_packed_files_and_whole_tracks_of_streaming_give_the_same(fcd: Any) -> None:
    plain, packed = analyse(fcd(following())), analyse(fcd(following(), "fcd.xml.gz"))
    assert plain.figures == packed.figures


def test_with_a_net_a_headway_needs_its_lanes(fcd: Any) -> None:
    path = fcd(following())
    assert value(analyse(path, road=straight_road(2, 2000.0, 25.0)), "min_headway_s") == pytest.approx(
        1.5, rel=1e-3
    )
    assert not any("--net" in note for note in analyse(path, road=straight_road(1, 2000.0, 25.0)).notes)


BAD = {
    "truncated": (following()[:-40], r"not well-formed|truncated"),
    "no angle": (
        following().replace('angle="90.00" ', "", 1),
        r"vehicle.angle: vehicle 'fast' has none \(line 2\)",
    ),
    "NaN": (
        following().replace('speed="20.000"', 'speed="nan"', 1),
        r"vehicle.speed='nan': not a finite number",
    ),
    "no id": (following().replace('id="fast" ', "", 1), r"vehicle.id \(line 2\): is missing"),
    "twice": (step(0, car("a", 1, 1), car("a", 9, 1)), r"vehicle.id='a': appears twice in the step at 0 s"),
    "back in time": (step(1, car("a", 1, 1)) + step(0, car("a", 1, 1)), r"times must increase"),
    "uneven": (
        step(0, car("a", 1, 1)) + step(0.2, car("a", 1, 1)) + step(0.5, car("a", 1, 1)),
        r"steps are not evenly spaced: 0.2 s at first, then 0.3 s",
    ),
    "no time": (step(0, car("a", 1, 1)).replace('time="0.00"', ""), r"is not a time"),
    "nobody": (step(0) + step(0.2), r"holds no vehicle"),
    "outside": (car("a", 1, 1), r"a vehicle outside of a timestep"),
    "degrees": (
        "".join(step(0.2 * k, car("a", 8.68 + 1e-5 * k, 20, y=50.1)) for k in range(80)),
        r"positions do not fit the speeds: degrees",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_one_clear_sentence(fcd: Any, kind: str) -> None:
    body, words = BAD[kind]
    path = fcd(body)
    with pytest.raises(BadInput, match=words) as caught:
        analyse(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_another_file_of_sumo_is_not_fcd(tmp_path: Path) -> None:
    path = tmp_path / "tripinfo.xml"
    path.write_text("<tripinfos></tripinfos>")
    with pytest.raises(BadInput, match="<fcd-export> is needed"):
        analyse(path)


def test_the_command_line_prints_units_or_one_document(
    fcd: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = fcd(following())
    assert main(["metrics", str(path)]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"min_ttc_s +3 s\n", shown)
    assert "note: every vehicle is watched" in shown
    assert main(["metrics", str(path), "--json", "--begin", "1"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["min_ttc_s"] == pytest.approx(3.0)
    assert document["units"]["max_drac_mps2"] == "m/s2"
    assert document["begin_s"] == 1.0
    assert main(["metrics", str(tmp_path / "none.xml")]) == 2
    assert main(["metrics", str(path), "--av-ids", "("]) == 2
    assert "--av-ids='(': not a regular expression" in capsys.readouterr().err
