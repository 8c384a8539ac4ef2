"""Recordings as the predictor's data: what followed is what really followed; seeds stay apart."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.episode import Episode, run_episode
from cosim.errors import BadInput
from cosim.files import write_csv
from cosim.learning import map_bench, train_hpn
from cosim.learning.prediction_data import HORIZON, MAPLESS, Followed, followed
from cosim.recording.file import Recording, read, write
from cosim.recording.folder import Folder
from cosim.recording.recorder import Recorder
from cosim.recording.views import histories
from cosim.road import RoadMap
from cosim.scenario import Mission, load
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import COMPACT
from policy.agents.idm import Idm
from policy.networks.hpn import HPN, HpnConfig
from policy.training import hpn as trained


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One recorded episode of 8 s: an AV that stays, one that leaves the road, a slow human driver."""
    path = tmp_path_factory.mktemp("recordings")
    out = Folder(path)
    out.prepare()
    simulator = FakeSimulator(
        [
            FakeVehicle("av", 100.0, 0, 20.0, is_av=True),
            FakeVehicle("leaver", 280.0, 1, 20.0, is_av=True),
            FakeVehicle("human", 130.0, 1, 12.0),
        ],
        length=400.0,
    )
    scenario = replace(load("merge"), warmup=0.0, duration=8.0, mission=Mission(kind="none"))
    episode = Episode(scenario, simulator, COMPACT)
    recorder = Recorder()
    run_episode(episode, Idm(), 7, svo=0.0, hooks=[recorder])
    case = {"scenario": "merge", "behavior": "mixed", "seed": 7, "road": out.add_road(simulator.road)}
    write(out.episode_file("cell-7"), recorder, case)
    out.write_manifest({"cells": {"cell": {}}, "seeds": [7], "commands": []})
    return path


def opened(folder: Path) -> tuple[Recording, RoadMap]:
    recording = read(Folder(folder).episode_file("cell-7"))
    return recording, Folder(folder).road(recording)


def test_the_maps_that_followed_are_those_that_were_seen_later(folder: Path) -> None:
    recording, road = opened(folder)
    later = {
        frame: {name: h.velocity_map.copy() for name, h in seen.items()}
        for frame, seen in histories(recording, road, COMPACT)
    }
    found: list[Followed] = list(followed(recording, road, COMPACT, 3))
    assert len(found) >= 3
    for now in found:
        assert len(now.future) == HORIZON
        assert now.maps["av"].shape == (HORIZON, 4, 32, 128)
        for ahead in (2, 10, 20):
            np.testing.assert_array_equal(now.maps["av"][ahead - 1], later[now.frame + ahead]["av"][-1])
            np.testing.assert_array_equal(now.maps["av"][ahead - 2], later[now.frame + ahead]["av"][-2])
        np.testing.assert_array_equal(now.histories["av"].velocity_map, later[now.frame]["av"])
    assert "leaver" in found[0].histories
    assert not any("leaver" in now.maps for now in found[1:]), "it leaves within the horizon"
    frames = [now.frame for now in found]
    assert set(np.diff(frames)) == {6}, "every third decision, two frames each"


def test_without_maps_none_are_drawn(folder: Path) -> None:
    recording, road = opened(folder)
    found = list(followed(recording, road, MAPLESS, 5))
    assert found
    assert not any(now.maps for now in found)


def test_map_errors_are_measured_against_what_followed(folder: Path, tmp_path: Path) -> None:
    weights = tmp_path / "hpn.safetensors"
    trained.save(weights, "hpn", HPN(HpnConfig()), {}, {})
    (episode,) = [map_bench.MapMeter({"hpn": str(weights)}, 3).run(str(folder), "cell-7")]
    assert episode is not None
    assert set(episode.iou) == {"last-frame", "gp-raster", "hpn"}
    assert (episode.iou["gp-raster"] > 0.8).all(), "everybody drives on at constant speed"
    assert (episode.iou["hpn"] > 0.8).all()
    assert episode.iou["last-frame"][-1] < 0.7, "the human driver falls behind"
    assert episode.pre["last-frame"][-1] > episode.pre["hpn"][-1]
    table = map_bench.rows([episode])
    assert {row["scenario"] for row in table} == {"merge", "all"}
    assert {row["horizon_s"] for row in table} == {0.2, 0.4, 1.0, 2.0, 3.0, 4.0}
    write_csv(tmp_path / "map_error.csv", table)
    head = (tmp_path / "map_error.csv").read_text().splitlines()[0]
    assert head.startswith("predictor,scenario,horizon_s,pre,")
    compared = map_bench.against([episode, episode])
    (still,) = [r for r in compared if (r["scenario"], r["against"]) == ("merge", "last-frame")]
    assert still["pre_change"] < 0.0 < still["iou_change"]
    assert still["everywhere"] is bool(
        (episode.pre["hpn"] < episode.pre["last-frame"]).all()
        and (episode.iou["hpn"] > episode.iou["last-frame"]).all()
    )
    said = map_bench.markdown(table, compared)
    assert "| hpn |" in said
    assert "| all | last-frame |" in said
    assert "| merge | gp-raster |" in said


def arguments(folder: Path, **changes: object) -> argparse.Namespace:
    given = {
        "config": "smoke",
        "variant": "hpn",
        "seed": None,
        "recordings": [str(folder)],
        "validation": [str(folder)],
        "out": str(folder / "run"),
        "workers": 1,
        "threads": 1,
        "device": "cpu",
        "resume": False,
        "reward": None,
        "metric": [],
        "errors": None,
        "iterations": None,
        "scenario": [],
    }
    return argparse.Namespace(**(given | changes))


def test_training_refuses_recordings_of_the_wrong_seeds_before_it_reads_one(folder: Path) -> None:
    with pytest.raises(BadInput, match=r"seeds 100000 to 199999 are needed, not 7 \("):
        train_hpn.train(arguments(folder))
    with pytest.raises(BadInput, match="recordings to train"):
        train_hpn.train(arguments(folder, recordings=[]))
    with pytest.raises(BadInput, match="not a folder of recordings"):
        train_hpn.train(arguments(folder, recordings=[str(folder / "roads")]))
    assert not (folder / "run").exists(), "nothing is left behind"


def test_the_command_line_trains_no_hpn_on_recordings_of_the_wrong_seeds(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--recordings", str(folder), "--validation", str(folder), "--out", str(folder / "run")]
    assert main(["train", "hpn", *words]) == 2
    assert "seeds 100000 to 199999 are needed, not 7 (" in capsys.readouterr().err
    assert main(["train", "hpn", *words, "--errors", "stress"]) == 2
    assert "--errors='stress': does not apply to hpn" in capsys.readouterr().err


def test_examples_of_both_kinds_come_from_a_recording(folder: Path) -> None:
    training = trained.HpnTraining(stride=1)  # whole maps: every fifth decision
    moments = train_hpn.Gatherer("hpn", training).run(str(folder), "cell-7")
    blind = train_hpn.Gatherer("hpn-no-history", training).run(str(folder), "cell-7")
    samples = train_hpn.Gatherer("hpn-plain", training).run(str(folder), "cell-7")
    assert len(moments) == len(blind) >= 3
    assert len(samples) >= 1
    assert samples[0].unpacked().shape == (30, 4, 32, 128)  # type: ignore[union-attr]
    slowest = np.nanmin(moments[0].truth[:, 0, 2])  # type: ignore[union-attr]
    assert slowest < 15.0, "the human driver"
