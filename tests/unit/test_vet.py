"""Bad input is refused before SUMO sees it, with file, field and value; good input passes."""

import gzip
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.errors import BadInput
from cosim.files import xml_input
from cosim.scenario import Fleet, load
from cosim.scenario import vet as vetting
from cosim.scenario.vet import VetReport, vet
from tests.roads import two_lanes

NET = two_lanes(500, "25")
ROUTES = """<routes>
  <vType id="car" carFollowModel="IDM" length="5" tau="1.2" speedFactor="normc(1,0.1,0.2,2)" lcSpeedGain="3"/>
  <route id="r" edges="ab bc"/>
  <vehicle id="v0" type="car" route="r" depart="0" departPos="-20" departSpeed="max" departLane="best"/>
  <flow id="f" type="car" route="r" begin="0:00:01" end="10" period="exp(0.5)"/>
  <trip id="t0" from="ab" to="bc" depart="3"><stop lane="bc_1" endPos="-5" duration="3"/></trip>
  <vehicle id="v1" depart="triggered"><route edges="ab bc"/></vehicle>
</routes>"""
ADDITIONAL = """<additional>
  <inductionLoop id="x" lane="ab_0" pos="10" period="60" file="loop.xml"/>
  <vType id="truck" length="12"/>
</additional>"""

Case = Callable[..., VetReport]


@pytest.fixture
def case(tmp_path: Path) -> Case:
    """Write the three files (or the bytes given instead), load the scenario and vet it."""

    def run(
        net: str | bytes = NET,
        routes: str | bytes = ROUTES,
        additional: str | bytes = ADDITIONAL,
        fleet: Fleet | None = None,
    ) -> VetReport:
        for name, text in (("n.net.xml", net), ("r.rou.xml", routes), ("a.add.xml", additional)):
            (tmp_path / name).write_bytes(text.encode() if isinstance(text, str) else text)
        config = tmp_path / "c.sumocfg"
        config.write_text(
            '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
            '<additional-files value="a.add.xml"/></configuration>'
        )
        return vet(load(str(config), fleet=fleet))

    return run


def refused(run: Callable[[], object], file: str, field: str, value: object, word: str) -> None:
    """`run` raises BadInput that names all three, in one line."""
    with pytest.raises(BadInput) as caught:
        run()
    error = caught.value
    assert Path(error.file or "").name == file
    assert error.field == field
    assert str(error.value) == str(value)
    assert word in str(error)
    assert "\n" not in str(error)


def test_good_files_pass_and_are_counted(case: Case) -> None:
    report = case()
    assert (report.edges, report.vehicles, report.flows, report.warnings) == (2, 3, 1, ())
    assert report.outputs == ("loop.xml",)


def test_gzip_files_pass_whatever_their_names_say(case: Case) -> None:
    packed = case(net=gzip.compress(NET.encode()), routes=gzip.compress(ROUTES.encode()))
    assert packed.vehicles == 3


@pytest.mark.parametrize(
    ("old", "new", "field", "value", "word"),
    [
        (' version="1.20"', "", "net.version", "", "missing"),
        ('version="1.20"', 'version="99.0"', "net.version", "99.0", "version"),
        ('version="1.20"', 'version="new"', "net.version", "new", "version"),
        ("</net>", "", "line", 26, "truncated"),
        ("<net ", "<routes ", "root", "routes", "wrong root"),
        (
            'speed="25" length="500" shape="0,-4.8',
            'speed="-25" length="500" shape="0,-4.8',
            "lane.speed",
            "-25",
            "",
        ),
        ('length="500" shape="0,-4.8', 'length="nan" shape="0,-4.8', "lane.length", "nan", "finite"),
        ('length="500" shape="0,-4.8', 'length="0" shape="0,-4.8', "lane.length", "0", "more than 0"),
        ('length="500" shape="0,-4.8', 'length="" shape="0,-4.8', "lane.length", "", "not a number"),
        ('shape="0,-4.8 500,-4.8"', 'shape="0,-4.8 inf,-4.8"', "lane.shape", "0,-4.8 inf,-4.8", "finite"),
        ('shape="0,-4.8 500,-4.8"', 'shape="0,-4.8"', "lane.shape", "0,-4.8", "two points"),
        ('id="ab_1" index="1"', 'id="ab_2" index="2"', "lane.index", "2", "1 is due"),
        ('id="ab_1" index="1"', 'id="zz_1" index="1"', "lane.id", "zz_1", "ab_1"),
        ('<edge id="bc"', '<edge id="ab"', "edge.id", "ab", "twice"),
        (
            'to="bc" fromLane="1" toLane="1" via',
            'to="bx" fromLane="1" toLane="1" via',
            "connection.to",
            "bx",
            "edge",
        ),
        (
            'fromLane="1" toLane="1" via',
            'fromLane="1" toLane="4" via',
            "connection.toLane",
            "4",
            "no such lane",
        ),
        ('via=":b_0_1"', 'via=":b_9_1"', "connection.via", ":b_9_1", "no such lane"),
        (
            'intLanes=":b_0_0 :b_0_1"',
            'intLanes=":b_0_0 :b_7_1"',
            "junction.intLanes",
            ":b_7_1",
            "no such lane",
        ),
        (
            '<connection from="ab" to="bc" fromLane="1" toLane="1" via=":b_0_1" dir="s" state="M"/>',
            "",
            "junction.id",
            "b",
            "2 right-of-way rows for 1 connections",
        ),
    ],
)
def test_a_bad_net_is_refused(case: Case, old: str, new: str, field: str, value: object, word: str) -> None:
    assert old in NET
    refused(lambda: case(net=NET.replace(old, new, 1)), "n.net.xml", field, value, word)


@pytest.mark.parametrize(
    ("old", "new", "field", "value", "word"),
    [
        ('edges="ab bc"', 'edges="ab bd"', "route.edges", "bd", "did you mean 'bc'?"),
        ('to="bc" depart', 'to="xy" depart', "trip.to", "xy", "no such edge in n.net.xml"),
        ('lane="bc_1"', 'lane="bc_2"', "stop.lane", "bc_2", "no such lane"),
        ('type="car" route="r" depart', 'type="cra" route="r" depart', "vehicle.type", "cra", "'car'"),
        ('route="r" begin', 'route="q" begin', "flow.route", "q", "no such route"),
        ('id="t0"', 'id="v0"', "trip.id", "v0", "twice, first in line 4"),
        ('length="5"', 'length="-5"', "vType.length", "-5", "more than 0"),
        ('length="5"', 'length="NaN"', "vType.length", "NaN", "finite"),
        ('tau="1.2"', 'tau="inf"', "vType.tau", "inf", "finite"),
        ('tau="1.2"', 'accel="-1"', "vType.accel", "-1", "more than 0"),
        ('tau="1.2"', 'minGap="-0.1"', "vType.minGap", "-0.1", "at least 0"),
        ('tau="1.2"', 'sigma="1.5"', "vType.sigma", "1.5", "at most 1"),
        ("normc(1,0.1,0.2,2)", "normc(1,nan,0.2,2)", "vType.speedFactor", "normc(1,nan,0.2,2)", "finite"),
        ('lcSpeedGain="3"', 'lcSpeedGian="3"', "vType.lcSpeedGian", "3", "did you mean 'lcSpeedGain'?"),
        ('lcSpeedGain="3"', 'lcfoo="3"', "vType.lcfoo", "3", "unknown lane-change attribute"),
        ('lcSpeedGain="3"', 'lcAssertive="-3"', "vType.lcAssertive", "-3", "at least 0"),
        ('lcSpeedGain="3"', 'jmTimegapMinr="3"', "vType.jmTimegapMinr", "3", "'jmTimegapMinor'"),
        ('depart="3"', 'depart="-3"', "trip.depart", "-3", "at least 0"),
        ('depart="3"', 'depart="nan"', "trip.depart", "nan", "finite"),
        ('departPos="-20"', 'departPos="nan"', "vehicle.departPos", "nan", "finite"),
        ('departSpeed="max"', 'departSpeed="-1"', "vehicle.departSpeed", "-1", "at least 0"),
        ('departLane="best"', 'departLane="-1"', "vehicle.departLane", "-1", "at least 0"),
        ('end="10"', 'end="-10"', "flow.end", "-10", "at least 0"),
        ('period="exp(0.5)"', 'vehsPerHour="-9"', "flow.vehsPerHour", "-9", "at least 0"),
        ('period="exp(0.5)"', 'number="2000000"', "flow.number", "2000000", "at most"),
        ("</routes>", '<include href="gone.xml"/></routes>', "include.href", "gone.xml", "no such file"),
        ("</routes>", '<include href="r.rou.xml"/></routes>', "include.href", None, "never end"),
        ("<routes>", "<net>", "root", "net", "<routes>"),
    ],
)
def test_bad_demand_is_refused(
    case: Case, tmp_path: Path, old: str, new: str, field: str, value: object, word: str
) -> None:
    text = ROUTES.replace(old, new, 1)
    assert text != ROUTES
    if old == "<routes>":
        text = text.replace("</routes>", "</net>")
    wanted = str(tmp_path / "r.rou.xml") if value is None else value
    refused(lambda: case(routes=text), "r.rou.xml", field, wanted, word)


@pytest.mark.parametrize(
    ("text", "field", "value", "word"),
    [
        ("<net/>", "root", "net", "wrong root"),
        (
            '<additional><e1Detector id="d" lane="zz_0"/></additional>',
            "e1Detector.lane",
            "zz_0",
            "no such lane",
        ),
        ('<additional><vType id="t" width="nan"/></additional>', "vType.width", "nan", "finite"),
        (
            '<a><vType id="t"><carFollowing-IDM tau="-1"/></vType></a>',
            "carFollowing-IDM.tau",
            "-1",
            "more than",
        ),
    ],
)
def test_a_bad_additional_file_is_refused(case: Case, text: str, field: str, value: str, word: str) -> None:
    refused(lambda: case(additional=text), "a.add.xml", field, value, word)


@pytest.mark.parametrize(
    ("content", "field", "value", "word"),
    [
        (b"", "size", 0, "empty"),
        (b"not xml at all", "line", 1, "not well-formed"),
        (b"<routes><vehicle id='a'</routes>", "line", 1, "not well-formed"),
        (b"<routes>\n<vehicle id='\xe4'/></routes>", "byte", "0xe4", "not UTF-8 (line 2"),
        (b"<?xml version='1.0' encoding='windows-1252'?><routes/>", "encoding", "windows-1252", "not UTF-8"),
        ("<routes/>".encode("utf-16"), "encoding", "UTF-16", "not UTF-8"),
        (b"<!DOCTYPE r [<!ENTITY a 'ha'>]><routes>&a;</routes>", "ENTITY", "a", "entities"),
        (b"<!DOCTYPE r [<!ENTITY % a SYSTEM 'file:///etc/passwd'>]><routes/>", "ENTITY", "a", "entities"),
        (
            b"<!DOCTYPE r SYSTEM 'http://example.org/x.dtd'><routes/>",
            "DOCTYPE",
            "http://example.org/x.dtd",
            "ext",
        ),
        (gzip.compress(ROUTES.encode())[:-30], "gzip byte", 0, "broken gzip"),
        (b"\x1f\x8b" + b"garbage" * 9, "gzip byte", 0, "broken gzip"),
        (b"<routes>" + b"<param>" * 100_000, "element", "param", "deeper than 64"),
        (b"<routes>" + b"<param key='a'/>" * 3, "line", 1, "inside <routes>"),
    ],
)
def test_malformed_bytes_are_refused(
    case: Case, content: bytes, field: str, value: object, word: str
) -> None:
    refused(lambda: case(routes=content), "r.rou.xml", field, value, word)


def test_a_billion_laughs_are_not_laughed(case: Case) -> None:
    levels = "".join(f"<!ENTITY l{i} '{f'&l{i - 1};' * 10}'>" for i in range(1, 10))
    bomb = f"<!DOCTYPE r [<!ENTITY l0 'ha'>{levels}]><routes>&l9;</routes>"
    refused(lambda: case(routes=bomb), "r.rou.xml", "ENTITY", "l0", "entities")


def test_a_gzip_bomb_stops_at_the_cap(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xml_input, "MAX_UNPACKED", 1 << 20)
    bomb = gzip.compress(b"<routes>" + b" " * (4 << 20) + b"</routes>")
    with pytest.raises(BadInput, match="unpacks to more than 1 MiB"):
        case(routes=bomb)


def test_one_endless_tag_is_refused(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xml_input, "MAX_TOKEN", 1 << 20)
    with pytest.raises(BadInput, match="longer than 1 MiB"):
        case(routes=b"<routes><!-- " + b"a" * (3 << 20))


def test_a_fifo_is_refused_instead_of_waited_for(case: Case, tmp_path: Path) -> None:
    case()
    (tmp_path / "a.add.xml").unlink()
    os.mkfifo(tmp_path / "a.add.xml")
    with pytest.raises(BadInput, match="regular file"):
        vet(load(str(tmp_path / "c.sumocfg")))


def test_the_av_type_must_be_in_the_demand(case: Case) -> None:
    assert case(fleet=Fleet(type="car")).vehicles == 3
    assert case(fleet=Fleet(type="truck")).vehicles == 3  # from the additional file
    refused(lambda: case(fleet=Fleet(type="cra")), "c.sumocfg", "--av-type", "cra", "'car'")


def test_unsorted_departures_are_a_warning_because_sumo_drops_them(case: Case) -> None:
    late = '<vehicle id="late" route="r" depart="50"/><vehicle id="early" route="r" depart="20"/></routes>'
    (warning,) = case(routes=ROUTES.replace("</routes>", late)).warnings
    assert "drops 1 of them (early)" in warning
    loaded_whole = ADDITIONAL.replace("</additional>", late.replace("</routes>", "</additional>"))
    assert case(additional=loaded_whole).warnings == ()


@pytest.mark.parametrize("begin", ['begin="5"', ""])
def test_a_flow_that_begins_before_the_element_above_it_is_a_warning_too(case: Case, begin: str) -> None:
    """SUMO 1.28 drops it without a word; a flow that names no begin begins at 0."""
    late = (
        f'<vehicle id="late" route="r" depart="50"/><flow id="lost" route="r" {begin} end="90" number="2"/>'
    )
    (warning,) = case(routes=ROUTES.replace("</routes>", f"{late}</routes>")).warnings
    assert "drops 1 of them (lost)" in warning


@pytest.mark.parametrize("first", ["person", "vehicle"])
def test_persons_and_vehicles_are_dropped_behind_one_another_too(case: Case, first: str) -> None:
    each = {"person": '<walk from="ab" to="bc"/>', "vehicle": '<route edges="ab bc"/>'}
    second = next(tag for tag in each if tag != first)
    late = f'<{first} id="late" depart="50">{each[first]}</{first}>'
    late += f'<{second} id="early" depart="20">{each[second]}</{second}>'
    (warning,) = case(routes=ROUTES.replace("</routes>", f"{late}</routes>")).warnings
    assert "drops 1 of them (early)" in warning


def test_a_route_without_a_connection_is_a_warning(case: Case) -> None:
    (warning,) = case(routes=ROUTES.replace('edges="ab bc"', 'edges="bc ab"', 1)).warnings
    assert "no connection from 'bc' to 'ab'" in warning


def test_attributes_that_do_nothing_are_warnings(case: Case) -> None:
    text = ROUTES.replace('tau="1.2"', 'tau="1.2" minGab="2" lcSublane="1"')
    first, second = case(routes=text).warnings
    assert "'minGab', did you mean 'minGap'?" in first
    assert "lcSublane only work with SL2015" in second


def test_the_same_vehicle_in_two_files_is_refused(case: Case) -> None:
    twice = '<additional><vehicle id="v0" route="r" depart="9"/></additional>'
    refused(lambda: case(additional=twice), "r.rou.xml", "vehicle.id", "v0", "is also in")


def test_an_include_is_vetted_too(case: Case, tmp_path: Path) -> None:
    (tmp_path / "types.xml").write_text('<routes><vType id="bus" length="-1"/></routes>')
    text = ROUTES.replace("<routes>", '<routes><include href="types.xml"/>')
    refused(lambda: case(routes=text), "types.xml", "vType.length", "-1", "more than 0")


def test_a_file_is_read_again_only_when_it_has_changed(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[Path] = []
    whole = vetting.read_net

    def counted(path: Path, progress: xml_input.Progress | None = None) -> object:
        reads.append(path)
        return whole(path, progress)

    monkeypatch.setattr(vetting, "read_net", counted)
    vetting._net.cache_clear()
    case()
    scenario = load(str(reads[0].parent / "c.sumocfg"))
    vet(scenario)
    vet(scenario)
    assert len(reads) == 1
    reads[0].write_text(NET.replace('speed="25"', 'speed="-2.5"'))
    with pytest.raises(BadInput, match=r"lane\.speed"):
        vet(scenario)
    assert len(reads) == 2


FLOW = '<flow id="f" route="r" begin="1" end="10" number="3"/>'


def test_a_vehicle_and_a_flow_may_share_an_id_as_in_sumo(case: Case) -> None:
    routes = ROUTES.replace('id="v0"', 'id="f"')
    report = case(routes=routes)
    assert (report.vehicles, report.flows, report.warnings) == (3, 1, ())
    other = '<additional><vehicle id="f" route="r" depart="9"/></additional>'
    assert case(additional=other).vehicles == 4


def test_two_flows_of_one_id_are_refused_in_one_file_and_in_two(case: Case) -> None:
    twice = ROUTES.replace("</routes>", f"{FLOW}</routes>")
    refused(lambda: case(routes=twice), "r.rou.xml", "flow.id", "f", "twice, first in line 5")
    other = f"<additional>{FLOW}</additional>"
    refused(lambda: case(additional=other), "r.rou.xml", "flow.id", "f", "is also in")


@pytest.mark.parametrize(("name", "warnings"), [("f.0", 1), ("f.2", 1), ("f.3", 0), ("f.x", 0), ("g.0", 0)])
def test_a_vehicle_named_like_one_of_a_flow_is_a_warning(case: Case, name: str, warnings: int) -> None:
    text = f'<routes><route id="r" edges="ab bc"/><vehicle id="{name}" route="r" depart="0"/>{FLOW}</routes>'
    found = case(routes=text).warnings
    assert len(found) == warnings
    assert all(f"'{name}' is the name of a vehicle of the flow 'f' too" in warning for warning in found)


@pytest.mark.parametrize("speed", ["-1", "0", "nan"])
def test_a_lane_speed_that_is_none_is_refused(case: Case, speed: str) -> None:
    text = NET.replace('id="bc_1" index="1" speed="25"', f'id="bc_1" index="1" speed="{speed}"')
    refused(lambda: case(net=text), "n.net.xml", "lane.speed", speed, "must be")


def test_latin_1_is_read_as_sumo_reads_it(case: Case) -> None:
    text = "<?xml version='1.0' encoding='iso-8859-1'?>" + ROUTES.replace('id="t0"', 'id="t\xe4"')
    assert case(routes=text.encode("latin-1")).vehicles == 3


def test_any_root_that_is_no_other_kind_of_file_passes_as_in_sumo(case: Case) -> None:
    demand = ROUTES.replace("<routes>", "<demand>").replace("</routes>", "</demand>")
    assert case(routes=demand).vehicles == 3
    refused(lambda: case(routes="<net/>"), "r.rou.xml", "root", "net", "<routes> is needed")


# ---- signals ----

LOGIC = """<tlLogic id="b" type="static" programID="0" offset="0">
    <phase duration="30" state="Gr"/>
    <phase duration="3" state="yr"/>
    <phase duration="30" state="rG"/>
  </tlLogic>
  """


def lit(logic: str = LOGIC) -> str:
    """The net with signals at its junction."""
    text = NET.replace('id="b" type="priority"', 'id="b" type="traffic_light"')
    for lane in "01":
        via = f'via=":b_0_{lane}"'
        text = text.replace(via, f'{via} tl="b" linkIndex="{lane}"')
    return text.replace('<junction id="a"', f'{logic}<junction id="a"')


def test_sound_signals_pass(case: Case) -> None:
    assert case(net=lit()).warnings == ()


def test_a_program_that_switches_a_signal_off_needs_no_phase(case: Case) -> None:
    assert case(net=lit(LOGIC + '<tlLogic id="b" type="static" programID="off"/>')).warnings == ()


@pytest.mark.parametrize(
    ("old", "new", "field", "value", "word"),
    [
        (LOGIC, "", "connection.tl", "b", "no such tlLogic"),
        ('state="yr"', 'state="yrr"', "phase.state", "yrr", "has 3 signals, the phases before it have 2"),
        ('state="Gr"', 'state="Xr"', "phase.state", "Xr", "'X' is no state of a signal"),
        ('state="Gr"', 'state=""', "phase.state", "", "missing"),
        ('duration="3" ', 'duration="0" ', "phase.duration", "0", "more than 0"),
        ('duration="3" ', "", "phase.duration", "", "missing"),
        ('duration="3" ', 'duration="-3" ', "phase.duration", "-3", "at least 0"),
        (LOGIC, '<tlLogic id="b" programID="0"/>', "tlLogic.id", "b", "no phase"),
        (LOGIC, LOGIC + LOGIC, "tlLogic.programID", "0", "twice"),
        ('tl="b" linkIndex="1"', 'tl="b" linkIndex="2"', "tlLogic.programID", "0", "connections need 3"),
        ('tl="b" linkIndex="1"', 'tl="b" linkIndex="-1"', "connection.linkIndex", "-1", "at least 0"),
        ('tl="b" linkIndex="1"', 'tl="b"', "connection.linkIndex", "", "missing"),
    ],
)
def test_signals_that_are_missing_or_malformed_are_refused(
    case: Case, old: str, new: str, field: str, value: str, word: str
) -> None:
    text = lit()
    assert old in text
    refused(lambda: case(net=text.replace(old, new, 1)), "n.net.xml", field, value, word)


def test_a_program_of_an_additional_file_must_fit_the_net(case: Case) -> None:
    short = LOGIC.replace("Gr", "G").replace("yr", "y").replace("rG", "r").replace('"0" off', '"own" off')
    text = f"<additional>{short}</additional>"
    refused(lambda: case(net=lit(), additional=text), "a.add.xml", "tlLogic.programID", "own", "need 2")


def test_a_junction_that_is_called_signalled_and_has_no_signal_is_a_warning(case: Case) -> None:
    text = NET.replace('id="b" type="priority"', 'id="b" type="traffic_light"')
    (warning,) = case(net=text).warnings
    assert "no signal at b of type traffic_light" in warning


@pytest.mark.parametrize("kind", ["rail_signal", "rail_crossing"])
def test_rail_signals_have_programs_of_sumos_own(case: Case, kind: str) -> None:
    text = (
        lit("").replace('type="traffic_light"', f'type="{kind}"').replace('linkIndex="1"', 'linkIndex="-1"')
    )
    assert case(net=text).warnings == ()


# ---- hands ----


def test_a_net_whose_lanes_lie_on_the_other_side_than_it_says_is_refused(case: Case) -> None:
    text = NET.replace('version="1.20"', 'version="1.20" lefthand="true"')
    word = "the net is left-hand and 2 of 2 roads lie as in right-hand traffic (ab, bc)"
    refused(lambda: case(net=text), "n.net.xml", "net.lefthand", "true", word)


def test_a_left_hand_net_is_a_net(case: Case) -> None:
    text = NET.replace('version="1.20"', 'version="1.20" lefthand="true"').replace("-4.8", "4.8")
    assert case(net=text.replace(",-1.6", ",1.6")).warnings == ()


# ---- persons ----


@pytest.mark.parametrize(
    ("person", "field", "value", "word"),
    [
        ('<person id="p" depart="1"/>', "person.id", "p", "no plan"),
        ('<personFlow id="p" begin="0" period="2"/>', "personFlow.id", "p", "no plan"),
        ('<person id="p" depart="1"><walk/></person>', "walk.from", "", "begins nowhere"),
        ('<person id="p" depart="1"><walk from="ab"/></person>', "walk.to", "", "leads nowhere"),
        ('<person id="p" depart="1"><walk edges=" "/></person>', "walk.edges", "", "empty"),
        ('<person id="p" depart="1"><ride from="ab" lines="1"/></person>', "ride.to", "", "leads nowhere"),
        ('<person id="p" depart="1"><walk from="ab" to="zz"/></person>', "walk.to", "zz", "no such edge"),
    ],
)
def test_a_person_without_a_way_is_refused(
    case: Case, person: str, field: str, value: str, word: str
) -> None:
    text = ROUTES.replace("</routes>", f"{person}</routes>")
    refused(lambda: case(routes=text), "r.rou.xml", field, value, word)


def test_whole_plans_pass_and_a_walk_with_a_gap_is_a_warning(case: Case) -> None:
    plans = (
        '<person id="p" depart="4"><walk from="ab" to="bc"/><ride to="bc" lines="any"/></person>'
        '<person id="q" depart="triggered"><ride to="bc" lines="v0"/><walk edges="bc ab"/></person>'
    )
    assert case(routes=ROUTES.replace("</routes>", f"{plans}</routes>")).warnings == ()
    lane = '<lane id="xy_0" index="0" speed="9" length="9" shape="0,9 9,9"/>'
    far = f'<edge id="xy" from="x" to="y">{lane}</edge>'
    ends = '<junction id="x" type="dead_end" x="0" y="9"/><junction id="y" type="dead_end" x="9" y="9"/>'
    net = NET.replace("</net>", f"{far}{ends}</net>")
    walk = '<person id="p" depart="4"><walk edges="ab xy"/></person>'
    (warning,) = case(net=net, routes=ROUTES.replace("</routes>", f"{walk}</routes>")).warnings
    assert "a walk with a gap (p, line 8): SUMO moves the person from 'ab' to 'xy'" in warning


BACK = '<route id="back" edges="bc ab"/>'
WALKER = '<person id="p" depart="4"><walk route="back"/></person>'
DRIVERS = {
    "a vehicle": '<vehicle id="x" depart="4" route="back"/>',
    "a flow": '<flow id="x" begin="4" period="5" number="3" route="back"/>',
    "a distribution": '<routeDistribution id="d" routes="back r" probabilities="1 1"/>',
    "a vehicle's own": '<vehicle id="x" depart="4"><route edges="bc ab"/></vehicle>',
    "nobody": "",
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_route_that_only_persons_walk_needs_no_connection(case: Case, driver: str) -> None:
    def warnings(more: str) -> tuple[str, ...]:
        return case(routes=ROUTES.replace("</routes>", f"{BACK}{more}</routes>")).warnings

    assert warnings(WALKER) == ()
    (warning,) = warnings(DRIVERS[driver] + WALKER * (driver != "nobody"))
    assert "no connection from 'bc' to 'ab'" in warning


def test_a_walk_on_a_route_that_is_none_is_refused(case: Case) -> None:
    text = ROUTES.replace("</routes>", f"{WALKER}</routes>")
    refused(lambda: case(routes=text), "r.rou.xml", "walk.route", "back", "no such route of a walk")


def test_the_reading_of_files_is_watched_to_its_end(case: Case, tmp_path: Path) -> None:
    told: list[tuple[float, float]] = []
    with vetting.watched(lambda done, total: told.append((done, total))):
        case()
    size = sum((tmp_path / name).stat().st_size for name in ("n.net.xml", "r.rou.xml", "a.add.xml")) / 1e6
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1] == (pytest.approx(size), pytest.approx(size))
    before = len(told)
    case()
    assert len(told) == before, "nobody watches any more"


# ---- not supported ----


def test_what_is_not_supported_makes_the_result_not_comparable(case: Case) -> None:
    tram = ROUTES.replace('<vType id="car"', '<vType id="t" vClass="tram"/><vType id="car"')
    assert case(routes=tram).warnings == ()  # nobody drives one
    (warning,) = case(routes=tram.replace('id="v0" type="car"', 'id="v0" type="t"')).warnings
    assert "no road vehicles: t (tram)" in warning
    mixture = tram.replace("<route id", '<vTypeDistribution id="m" vTypes="t car"/><route id', 1)
    assert "no road vehicles: t (tram)" in case(routes=mixture).warnings[0]
    neigh = NET.replace('shape="0,-1.6 500,-1.6"/>', 'shape="0,-1.6 500,-1.6"><neigh lane="bc_1"/></lane>', 1)
    (warning,) = case(net=neigh).warnings
    assert "overtaking on the opposite side is allowed on ab" in warning


def test_the_sublane_model_that_is_set_aside_is_said(case: Case, tmp_path: Path) -> None:
    case()
    config = tmp_path / "c.sumocfg"
    text = config.read_text()
    for value, warned in (("0.8", True), ("-1", False)):
        config.write_text(text.replace("</conf", f'<lateral-resolution value="{value}"/></conf'))
        assert vet(load(str(config))).warnings == (), "SUMO drives its model where cosim drives nobody"
        with_avs = load(str(config), fleet=Fleet(penetration=0.2))
        assert ["sublane" in warning for warning in vet(with_avs).warnings] == [True] * warned


# ---- mission ----


@pytest.mark.parametrize("name", ["v0", "t0", "f.7", "f.*", "v.", "f\\.3"])
def test_a_mission_vehicle_that_the_demand_may_have_passes(case: Case, tmp_path: Path, name: str) -> None:
    case()
    assert vet(load(str(tmp_path / "c.sumocfg"), mission=name)).flows == 1


@pytest.mark.parametrize(("name", "near"), [("v9", "'v1'"), ("f", "'f.0'"), ("g.1", "no such")])
def test_a_mission_vehicle_that_nobody_is_is_refused(
    case: Case, tmp_path: Path, name: str, near: str
) -> None:
    case()
    config = tmp_path / "c.sumocfg"
    refused(lambda: vet(load(str(config), mission=name)), "c.sumocfg", "--mission", name, near)
