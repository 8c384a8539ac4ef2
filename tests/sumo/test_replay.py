"""`cosim replay`: the same episode again, from a run's and from a batch's folder, or a clear refusal."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.report.replay.episode import find

SEED = "200041"


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder, with an option for SUMO and outputs."""
    out = tmp_path_factory.mktemp("run")
    arguments = ["run", "merge", "--demand", "contested", "--policy", "altruist-rule", "--seed", SEED]
    arguments += ["--duration", "4", "--output", "tripinfo", "--out", str(out)]
    assert main([*arguments, "--", "--scale", "0.8", "--no-warnings", "true"]) == 0
    return out


@pytest.fixture
def run(driven: Path, tmp_path: Path) -> Path:
    """A copy of it to change."""
    return Path(shutil.copytree(driven, tmp_path / "run"))


def changed(run: Path, **fields: object) -> None:
    """Rewrite the manifest with other values."""
    file = run / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def test_a_replay_is_the_same_episode_drawn(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "outputs" / "tripinfo.xml").stat().st_mtime_ns
    assert main(["replay", str(run), SEED]) == 0
    trace = json.loads((run / "result.json").read_text())["trace_hash"]
    assert f"the same episode: trace hash {trace}" in capsys.readouterr().out
    assert (run / "replay.html").stat().st_size > 30_000
    assert (run / "replay.mp4").stat().st_size > 10_000
    assert (run / "outputs" / "tripinfo.xml").stat().st_mtime_ns == before


def test_the_folder_says_what_was_driven(driven: Path) -> None:
    recorded = find(driven, None)
    assert recorded.case.policy == "altruist-rule"
    assert recorded.case.outputs == ("tripinfo",)
    assert recorded.options == ("--scale=0.8",)
    scenario = recorded.case.scenario(recorded.options)
    assert dict(scenario.options)["scale"] == "0.8"
    assert scenario.duration == 4.0


def test_another_episode_is_refused_with_exit_code_1(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"trace_hash": "0" * 64}))
    page = run / "page.html"
    assert main(["replay", str(run), "--html", str(page)]) == 1
    assert "the replay is not the recorded episode: trace hash" in capsys.readouterr().err
    assert not page.exists()
    assert main(["replay", str(run), "--html", str(page), "--no-check"]) == 0
    assert "ANOTHER episode" in capsys.readouterr().out
    assert page.exists()


def test_a_file_that_has_changed_is_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = json.loads((run / "manifest.json").read_text())["files"]
    changed(run, files={**files, "net.net.xml": "0" * 64})
    assert main(["replay", str(run)]) == 2
    error = capsys.readouterr().err
    assert "merge/net.net.xml: has changed since it was driven (SHA-256 000000000000..." in error


def test_a_setting_that_has_changed_is_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed(run, preset="guarded")
    assert main(["replay", str(run)]) == 2
    assert "preset: is 'lawful' now, it was 'guarded' when it was driven" in capsys.readouterr().err


def test_other_versions_are_only_warned_of(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    versions = json.loads((run / "manifest.json").read_text())["versions"]
    changed(run, versions=versions | {"numpy": "1.0"})
    assert main(["replay", str(run), "--html", str(run / "page.html")]) == 0
    assert "warning: driven with numpy 1.0, here is" in capsys.readouterr().err


def test_whom_the_film_shall_follow_must_be_there(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = run / "film.mp4"
    assert main(["replay", str(run), "--mp4", str(film), "--follow", "mission.9"]) == 2
    assert "--follow='mission.9': no such vehicle, did you mean 'mission.0'?" in capsys.readouterr().err
    assert not film.exists()


@pytest.mark.parametrize(
    ("file", "wrong", "said"),
    [
        ("manifest", {"seed": "x"}, "seed='x': a whole number is needed"),
        ("manifest", {"case": 3}, "case=3: a mapping is needed"),
        ("manifest", {"case": {"seed": "x"}}, "case.seed='x': a whole number is needed"),
        ("manifest", {"case": {"svo_deg": "east"}}, "case.svo_deg='east': a number from 0 to 90 is needed"),
        ("manifest", {"case": {"svo_deg": 91}}, "case.svo_deg=91: a number from 0 to 90 is needed"),
        ("manifest", {"case": {"seed": -1}}, "case.seed=-1: must be a whole number from 0 on"),
        ("manifest", {"case": {"policy": None}}, "case.policy: is missing"),
        ("manifest", {"case": {"policy": 3}}, "case.policy=3: text is needed"),
        ("manifest", {"files": []}, "files=[]: a mapping is needed"),
        ("manifest", {"versions": 3}, "versions=3: a mapping is needed"),
        ("manifest", {"policy_files": {"a": 1}}, "policy_files.a=1: text is needed"),
        ("manifest", {"sumo_arguments": [3]}, "sumo_arguments=3: text is needed"),
        ("manifest", {"cells": {"a": {"case": 3}}}, "cells.a.case=3: a mapping is needed"),
        ("result", {"trace_hash": 3}, "trace_hash=3: text is needed"),
    ],
)
def test_a_field_of_the_wrong_type_is_one_clear_sentence(
    run: Path, file: str, wrong: dict[str, Any], said: str
) -> None:
    path = run / f"{file}.json"
    document = json.loads(path.read_text())
    for name, value in wrong.items():
        merged = isinstance(value, dict) and name in document
        document[name] = {**document[name], **value} if merged else value
    path.write_text(json.dumps(document))
    with pytest.raises(BadInput) as refused:
        find(run, None)
    assert str(refused.value) == f"{path}: {said}"


def test_a_case_without_its_policy_is_refused(run: Path) -> None:
    case = json.loads((run / "manifest.json").read_text())["case"]
    changed(run, case={name: value for name, value in case.items() if name != "policy"})
    with pytest.raises(BadInput, match=r"manifest\.json: case\.policy: is missing"):
        find(run, None)


def test_a_folder_that_is_none_is_one_clear_sentence(tmp_path: Path, run: Path) -> None:
    with pytest.raises(
        BadInput, match="no such file: a folder of cosim run --out or cosim evaluate is needed"
    ):
        find(tmp_path / "nowhere", None)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(BadInput, match="was not written by this version"):
        find(tmp_path, None)
    with pytest.raises(BadInput, match=f"EPISODE='7': this folder holds one episode, with seed {SEED}"):
        find(run, "7")


def test_an_episode_of_a_batch_is_found_by_key_and_by_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batch = tmp_path / "batch"
    arguments = ["--scenario", "merge", "--policy", "keep-lane", "--policy", "idm", "--duration", "1"]
    arguments += ["--output", "tripinfo", "--seeds", "200052:200053", "--workers", "1", "--out", str(batch)]
    assert main(["evaluate", *arguments]) == 0
    manifest = json.loads((batch / "manifest.json").read_text())
    cell = next(c for c, v in manifest["cells"].items() if v["case"]["policy"] == "keep-lane")
    key = f"{cell}-200052"
    assert (batch / "outputs" / key / "tripinfo.xml").read_text().rstrip().endswith("</tripinfos>")
    with pytest.raises(BadInput, match=rf"2 episodes have this seed: {key} \(merge / \w+ / keep-lane\), "):
        find(batch, "200052")
    with pytest.raises(BadInput, match="did you mean"):
        find(batch, key[:-1])
    with pytest.raises(BadInput, match="holds 2 episodes: name one by its key or seed"):
        find(batch, None)
    capsys.readouterr()
    page = tmp_path / "page.html"
    assert main(["replay", str(batch), key, "--html", str(page)]) == 0
    assert "the same episode" in capsys.readouterr().out
    assert page.stat().st_size > 30_000


def test_another_policy_is_filmed_beside_it_on_the_same_traffic(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(run), "--beside", "idm"]) == 0
    assert "the same episode" in capsys.readouterr().out
    assert (run / "replay-beside-idm.mp4").stat().st_size > 10_000
    assert not list(run.glob("*.html"))
    gif = run / "both.gif"
    assert main(["replay", str(run), "--beside", "idm", "--gif", str(gif)]) == 0
    assert gif.read_bytes()[:6] == b"GIF89a"
    assert main(["replay", str(run), "--beside", "imd"]) == 2
    assert "--beside='imd': unknown policy, did you mean 'idm'?" in capsys.readouterr().err


def test_a_run_can_draw_its_replay_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(["run", "merge", "--duration", "1", "--replay", "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} >= {"replay.html", "replay.mp4", "result.json"}
    assert main(["run", "merge", "--replay"]) == 2
    assert "--replay: needs a run folder to write into: --out DIR" in capsys.readouterr().err


def page_of(run: Path) -> dict[str, Any]:
    """The document inside a run folder's page."""
    match = re.search(r'<script id="data"[^>]*>(.*?)</script>', (run / "replay.html").read_text(), re.DOTALL)
    assert match is not None
    found: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(match[1])))
    return found


def test_the_page_tells_every_offence_that_the_figures_count(
    tmp_path: Path, law_worlds: dict[str, Path]
) -> None:
    out = tmp_path / "run"
    arguments = ["run", str(law_worlds["mixed_types"]), "--policy", "keep-lane", "--penetration", "0.5"]
    arguments += ["--seed", "200001", "--duration", "40", "--replay", "--out", str(out)]
    assert main(arguments) == 0
    page, result = page_of(out), json.loads((out / "result.json").read_text())
    said = Counter("light" in page["words"][word] for _, _, word in page["violations"])
    counted = [result[f"{name}_violations"] for name in ("red_light", "stop_sign", "right_of_way")]
    assert counted[0] > 0
    assert said[True] == counted[0]
    assert said[False] == counted[1] + counted[2] + result["junctions_blocked"] + result["avs_stuck"]
    assert len(page["stop_lines"]) == 32
    assert all(line[2] for line in page["stop_lines"])
    assert {len(states) == len(frames) for states, frames in page["signals"]} == {True}
    assert max(len(states) for states, _ in page["signals"]) > 1
    assert len(page["shapes"]) > 1
    assert (out / "replay.mp4").stat().st_size > 10_000


def test_the_page_tells_persons_crossings_and_corrections(
    tmp_path: Path, law_worlds: dict[str, Path]
) -> None:
    out = tmp_path / "run"
    arguments = ["run", str(law_worlds["crossing_signals"]), "--policy", "random", "--penetration", "0.5"]
    arguments += ["--preset", "lawful", "--seed", "200001", "--duration", "40", "--replay", "--out", str(out)]
    assert main(arguments) == 0
    page, result = page_of(out), json.loads((out / "result.json").read_text())
    assert len(page["interventions"]) == result["interventions"] > 0
    assert len(page["crossings"]) == 4
    assert all(signal >= 0 for _, _, signal in page["crossings"])
    assert any(kind == 2 for _, kind, *_ in page["vehicles"])
