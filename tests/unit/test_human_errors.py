"""Errors as data: levels, users' files, draws, identities, and what comparisons say of them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sumo_scenarios
from cosim.errors import BadInput
from cosim.files import yaml_input
from cosim.report.pairing import Group
from cosim.scenario import load
from cosim.scenario.human_errors import KINDS, asked, levels, read
from cosim.scenario.manifest import manifest
from cosim.scenario.options import EpisodeOptions
from cosim.seeding import subseed, uniforms


def written(folder: Path, text: str, name: str = "mine.yaml") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_nobody_errs_unless_asked() -> None:
    assert read(None) is read("none") is asked("none") is load("merge").errors is None


@pytest.mark.parametrize("name", ["field", "stress"])
def test_levels_have_every_kind_and_say_where_their_rates_are_from(name: str) -> None:
    level = read(name)
    assert level is not None
    assert level.name == name
    for kind in KINDS:
        rates = getattr(level.kinds, kind)
        assert rates is not None
        assert rates.rate > 0.0
        assert len(rates.source) > 20


def test_a_level_differs_in_one_of_our_worlds_and_nowhere_else() -> None:
    everywhere, there = (levels(world)["stress"].kinds for world in ("merge", "highway"))
    assert there.inattention != everywhere.inattention
    assert there.hard_braking == everywhere.hard_braking
    driven = load("highway", errors="stress").errors
    assert driven == levels("highway")["stress"]
    assert driven != levels("merge")["stress"] == levels()["stress"]
    named = [name.split(".") for name in yaml_input.document(sumo_scenarios.ERRORS) if "." in name]
    assert named
    assert all(level in levels() and world in sumo_scenarios.names() for level, world in named)


def test_stress_has_higher_rates_than_field() -> None:
    field, stress = (levels()[name].kinds for name in ("field", "stress"))
    assert all(getattr(stress, kind).rate > getattr(field, kind).rate for kind in KINDS)


def test_a_users_file_is_a_level_of_its_own(tmp_path: Path) -> None:
    mine = read(written(tmp_path, "inattention: {rate: 0.01, duration: [1, 2]}"))
    assert mine is not None
    assert mine.name == f"mine-{mine.digest[:8]}"
    assert mine.kinds.inattention is not None
    assert mine.kinds.inattention.duration == (1.0, 2.0)
    assert mine.kinds.red_light is None


def test_the_digest_is_that_of_what_the_errors_do(tmp_path: Path) -> None:
    texts = [
        "inattention: {rate: 0.01}\nstalled_car: {rate: 0.1}",
        "stalled_car: {rate: 0.1, source: a book}\n# a remark\ninattention: {rate: 1.0e-2}",
        "inattention: {rate: 0.02}\nstalled_car: {rate: 0.1}",
    ]
    found = [read(written(tmp_path, text, f"{k}.yaml")) for k, text in enumerate(texts)]
    digests = [errors.digest for errors in found if errors is not None]
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("inatention: {rate: 0.1}", "inatention={'rate': 0.1}: unknown field, did you mean 'inattention'?"),
        ("inattention: {duration: [1, 2]}", "inattention.rate: is missing"),
        ("inattention: {rate: 2}", "inattention.rate=2: a number from 0 to 1 is needed"),
        ("inattention: {rate: 0.1, duration: [3, 1]}", "inattention.duration=[3.0, 1.0]: the first must not"),
        ("cut_in: {rate: 0.1, deceleration: [3]}", "cut_in.deceleration=[3]: a list of 2 values is needed"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    file = written(tmp_path, text)
    with pytest.raises(BadInput) as error:
        load("merge", errors=file)
    assert str(error.value).startswith(f"{file}: {said}")


def test_a_level_that_is_none_is_named_with_the_nearest() -> None:
    with pytest.raises(BadInput, match="--errors='sress': no such level, did you mean 'stress'"):
        load("merge", errors="sress")


def test_an_episode_without_errors_is_called_as_before() -> None:
    plain = EpisodeOptions("merge", seed=7)
    assert "errors" not in plain.document()
    assert EpisodeOptions("merge", seed=7, errors="stress").cell != plain.cell
    assert EpisodeOptions.read(EpisodeOptions("merge", seed=7, errors="field").document()).errors == "field"


def test_manifest_and_identity_name_the_errors(tmp_path: Path) -> None:
    file = written(tmp_path, "inattention: {rate: 0.01}")
    scenario = load("merge", errors=file)
    assert scenario.errors is not None
    document = manifest(scenario, 3)
    assert document["errors"] == {"name": scenario.errors.name, "sha256": scenario.errors.digest}
    assert "mine.yaml" in document["files"]
    assert scenario.identity("idm", None, 45.0, 3).errors == scenario.errors.name
    assert "errors" not in manifest(load("merge"), 3)


def test_draws_are_uniform_and_those_of_one_stream_do_not_repeat() -> None:
    streams = np.array([subseed(1, "error", "inattention", f"v{k}") for k in range(200)], np.uint64)
    drawn = np.array([uniforms(streams, second) for second in range(200)])
    assert 0.0 <= drawn.min() < drawn.max() < 1.0
    assert np.histogram(drawn, 10, (0.0, 1.0))[0] == pytest.approx(4_000, rel=0.08)
    assert len(np.unique(drawn)) == drawn.size
    assert abs(np.corrcoef(drawn[:-1].ravel(), drawn[1:].ravel())[0, 1]) < 0.02
    assert (uniforms(streams[:3], 7) == drawn[7, :3]).all(), "whoever else is on the road"


def row(*begun: list[Any]) -> dict[str, Any]:
    return {"human_error_list": json.dumps(begun), "status": "ok", "trace_hash": ""}


def test_comparisons_count_the_errors_that_began_in_both_runs() -> None:
    a = row(["cut_in", "h", 3.0], ["inattention", "h", 5.0])
    b = row(["cut_in", "h", 3.0], ["inattention", "h", 6.0], ["inattention", "i", 5.0])
    group = Group({}, {}, {}, [(a, b), (row(), row())], [], [], (0, 0))
    assert group.errors_begun == (2, 3, 1)


def test_old_rows_have_no_errors() -> None:
    assert Group({}, {}, {}, [({}, {"human_error_list": None})], [], [], (0, 0)).errors_begun == (0, 0, 0)


def test_the_file_that_ships_is_read_whole() -> None:
    assert set(levels()) == {"field", "stress"}
    assert all(errors.file == sumo_scenarios.ERRORS for errors in levels().values())
    assert asdict(levels()["stress"].kinds).keys() == set(KINDS)
