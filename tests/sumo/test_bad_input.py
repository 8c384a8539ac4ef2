"""Whatever a user gets wrong, `cosim run` answers in one sentence with file, field, value; exit code 2."""

import gzip
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import sumo

from cosim.cli.main import main

RAMP = Path(sumo.__file__).parent / "tools" / "game" / "ramp"  # a small net that none of us wrote
NET, ROUTES, ADDITIONAL = "ramp.net.xml", "ramp.rou.xml", "more.add.xml"
CONFIG = f"""<configuration>
    <net-file value="{NET}"/><route-files value="{ROUTES}"/><additional-files value="{ADDITIONAL}"/>
    <begin value="0"/><end value="4"/>
</configuration>"""

Damage = Callable[[Path], None]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A sound scenario of one's own: the package's ramp, copied."""
    for name in (NET, ROUTES):
        shutil.copy(RAMP / name, tmp_path / name)
    (tmp_path / ADDITIONAL).write_text('<additional><vType id="mine" length="5"/></additional>')
    (tmp_path / "mine.sumocfg").write_text(CONFIG)
    return tmp_path / "mine.sumocfg"


def swap(name: str, pattern: str, new: str) -> Damage:
    """Replace the first match of `pattern` in the file `name`."""

    def damage(folder: Path) -> None:
        text, count = re.subn(pattern, new, (folder / name).read_text(), count=1)
        assert count == 1
        (folder / name).write_text(text)

    return damage


def put(name: str, content: bytes) -> Damage:
    """Replace the file `name`."""
    return lambda folder: (folder / name).write_bytes(content) and None


def cut(name: str, share: float) -> Damage:
    """Keep only the first `share` of the file `name`."""

    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(len(content) * share)])

    return damage


def drop(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


BOMB = (
    b"<!DOCTYPE r [<!ENTITY a 'ha'><!ENTITY b '" + b"&a;" * 99 + b"'><!ENTITY c '" + b"&b;" * 99 + b"'>]>"
    b"<routes>&c;</routes>"
)
OUTSIDE = b"<!DOCTYPE r [<!ENTITY x SYSTEM 'file:///etc/hostname'>]><routes>&x;</routes>"

# what is damaged -> how; then what the one line must name: file, field, value, and the problem
FILES: dict[str, tuple[Damage, str, str, str, str]] = {
    "missing net": (drop(NET), "mine.sumocfg", "net-file", NET, "no such file"),
    "empty net": (put(NET, b""), NET, "size", "0", "empty"),
    "truncated net": (cut(NET, 0.6), NET, "line", "", ""),
    "net without version": (swap(NET, r'<net version="[^"]*"', "<net"), NET, "net.version", "''", "missing"),
    "net with a routes root": (put(NET, b"<routes/>"), NET, "root", "routes", "wrong root"),
    "net in Latin-1": (
        put(NET, b'<net version="1.20">\n<!-- \xe4 --></net>'),
        NET,
        "byte",
        "0xe4",
        "not UTF-8",
    ),
    "negative length": (
        swap(NET, r'length="[\d.]+"', 'length="-3"'),
        NET,
        "lane.length",
        "-3",
        "more than 0",
    ),
    "negative speed": (swap(NET, r'speed="[\d.]+"', 'speed="-3"'), NET, "lane.speed", "-3", "more than 0"),
    "NaN speed": (swap(NET, r'speed="[\d.]+"', 'speed="NaN"'), NET, "lane.speed", "NaN", "finite"),
    "NaN shape": (swap(NET, r'shape="[\d.-]+', 'shape="nan'), NET, "shape", "nan", "finite"),
    "lane gap": (
        swap(NET, r'id="gneE2_1" index="1"', 'id="gneE2_1" index="7"'),
        NET,
        "lane.index",
        "7",
        "1 is due",
    ),
    "lost connection": (
        swap(NET, r'<connection from="gneE2"[^>]*>', ""),
        NET,
        "junction.id",
        "gneJ",
        "rebuild",
    ),
    "missing routes": (drop(ROUTES), "mine.sumocfg", "route-files", ROUTES, "no such file"),
    "unknown edge": (
        swap(ROUTES, "gneE3 gneE7", "gneE3 gneE99"),
        ROUTES,
        "route.edges",
        "gneE99",
        "no such edge",
    ),
    "unknown type": (
        swap(ROUTES, 'route="highway" ', 'route="highway" type="lorry" '),
        ROUTES,
        "type",
        "lorry",
        "",
    ),
    "unknown route": (
        swap(ROUTES, 'route="highway" ', 'route="hihgway" '),
        ROUTES,
        "flow.route",
        "hihgway",
        "'highway'",
    ),
    "negative vType length": (
        swap(ROUTES, 'length="12.0"', 'length="-12"'),
        ROUTES,
        "vType.length",
        "-12",
        "",
    ),
    "infinite minGap": (
        swap(ROUTES, 'minGap="2.5"', 'minGap="inf"'),
        ROUTES,
        "vType.minGap",
        "inf",
        "finite",
    ),
    "NaN begin": (swap(ROUTES, 'begin="0"', 'begin="nan"'), ROUTES, "flow.begin", "nan", "finite"),
    "negative flow": (swap(ROUTES, '"2500"', '"-2500"'), ROUTES, "flow.vehsPerHour", "-2500", "at least 0"),
    "unknown lane-change attribute": (
        swap(ROUTES, 'minGap="2.5"', 'lcSpedGain="1"'),
        ROUTES,
        "vType.lcSpedGain",
        "1",
        "did you mean 'lcSpeedGain'?",
    ),
    "entity bomb": (put(ROUTES, BOMB), ROUTES, "ENTITY", "a", "entities"),
    "external entity": (put(ROUTES, OUTSIDE), ROUTES, "ENTITY", "x", "entities"),
    "routes in Latin-1": (put(ROUTES, b"<routes>\xe4</routes>"), ROUTES, "byte", "0xe4", "not UTF-8"),
    "routes in UTF-16": (
        put(ROUTES, "<routes/>".encode("utf-16")),
        ROUTES,
        "encoding",
        "UTF-16",
        "not UTF-8",
    ),
    "broken gzip": (put(ROUTES, gzip.compress(b"<routes/>" * 99)[:-9]), ROUTES, "gzip", "0", "broken gzip"),
    "garbage": (put(ROUTES, bytes(range(256))), ROUTES, "line", "1", "not"),
    "missing additional": (drop(ADDITIONAL), "mine.sumocfg", "additional-files", ADDITIONAL, "no such file"),
    "net as additional": (put(ADDITIONAL, b"<net/>"), ADDITIONAL, "root", "net", "wrong root"),
    "configuration with another root": (
        put("mine.sumocfg", b"<net/>"),
        "mine.sumocfg",
        "root",
        "net",
        "wrong root",
    ),
    "truncated configuration": (cut("mine.sumocfg", 0.5), "mine.sumocfg", "line", "", ""),
    "detector on no lane": (
        put(ADDITIONAL, b'<additional><e1Detector id="d" lane="gneE2_9" pos="1" file="x"/></additional>'),
        ADDITIONAL,
        "e1Detector.lane",
        "gneE2_9",
        "no such lane",
    ),
}

ARGUMENTS: dict[str, tuple[list[str], str, str]] = {
    "unknown policy": (["--policy", "idn"], "idn", "'idm'"),
    "unknown demand": (["--demand", "gone.rou.xml"], "gone.rou.xml", "no such file"),
    "unknown AV type": (["--av-type", "trukc"], "trukc", "'truck'"),
    "AV pattern": (["--av-ids", "("], "--av-ids", "regular expression"),
    "SUMO seed": (["--", "--seed", "3"], "--seed", "cosim's own"),
    "step that does not divide": (
        ["--penetration", "1", "--", "--step-length", "0.3"],
        "--step-length='0.3'",
        "whole number",
    ),
    "output path below a file": (["--out", "{folder}/mine.sumocfg/run"], "mine.sumocfg", ""),
}


def refused(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """The one line with which `cosim run` refuses, exit code 2, nothing on stdout."""
    code = main(["run", *arguments])
    out, err = capfd.readouterr()
    assert (code, out) == (2, ""), err
    # on a slow machine a note says first what takes so long
    err = "".join(x for x in err.splitlines(keepends=True) if "starting SUMO" not in x)
    assert err.startswith("cosim: ")
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize("case", FILES)
def test_a_damaged_file_is_refused(case: str, config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    damage, file, field, value, problem = FILES[case]
    damage(config.parent)
    line = refused([str(config), "--json"], capfd)
    for part in (file, field, value, problem):
        assert part in line


@pytest.mark.parametrize("case", ARGUMENTS)
def test_a_wrong_argument_is_refused(case: str, config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    more, value, problem = ARGUMENTS[case]
    line = refused([str(config), "--json", *(m.format(folder=config.parent) for m in more)], capfd)
    assert value in line
    assert problem in line


def test_an_unknown_scenario_comes_with_the_nearest_name(capfd: pytest.CaptureFixture[str]) -> None:
    line = refused(["mrge"], capfd)
    assert "scenario='mrge'" in line
    assert "did you mean 'merge'?" in line


def test_what_only_sumo_finds_is_in_sumos_words(config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    swap(ROUTES, 'departSpeed="max"', 'departSpeed="fastest"')(config.parent)
    assert main(["run", str(config)]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert "mine.sumocfg: SUMO refuses it: Invalid departSpeed definition 'fastest'" in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('departSpeed="max"', 'departSpeed="999"', "Departure speed"),
        ('departLane="free"', 'departLane="77"', "Invalid departLane"),
    ],
)
def test_what_sumo_finds_while_driving_is_the_route_file_s_and_nothing_is_left_behind(
    old: str, new: str, problem: str, config: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    swap(ROUTES, old, new)(config.parent)
    out = config.parent / "out"
    assert main(["run", str(config), "--out", str(out)]) == 2
    err = capfd.readouterr().err
    assert f"{ROUTES}: SUMO refuses it: {problem}" in err
    assert not out.exists()


def test_options_after_two_dashes_are_refused_by_verbs_that_would_drop_them(
    capfd: pytest.CaptureFixture[str],
) -> None:
    for line in ("scenarios -- foo", "metrics a.xml -- --scale 3", "evaluate --out e -- --scale 3"):
        assert main(line.split()) == 2
        assert "only `cosim run` passes options on to SUMO" in capfd.readouterr().err


def test_an_ignored_option_of_the_file_is_named(config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config.write_text(config.read_text().replace("</configuration>", '<x value="3"/></configuration>'))
    assert main(["run", str(config), "--duration", "1"]) == 0
    assert "not passed on to SUMO: x=3" in capfd.readouterr().out


def test_an_unknown_sumo_option_is_reported_in_sumos_words(capfd: pytest.CaptureFixture[str]) -> None:
    assert "no-such-option" in refused(["merge", "--", "--no-such-option", "1"], capfd)


def test_the_sound_scenario_runs_packed_as_well(config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    packed = config.parent / f"{NET}.gz"
    packed.write_bytes(gzip.compress((config.parent / NET).read_bytes()))
    config.write_text(CONFIG.replace(NET, packed.name))
    assert main(["run", str(config), "--json"]) == 0
    assert '/mine", "demand"' in capfd.readouterr().out


def test_a_net_that_kills_sumo_leaves_a_live_process_and_exit_2(config: Path) -> None:
    """SUMO itself crashes on a net without version (SIGSEGV): a fresh process shows that ours does not."""
    swap(NET, r'<net version="[^"]*"', "<net")(config.parent)
    command = [sys.executable, "-m", "cosim.cli.main", "run", str(config), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "ramp.net.xml: net.version=''" in done.stderr
    assert "Traceback" not in done.stderr


TWICE = """
from cosim.errors import SimulationInUse
from cosim.scenario import load
from cosim.simulation.sumo import SumoSimulator

first = SumoSimulator(load("merge"))
before = first.reset(200_000)[-1]
try:
    SumoSimulator(load("merge"))
except SimulationInUse as error:
    print("refused:", error)
_, frames = first.advance(())
print("first goes on:", frames[-1].time > before.time)
first.close()
SumoSimulator(load("merge")).close()
print("and a third after it")
"""


def test_a_second_simulation_in_one_process_is_refused_and_the_first_goes_on() -> None:
    done = subprocess.run(
        [sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "refused: this process already runs a simulation" in done.stdout
    assert "first goes on: True" in done.stdout
    assert "and a third after it" in done.stdout
