"""SUMO's own outputs: whole, one per episode, changing nothing; and our figures found again in them."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from cosim.cli.main import main
from cosim.errors import BadInput, SimulationError
from cosim.host import Host
from cosim.scenario import load
from cosim.scenario.sumo_outputs import DRAFT, OUTPUTS, check, drafts
from cosim.workers.worker import Worker

MERGE = Path(__file__).parents[2] / "sumo_scenarios" / "merge"
ROOTS = {"fcd": "fcd-export", "tripinfo": "tripinfos", "ssm": "SSMLog", "statistic": "statistics"}


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Three drives by one process: two seeds with outputs, then the first one without."""
    folder = tmp_path_factory.mktemp("outputs")
    names = tuple(name for name in OUTPUTS if name not in ("full", "link", "emission", "netstate", "amitran"))
    found = {}
    with Worker(Host, load("merge", demand=["contested"], duration=12.0), "altruist-rule", math.pi / 4) as w:
        for seed in (200_031, 200_032):
            found[str(seed)] = w.call("run", seed, outputs=names, folder=folder / str(seed))
        found["without"] = w.call("run", 200_031)
    return folder, found


def test_every_file_is_whole_and_each_episode_has_its_own(episodes: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = episodes
    trips = {}
    for seed in ("200031", "200032"):
        files = sorted((folder / seed).iterdir())
        assert len(files) == len(OUTPUTS) - 5
        for file in files:
            root = ElementTree.parse(file).getroot()
            assert root.tag == ROOTS.get(file.stem, root.tag)
        trips[seed] = (folder / seed / "tripinfo.xml").read_text().partition("<tripinfos")[2]
    assert trips["200031"] != trips["200032"]
    assert trips["200031"].count("<tripinfo ") > 40  # vehicles still on the road are written too


def test_asking_for_outputs_changes_nothing(episodes: tuple[Path, dict[str, Any]]) -> None:
    _, found = episodes
    assert found["without"].trace_hash == found["200031"].trace_hash
    assert found["without"].metrics == found["200031"].metrics


@pytest.mark.parametrize("seed", ["200031", "200032"])
def test_the_fcd_file_yields_the_figures_of_the_episode(
    episodes: tuple[Path, dict[str, Any]], seed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, found = episodes
    arguments = ["--net", str(MERGE / "net.net.xml"), "--types", str(MERGE / "demand" / "contested.rou.xml")]
    arguments += ["--av-type", "av", "--mission", "mission.*", "--json"]
    assert main(["metrics", str(folder / seed / "fcd.xml"), *arguments]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["frames"] == 61
    assert len(document["units"]) == 17
    for name in document["units"]:
        expected = found[seed].value(name)
        # six digits after the point: differences of speeds 0.2 s apart are right to 5e-6 m/s2
        assert document[name] == (expected if expected is None else pytest.approx(expected, rel=1e-4)), name


def test_a_collision_ends_the_files_where_it_ends_the_episode(tmp_path: Path) -> None:
    scenario = load("merge", demand=["contested"], preset="unguarded")
    with Worker(Host, scenario, "random", math.pi / 4) as worker:
        result = worker.call("run", 200_031, outputs=("fcd", "collision"), folder=tmp_path)
    assert result.value("crashed") is True
    steps = ElementTree.parse(tmp_path / "fcd.xml").getroot()
    assert len(steps) == 2 * result.steps + 1
    assert "<collision " in (tmp_path / "collision.xml").read_text()


def test_names_are_sumo_s_and_a_wrong_one_is_helped_with() -> None:
    with pytest.raises(BadInput, match=r"--output='tripinfos': unknown, did you mean 'tripinfo'\?"):
        check(["fcd", "tripinfos"])
    with pytest.raises(BadInput, match=r"--fcd-output='x.xml': its file is named by --output fcd already"):
        check(["fcd"], {"fcd-output": "x.xml"})


def test_outputs_need_a_run_folder_and_fail_before_anything_is_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "merge", "--output", "fcd"]) == 2
    assert "--output: needs a run folder to write into: --out DIR" in capsys.readouterr().err
    assert main(["run", "merge", "--output", "fdc", "--out", str(tmp_path / "new")]) == 2
    assert "did you mean 'fcd'?" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_file_that_is_not_whole_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    def write(text: str) -> None:
        with drafts(["fcd"], tmp_path) as files:
            files["fcd"].write_text(text)

    with pytest.raises(SimulationError, match="did not write the whole fcd file"):
        write("<fcd-export><timestep time='0'")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / DRAFT).mkdir()  # of a run that was killed
    write("<fcd-export></fcd-export>\n")
    assert [p.name for p in tmp_path.iterdir()] == ["fcd.xml"]
