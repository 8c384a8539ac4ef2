"""SPEC.yaml and flags: the same matrix from both, and one clear sentence for everything that is wrong."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import pytest

from cosim.batch import matrix
from cosim.batch.spec import FIELDS, Spec, read
from cosim.errors import BadInput
from cosim.scenario.options import EpisodeOptions
from cosim.types import Preset
from policy.agents import check_name

ROUTES = """<routes><vType id="hv"/><vType id="av"/><route id="main" edges="main_in main_acc main_out"/>
<vehicle id="{name}" type="hv" route="main" depart="0"/></routes>"""


def of_file(folder: Path, text: str, **flags: Any) -> Spec:
    """The spec of a file with this text."""
    path = folder / "SPEC.yaml"
    path.write_text(text)
    return read(path, flags)


def of_flags(**flags: Any) -> Spec:
    """The spec of flags alone, as argparse hands them over."""
    return read(None, {name: flags.get(name) for name in FIELDS})


def plan(spec: Spec) -> matrix.Plan:
    return matrix.plan(matrix.cells(spec), range(*spec.seeds), check_name)


def demand(path: Path, name: str = "a") -> Path:
    """A demand file for the merge world."""
    text = ROUTES.format(name=name)
    if path.suffix == ".gz":
        with gzip.open(path, "wt") as file:
            file.write(text)
    else:
        path.write_text(text)
    return path


def test_a_file_and_flags_that_say_the_same_give_the_same_matrix(tmp_path: Path) -> None:
    text = """
scenario: [merge, exit]
demand: [free, contested]
policy: [idm, altruist-rule]
behavior: mixed
penetration: [0.2, 0.5]
svo: [0, 45.0]
preset: guarded
duration: 10
seeds: "200000:200003"
"""
    flags = of_flags(
        scenario=["merge", "exit"],
        demand=["free", "contested"],
        policy=["idm", "altruist-rule"],
        behavior=["mixed"],
        penetration=[0.2, 0.5],
        svo=[0.0, 45.0],
        preset=["guarded"],
        duration=10.0,
        seeds="200000:200003",
    )
    assert of_file(tmp_path, text) == flags
    cells = [*matrix.cells(flags)]
    assert len({case.cell for case in cells}) == len(cells) == 2**5
    assert flags.episodes == 2**5 * 3


def test_a_flag_beside_the_file_replaces_that_line_only(tmp_path: Path) -> None:
    text = 'scenario: merge\npolicy: [idm, random]\npenetration: 0.5\nseeds: "5:9"\n'
    spec = of_file(tmp_path, text, policy=["keep-lane"], av_type="av")
    assert (spec.values["what"], spec.values["policy"], spec.seeds) == (("merge",), ("keep-lane",), (5, 9))
    assert spec.values["av_type"] == ("av",)
    assert "penetration" not in spec.values, "another way to choose the fleet"


def test_globs_and_joined_files_are_demands_of_their_own(tmp_path: Path) -> None:
    for name in ("b.rou.xml", "a.rou.xml", "c.trips.xml", "d.rou.xml.gz"):
        demand(tmp_path / name, name[0])
    (tmp_path / "folder.rou.xml").mkdir()
    spec = of_file(
        tmp_path, "scenario: merge\ndemand: ['*.rou.xml', '*.gz', 'c.trips.xml,?.rou.xml', free]\n"
    )
    names = [tuple(Path(file).name for file in point) for point in spec.values["demand"]]
    assert names == [
        ("a.rou.xml",),
        ("b.rou.xml",),
        ("d.rou.xml.gz",),
        ("c.trips.xml", "a.rou.xml"),
        ("c.trips.xml", "b.rou.xml"),
        ("free",),
    ]
    assert [cell.scenario.demand_name for cell in plan(spec).cells][-3:] == ["c.trips+a", "c.trips+b", "free"]


def test_what_two_globs_find_twice_is_driven_once(tmp_path: Path) -> None:
    demand(tmp_path / "a.rou.xml")
    spec = of_file(tmp_path, "scenario: [merge, merge]\ndemand: ['*.xml', 'a*']\npolicy: [idm, idm]\n")
    assert spec.episodes == 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("scenario: merge\npolcy: idm\n", r"SPEC\.yaml: polcy='idm': unknown field, did you mean 'policy'\?"),
        ("policy: idm\n", r"SPEC\.yaml: scenario: name at least one"),
        ("scenario: merg\n", r"scenario='merg': no such scenario, did you mean 'merge'\?"),
        ("scenario: []\n", r"scenario: the list is empty"),
        ("scenario: merge\ndemand: '*.rou.xml'\n", r"demand='\*\.rou\.xml': no file matches"),
        ("scenario: merge\ndemand: not/there.rou.xml\n", r"demand='not/there.rou.xml': no such file"),
        ("scenario: merge\nseeds: 1:20\n", r"seeds=80: write \"a:b\" in quotes"),
        ("scenario: merge\nseeds: '7:7'\n", r"seeds='7:7': no seed lies between"),
        ("scenario: merge\nseeds: '-1:7'\n", r"seeds='-1:7': two whole numbers"),
        ("scenario: merge\nseeds: '0:9999999999999999999'\n", r"seeds end below"),
        ("scenario: merge\nseeds: '0:2000000'\n", r"2000000 episodes are more than 1000000"),
        ("scenario: merge\npenetration: [0.2, 1.5]\n", r"penetration=1\.5: a number from 0 to 1 is needed"),
        ("scenario: merge\nsvo: east\n", r"svo='east': a number from 0 to 90 is needed"),
        ("scenario: merge\nbehavior: agressive\n", r"behavior='agressive'.*'aggressive'"),
        ("scenario: merge\npreset: none\n", r"preset='none'"),
        ("scenario: merge\nduration: 0\n", r"duration=0: must be more than 0"),
        ("scenario: merge\nav_type: av\npenetration: 0.1\n", r"av_type=.av.: excludes penetration"),
        ("scenario: merge\nav_ids: '['\n", r"av_ids='\[': not a regular expression"),
        ("- merge\n", r"a mapping is needed"),
        ("scenario: [merge\n", r"not YAML"),
    ],
)
def test_a_wrong_spec_is_one_clear_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence) as caught:
        of_file(tmp_path, text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("policy: vnf-p\n", r"unknown policy, did you mean 'vfn-p'\?"),
        ("demand: contestd\n", r"no such demand.*contested"),
        ("output: [tripinfo, fdc]\n", r"--output='fdc'.*'fcd'"),
        ("av_type: avv\n", r"no such vehicle type in dense.rou.xml.*'av'"),
        (
            "demand: other.rou.xml\n",
            r"other\.rou\.xml: route\.edges='nowhere': no such edge in net",
        ),
        ("demand: [free, broken.rou.xml]\n", r"broken\.rou\.xml"),
    ],
)
def test_what_does_not_fit_the_scenario_is_found_before_anything_runs(
    tmp_path: Path, text: str, sentence: str
) -> None:
    (tmp_path / "other.rou.xml").write_text(
        '<routes><vehicle id="a" depart="0"><route edges="nowhere"/></vehicle></routes>'
    )
    (tmp_path / "broken.rou.xml").write_text("<routes><vehicle")
    with pytest.raises(BadInput, match=sentence):
        plan(of_file(tmp_path, "scenario: merge\n" + text))


def test_a_net_that_would_kill_sumo_costs_its_own_cells_only(tmp_path: Path) -> None:
    (tmp_path / "bad.net.xml").write_text("<net></net>")
    (tmp_path / "bad.sumocfg").write_text(
        '<configuration><net-file value="bad.net.xml"/><end value="9"/></configuration>'
    )
    found = plan(of_file(tmp_path, "scenario: [merge, bad.sumocfg]\n"))
    assert [cell.refused is None for cell in found.cells] == [True, False]
    assert "version" in str(found.cells[1].refused)


def test_a_case_keeps_its_key_and_comes_back_from_its_document() -> None:
    case = next(iter(matrix.cells(of_flags(scenario=["merge"], seeds="3:9", svo=[90.0]))))
    assert EpisodeOptions.read(case.document()) == case
    assert case.key == f"{case.cell}-3"
    assert case.with_seed(4).cell == case.cell
    assert case.preset == Preset.LAWFUL
    unnamed = EpisodeOptions.read({**case.document(), "preset": None})
    assert unnamed.cell == "a6779b4d52e4", "stores and manifests of earlier runs hold this hash"


def test_warm_up_and_mission_are_part_of_the_cell_where_they_are_given() -> None:
    plain, *others = (
        next(iter(matrix.cells(of_flags(scenario=["merge"], **more))))
        for more in ({}, {"warmup": 0.0}, {"warmup": 5.0}, {"mission": "none"})
    )
    assert not plain.document().keys() & {"warmup", "mission"}
    assert len({plain.cell, *(case.cell for case in others)}) == 4
    assert [EpisodeOptions.read(case.document()) for case in others] == others


def test_two_worlds_of_one_name_are_refused_by_their_places(tmp_path: Path) -> None:
    for place in ("a/city", "b/city", "b/town"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "bad.net.xml").write_text("<net></net>")
        (tmp_path / place / "run.sumocfg").write_text(
            '<configuration><net-file value="bad.net.xml"/></configuration>'
        )
    matrix.check_names(plan(of_file(tmp_path, "scenario: [a/city/run.sumocfg, b/town/run.sumocfg]\n")))
    with pytest.raises(BadInput, match=r"a/city/run\.sumocfg") as caught:
        matrix.check_names(plan(of_file(tmp_path, "scenario: ['*/city/run.sumocfg']\n")))
    assert (caught.value.field, caught.value.value) == ("scenario", str(tmp_path / "b/city/run.sumocfg"))


def test_the_spec_s_hash_does_not_hang_on_the_order_of_an_axis() -> None:
    one = plan(of_flags(scenario=["merge", "exit"], policy=["idm", "random"]))
    other = plan(of_flags(scenario=["exit", "merge"], policy=["random", "idm"]))
    more = plan(of_flags(scenario=["exit", "merge"], policy=["random", "idm"], seeds="200000:200002"))
    assert one.spec_hash == other.spec_hash != more.spec_hash
