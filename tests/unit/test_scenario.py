"""A scenario is read from our worlds and from anybody's .sumocfg; what is wrong is named."""

import gzip
import shutil
from pathlib import Path

import pytest

import sumo_scenarios
from cosim import scenario
from cosim.errors import BadInput
from cosim.scenario import Fleet, Mission, load, sumocfg, with_preset
from cosim.scenario.options import EpisodeOptions
from cosim.types import Preset

WORLD = """
name: lane
title: A lane that ends
duration: 40
warmup: 10
timing: {step: 0.1, frame: 0.2, decision: 0.4}
preset: unguarded
demand: dense
fleet: {type: av}
mission: {kind: merge, vehicles: "m.*", goal: [main2]}
conflict_zones: [{name: merge, edges: [main1]}]
"""


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A user's configuration with outputs, a GUI and a TraCI port in it."""
    (tmp_path / "in").mkdir()
    for name in ("a.net.xml", "b.rou.xml", "c.rou.xml", "d.add.xml"):
        (tmp_path / "in" / name).write_text("<x/>")
    path = tmp_path / "user.sumocfg"
    path.write_text(
        """<configuration>
        <input>
            <net-file value="in/a.net.xml"/>
            <route-files value="in/b.rou.xml,in/c.rou.xml"/>
            <additional-files value="in/d.add.xml"/>
        </input>
        <time><begin value="0:01:00"/><end value="200"/><step-length value="0.5"/></time>
        <processing>
            <time-to-teleport value="120"/><lanechange.duration value="3"/>
            <collision.action value="none"/><device.rerouting.period value="60"/>
        </processing>
        <output><tripinfo-output value="/etc/passwd"/><fcd-output value="host:9999"/></output>
        <traci_server><remote-port value="8813"/></traci_server>
        <random_number><seed value="7"/></random_number>
        </configuration>"""
    )
    return path


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A world of ours, `lane`, in a folder that the test may change."""
    folder = tmp_path / "lane"
    (folder / "demand").mkdir(parents=True)
    (folder / "scenario.yaml").write_text(WORLD)
    (folder / "net.net.xml").write_text("<net/>")
    for name in ("free", "dense", "contested"):
        (folder / "demand" / f"{name}.rou.xml").write_text("<routes/>")
    (folder / "lane.sumocfg").write_text(
        '<configuration><net-file value="net.net.xml"/><route-files value="demand/free.rou.xml"/>'
        '<max-depart-delay value="5"/></configuration>'
    )
    monkeypatch.setattr(sumo_scenarios, "ROOT", tmp_path)
    return folder


def test_a_foreign_configuration_keeps_its_traffic_and_loses_its_outputs(foreign: Path) -> None:
    s = load(str(foreign))
    assert s.name == f"{foreign.parent.name}/user"
    assert s.net == foreign.parent / "in" / "a.net.xml"
    assert [p.name for p in s.demand] == ["b.rou.xml", "c.rou.xml"]
    assert [p.name for p in s.additional] == ["d.add.xml"]
    assert dict(s.options) == {
        "time-to-teleport": "120",
        "lanechange.duration": "3",
        "device.rerouting.period": "60",
        "collision.action": "none",
    }
    ignored = " ".join(s.ignored)
    for name in ("tripinfo-output", "fcd-output", "remote-port", "seed"):
        assert f"{name}=" in ignored
    assert (s.begin, s.duration, s.warmup) == (60.0, 140.0, 0.0)
    assert (s.behavior, s.demand_name, s.preset) == ("as-is", "as-is", Preset.LAWFUL)
    assert (s.timing.step, s.traffic, s.changed) == (0.5, "as-is", ())
    assert not s.built_in


def test_two_files_of_one_name_are_two_worlds_by_their_folders(foreign: Path) -> None:
    for city in ("north", "south"):
        (foreign.parent / city).symlink_to(foreign.parent)
    names = [load(str(foreign.parent / city / "user.sumocfg")).name for city in ("north", "south")]
    assert names == ["north/user", "south/user"]


def test_a_users_file_has_the_warm_up_and_the_mission_vehicle_that_are_asked_for(foreign: Path) -> None:
    s = load(str(foreign), warmup=20, mission="cars.3")
    assert (s.begin, s.warmup, s.duration) == (60.0, 20.0, 140.0)
    assert s.mission == Mission("auto", "cars.3")
    assert not s.mission.guessed
    assert [name for name in ("cars.3", "carsX3", "cars.33") if s.mission.includes(name)] == [
        "cars.3",
        "carsX3",
    ]
    assert load(str(foreign)).mission.guessed
    assert not load(str(foreign), mission="none").mission.guessed


def test_the_mission_vehicle_of_a_world_may_be_another_and_keeps_its_goal(world: Path) -> None:  # noqa: ARG001
    assert load("lane", mission="x").mission == Mission("merge", "x", ("main2",))
    assert load("lane", mission="auto").mission == Mission("auto")
    assert load("lane", warmup=0).warmup == 0.0


def test_a_configuration_without_an_end_runs_a_minute(tmp_path: Path) -> None:
    (tmp_path / "n.net.xml").write_text("<net/>")
    path = tmp_path / "x.sumocfg"
    for end in ("", '<end value="-1"/>'):
        path.write_text(f'<sumoConfiguration><n v="n.net.xml"/>{end}</sumoConfiguration>')
        s = load(str(path))
        assert s.duration == scenario.FOREIGN_DURATION
        assert s.net == tmp_path / "n.net.xml"


def test_options_after_the_dashes_win_over_the_file(foreign: Path) -> None:
    s = load(
        str(foreign),
        options=[
            "--time-to-teleport",
            "-1",
            "--scale=1.5",
            "--step-length",
            "0.2",
            "-e",
            "100",
            "--sloppy-insert",
        ],
    )
    options = dict(s.options)
    assert options["time-to-teleport"] == "-1"
    assert options["scale"] == "1.5"
    assert options["sloppy-insert"] == "true"
    assert options["lanechange.duration"] == "3"
    assert s.timing.step == 0.2
    assert s.duration == 40.0
    assert not {"step-length", "end"} & options.keys()


def test_the_duration_asked_for_wins_over_every_other(foreign: Path) -> None:
    assert load(str(foreign), duration=12.0, options=["--end", "100"]).duration == 12.0


def test_a_later_begin_leaves_the_files_end_where_it_is(foreign: Path) -> None:
    s = load(str(foreign), options=["-b", "150"])
    assert (s.begin, s.duration) == (150.0, 50.0)


def test_a_demand_file_replaces_the_route_files(foreign: Path, tmp_path: Path) -> None:
    packed = tmp_path / "rush.trips.xml.gz"
    packed.write_bytes(gzip.compress(b"<routes/>"))
    s = load(str(foreign), demand=[str(packed), str(tmp_path / "in" / "b.rou.xml")])
    assert s.demand == (packed, tmp_path / "in" / "b.rou.xml")
    assert s.demand_name == "rush.trips+b"


def test_a_world_is_read_from_its_folder(world: Path) -> None:
    s = load("lane")
    assert s.built_in
    assert s.demands is not None
    assert sorted(s.demands) == ["contested", "dense", "free"]
    assert s.demand == (world / "demand" / "dense.rou.xml",)
    assert (s.duration, s.warmup, s.demand_name, s.behavior) == (40.0, 10.0, "dense", "mixed")
    assert s.fleet == Fleet(type="av")
    assert (s.mission.kind, s.mission.vehicles, s.mission.goal) == ("merge", "m.*", ("main2",))
    assert s.zones[0].edges == ("main1",)
    assert dict(s.options) == {"max-depart-delay": "5"}


def test_contested_demand_has_moderate_drivers_and_a_users_file_its_own(world: Path) -> None:
    assert load("lane", demand=["contested"]).behavior == "moderate"
    assert load("lane", demand=["contested"], behavior="aggressive").behavior == "aggressive"
    own = world.parent / "own.rou.xml"
    own.write_text("<routes/>")
    assert load("lane", demand=[str(own)]).behavior == "as-is"


def test_the_command_lines_fleet_and_preset_win(world: Path) -> None:  # noqa: ARG001
    s = load("lane", fleet=Fleet(penetration=0.2), preset="guarded")
    assert (s.fleet.describe(), s.preset) == ("penetration 0.2", "guarded")


def named(what: str, **options: str) -> str | None:
    """The preset in an episode's key."""
    return with_preset(EpisodeOptions(what, **options)).preset


@pytest.mark.parametrize("name", [*sumo_scenarios.names(), *sumo_scenarios.practice()])
def test_a_copied_world_is_driven_in_the_preset_of_the_original(name: str, tmp_path: Path) -> None:
    copy = tmp_path / "mine"
    shutil.copytree(sumo_scenarios.folder(name), copy)
    own = Path(name).name
    (copy / f"{own}.sumocfg").rename(copy / "mine.sumocfg")
    definition = copy / "scenario.yaml"
    definition.write_text(definition.read_text().replace(f"name: {own}", "name: mine"))
    for what in (name, str(copy)):
        assert load(what).preset == named(what) == Preset.LAWFUL
        assert load(what, preset="unguarded").preset == Preset.UNGUARDED
        assert named(what, preset="unguarded") == named(what, policy="keep-lane") == Preset.UNGUARDED


@pytest.mark.parametrize(("line", "preset"), [("guarded", "guarded"), ("unguarded", "lawful")])
def test_a_world_may_ask_for_another_guard_but_not_for_none(
    line: str, preset: str, world: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own"
    shutil.copytree(world, own)
    (own / "lane.sumocfg").rename(own / "own.sumocfg")
    (own / "scenario.yaml").write_text(f"name: own\npreset: {line}\ndemand: dense\n")
    assert load(str(own)).preset == named(str(own)) == preset


@pytest.mark.parametrize(
    ("line", "field", "word"),
    [
        ("duraton: 3", "duraton", "'duration'"),
        ("duration: .nan", "duration", "finite"),
        ("duration: 0", "duration", "more than 0"),
        ("duration: soon", "duration", "number"),
        ("warmup: -1", "warmup", "at least 0"),
        ("preset: ungarded", "preset", "'unguarded'"),
        ("demand: desne", "demand", "'dense'"),
        ("timing: {frame: 0.25}", "timing.step", "whole number"),
        ("timing: {decison: 0.4}", "timing.decison", "'decision'"),
        ("timing: 3", "timing", "mapping"),
        ("fleet: {penetration: 1.5}", "fleet.penetration", "from 0 to 1"),
        ("fleet: {ids: '('}", "fleet.ids", "regular expression"),
        ("mission: {kind: merg}", "mission.kind", "'merge'"),
        ("mission: {goal: 3}", "mission.goal", "list"),
        ("conflict_zones: [3]", "conflict_zones[0]", "mapping"),
        ("name: other", "name", "folder"),
        ("title: [", "line", "YAML"),
        ("- 1", "file", "mapping"),
    ],
)
def test_a_wrong_field_of_scenario_yaml_is_named(world: Path, line: str, field: str, word: str) -> None:
    (world / "scenario.yaml").write_text(line)
    with pytest.raises(BadInput, match=r"scenario\.yaml") as caught:
        load("lane")
    assert caught.value.field == field
    assert word in str(caught.value)
    assert caught.value.value is not None


@pytest.mark.parametrize(
    ("arguments", "field", "word"),
    [
        ({"what": "lnae"}, "scenario", "'lane'"),
        ({"what": "n" * 400}, "scenario", "no such"),
        ({"what": "lane\0"}, "scenario", "no such"),
        ({"what": "lane", "demand": ["contestd"]}, "--demand", "'contested'"),
        ({"what": "lane", "demand": ["gone.rou.xml"]}, "--demand", "no such file"),
        ({"what": "lane", "behavior": "agressive"}, "behavior", "'aggressive'"),
        ({"what": "lane", "driver_model": "lc2031"}, "driver_model", "'lc2013'"),
        ({"what": "lane", "preset": "gaurded"}, "preset", "'guarded'"),
        ({"what": "lane", "duration": float("nan")}, "duration", "finite"),
        ({"what": "lane", "duration": -1.0}, "duration", "more than 0"),
        ({"what": "lane", "warmup": float("inf")}, "warmup", "finite"),
        ({"what": "lane", "warmup": -1.0}, "warmup", "at least 0"),
        ({"what": "lane", "mission": "["}, "--mission", "regular expression"),
        ({"what": "lane", "mission": ""}, "--mission", "name a vehicle"),
        ({"what": "lane", "fleet": Fleet(ids="[")}, "av_ids", "regular expression"),
        ({"what": "lane", "fleet": Fleet(penetration=float("nan"))}, "penetration", "number from 0 to 1"),
        ({"what": "lane", "options": ["--seed", "3"]}, "--seed", "--seed"),
        ({"what": "lane", "options": ["--random"]}, "--random", "repeatable"),
        ({"what": "lane", "options": ["--remote-port=1"]}, "--remote-port", "itself"),
        ({"what": "lane", "options": ["--collision.action", "none"]}, "--collision.action", "counted"),
        ({"what": "lane", "options": ["--step-length", "0.15"]}, "--step-length", "whole number"),
        ({"what": "lane", "options": ["--scale", "nan"]}, "--scale", "finite"),
        ({"what": "lane", "options": ["--begin", "soon"]}, "--begin", "time"),
        ({"what": "lane", "options": ["--end", "-5"]}, "--begin/--end", "ends before"),
        ({"what": "lane", "options": ["-n", "gone.net.xml"]}, "--net-file", "no such file"),
        ({"what": "lane", "options": ["loose"]}, "SUMO options", "not a SUMO option"),
    ],
)
def test_a_wrong_argument_is_named(
    world: Path,  # noqa: ARG001
    arguments: dict[str, object],
    field: str,
    word: str,
) -> None:
    with pytest.raises(BadInput) as caught:
        load(**arguments)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "field", "word"),
    [
        ("in/a.net.xml", "in/gone.net.xml", "net-file", "no such file"),
        ("in/c.rou.xml", "in/gone.rou.xml", "route-files", "gone.rou.xml"),
        ("in/d.add.xml", "in", "additional-files", "folder"),
        ('<net-file value="in/a.net.xml"/>', "", "net-file", "one net"),
        ("in/a.net.xml", "", "net-file", "one net"),
        ("in/a.net.xml", "in/a.net.xml,in/b.rou.xml", "net-file", "one net"),
        ("in/a.net.xml", "a" * 400, "net-file", "too long"),
        ('<end value="200"/>', '<end value="30"/>', "end", "before"),
        ('<end value="200"/>', '<end value="inf"/>', "end", "not a time"),
        ('<end value="200"/>', '<end value="1"/><end value="2"/>', "end", "twice"),
        ('<time-to-teleport value="120"/>', '<scale value="NaN"/>', "scale", "finite"),
        ('<time-to-teleport value="120"/>', '<mesosim value="true"/>', "mesosim", "mesoscopic"),
        ("</configuration>", "", "line", "truncated"),
    ],
)
def test_a_wrong_configuration_is_named(foreign: Path, old: str, new: str, field: str, word: str) -> None:
    foreign.write_text(foreign.read_text().replace(old, new))
    with pytest.raises(BadInput, match=r"user\.sumocfg") as caught:
        load(str(foreign))
    assert caught.value.field == field
    assert word in str(caught.value)


def test_a_net_given_as_a_configuration_is_the_wrong_root(foreign: Path) -> None:
    foreign.write_text('<net version="1.20"/>')
    with pytest.raises(BadInput, match="wrong root") as caught:
        load(str(foreign))
    assert caught.value.value == "net"


def test_a_fifo_is_refused_instead_of_waited_for(foreign: Path, tmp_path: Path) -> None:
    import os

    (tmp_path / "in" / "b.rou.xml").unlink()
    os.mkfifo(tmp_path / "in" / "b.rou.xml")
    with pytest.raises(BadInput, match="regular file"):
        load(str(foreign))


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90.0), ("0:01:30", 90.0), ("1:00:00:00.5", 86400.5), ("-3", -3.0)]
)
def test_sumos_time_formats_are_seconds(text: str, seconds: float) -> None:
    assert sumocfg.time_of(text, None, "t") == seconds


def test_options_that_write_are_never_kept() -> None:
    for name in (
        "fcd-output",
        "device.rerouting.output",
        "device.toc.file",
        "device.taxi.dispatch-algorithm.output",
        "save-state.prefix",
        "log",
        "pedestrian.jupedsim.wkt",
        "gui-settings-file",
        "tls.actuated.show-detectors",
    ):
        assert not sumocfg.keeps(name), name
    for name in (
        "time-to-teleport.highways",
        "default.speeddev",
        "scale",
        "device.rerouting.adaptation-steps",
    ):
        assert sumocfg.keeps(name), name
