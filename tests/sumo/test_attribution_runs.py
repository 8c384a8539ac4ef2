"""`cosim bench attribution` as a user meets it: it writes what it promises and drives as `cosim run` does."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.record import planned
from cosim.cli.main import main
from cosim.learning.attribution import Asking
from cosim.workers.worker import Worker


def test_who_is_asked_drives_the_same_episode() -> None:
    plan = planned(
        range(150000, 150001),
        scenario="merge",
        demand="contested",
        policy="vfn-p",
        duration=3.2,
    )
    ((_, case),) = plan.cases()
    hashes = []
    for host in (EpisodeRunner, Asking):
        with Worker(host) as worker:
            found = worker.call("run", case, (), None, progress=lambda *_: None)
            hashes.append(found["trace_hash"])
    assert hashes[0] == hashes[1]
    asked = {sums[0] for (_, how), sums in found["answers"].items() if how == "zeroed"}
    assert asked == {found["answers"]["phi", "0 degrees"][0]}
    assert asked.pop() > found["steps"], "several AVs a decision"


def test_the_command_writes_table_page_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--policy",
        "vfn",
        "--scenario",
        "merge",
        "--demand",
        "contested",
        "--seeds",
        "150000:150002",
        "--duration",
        "1.2",
    ]
    assert main(["bench", "attribution", *words, "--out", str(tmp_path)]) == 0
    with (tmp_path / "attribution.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} == {"vfn"}
    assert len({(row["input"], row["replacement"]) for row in rows}) == len(rows) == 11
    text = (tmp_path / "attribution.md").read_text()
    assert text in capsys.readouterr().out
    assert text.startswith("# Which inputs the value networks use\n\n| policy |")
    assert "\n| `vfn` | " in text
    assert "preset `lawful`" in text
    assert "2 episodes a policy" in text
    assert (tmp_path / "attribution.png").stat().st_size > 1000


def test_driving_with_an_input_replaced_is_compared_with_driving_by_all_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--policy", "vfn", "--scenario", "merge", "--demand", "contested", "--closed-loop"]
    words += ["--seeds", "150000:150001", "--duration", "1.2", "--errors", "stress"]
    assert main(["bench", "attribution", *words, "--out", str(tmp_path)]) == 0
    with (tmp_path / "closed_loop.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["input"], row["replacement"]) for row in rows] == [
        ("nothing", ""),
        ("maps", "another AV's"),
        ("kinematics", "another AV's"),
        ("situation", "another AV's"),
        ("map branch", "its last layer zero"),
        ("phi", "0 degrees"),
        ("prediction", "the fair oracle's"),
    ]
    assert {row["seed"] for row in rows} == {"150000"}
    text = capsys.readouterr().out
    assert "### vfn, merge, 1 episodes" in text
    assert "| map branch | its last layer zero |" in text


def test_one_input_alone_is_replaced_where_it_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--policy", "vfn-p", "--scenario", "merge", "--demand", "contested", "--closed-loop"]
    words += ["--seeds", "150000:150001", "--duration", "1.2", "--out", str(tmp_path)]
    assert main(["bench", "attribution", *words, "--replace", "all maps"]) == 0
    with (tmp_path / "closed_loop.csv").open(newline="") as file:
        assert [row["input"] for row in csv.DictReader(file)] == ["nothing", "all maps"]
    assert main(["bench", "attribution", *words, "--replace", "all map"]) == 2
    assert "did you mean 'all maps'" in capsys.readouterr().err


def test_a_policy_that_has_no_network_is_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--policy", "altruist-rule", "--scenario", "merge", "--seeds", "150000:150001"]
    assert main(["bench", "attribution", *words, "--out", str(tmp_path)]) == 2
    assert "policy='altruist-rule'" in capsys.readouterr().err
