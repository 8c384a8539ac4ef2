"""Weights on disk: exact when they fit, refused with a clear sentence when they do not, never unpickled."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from cosim.errors import BadInput, WeightsMismatch
from policy.agents.approaches import compact
from policy.agents.prediction_aware import PredictionAware
from policy.checkpoint import load, read_card, save, sha256
from policy.networks.vfn import VFN, VfnConfig

CONFIG = VfnConfig(height=16, frames=10)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    torch.manual_seed(3)
    path = tmp_path / "vfn.safetensors"
    network = VFN(CONFIG)
    torch.nn.init.normal_(network.value.weight)
    save(path, {"vfn": network}, {"vfn": CONFIG}, measured={"crashed": 0.01}, data={"seeds": "0:100"})
    return path


def rewrite(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Another content under a card that vouches for it."""
    save_file(tensors, path)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = sha256(path)
    path.with_suffix(".json").write_text(json.dumps(card))


def test_what_was_saved_is_loaded_bit_by_bit_with_its_card(saved: Path) -> None:
    network = VFN(CONFIG)
    card = load(saved, {"vfn": network}, {"vfn": CONFIG})
    stored = load_file(saved)
    for name, value in network.state_dict().items():
        assert torch.equal(value, stored[f"vfn.{name}"])
    assert card["measured"] == {"crashed": 0.01}
    assert card["configs"]["vfn"]["frames"] == 10


def test_another_layout_is_refused_by_the_field_that_differs(saved: Path) -> None:
    other = VfnConfig(frames=10)
    with pytest.raises(WeightsMismatch, match=r"configs\.vfn.*differs in height"):
        load(saved, {"vfn": VFN(other)}, {"vfn": other})


def test_a_card_older_than_an_option_is_read_with_the_option_s_default(saved: Path) -> None:
    card = json.loads(saved.with_suffix(".json").read_text())
    del card["configs"]["vfn"]["dueling"], card["configs"]["vfn"]["features"]
    saved.with_suffix(".json").write_text(json.dumps(card))
    assert load(saved, {"vfn": VFN(CONFIG)}, {"vfn": CONFIG})["sha256"] == sha256(saved)
    other = replace(CONFIG, dueling=False)
    with pytest.raises(WeightsMismatch, match=r"differs in dueling"):
        load(saved, {"vfn": VFN(other)}, {"vfn": other})


def test_a_file_that_is_not_the_one_on_the_card_is_refused(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes()[:-1] + b"x")
    with pytest.raises(WeightsMismatch, match="SHA-256"):
        read_card(saved)


@pytest.mark.parametrize("fault", ["missing", "unknown", "shape", "nan", "type"])
def test_tensors_that_do_not_fit_are_refused_and_nothing_is_loaded(saved: Path, fault: str) -> None:
    tensors = load_file(saved)
    name = "vfn.joined.bias"
    if fault == "missing":
        del tensors[name]
    elif fault == "unknown":
        tensors["vfn.backdoor"] = torch.zeros(1)
    elif fault == "shape":
        tensors[name] = torch.zeros(7)
    elif fault == "nan":
        tensors[name][0] = float("nan")
    else:
        tensors[name] = tensors[name].to(torch.float64)
    rewrite(saved, tensors)
    network = VFN(CONFIG)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with pytest.raises(WeightsMismatch, match=r"vfn\.safetensors"):
        load(saved, {"vfn": network}, {"vfn": CONFIG})
    for key, value in network.state_dict().items():
        assert torch.equal(value, before[key])


def test_a_pickle_is_never_opened(saved: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, ...]:
            return (pytest.fail, ("unpickled!",))

    saved.write_bytes(pickle.dumps(Bomb()))
    card = json.loads(saved.with_suffix(".json").read_text())
    card["sha256"] = sha256(saved)
    saved.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(WeightsMismatch, match="not a safetensors file"):
        load(saved, {"vfn": VFN(CONFIG)}, {"vfn": CONFIG})


def test_missing_and_broken_cards_are_bad_input(saved: Path) -> None:
    card = saved.with_suffix(".json")
    card.write_text("{")
    with pytest.raises(BadInput, match="JSON"):
        read_card(saved)
    card.write_text("{}")
    with pytest.raises(WeightsMismatch, match="format"):
        read_card(saved)
    card.unlink()
    with pytest.raises(BadInput, match=r"vfn\.json: missing"):
        read_card(saved)


def test_an_agent_with_weights_is_no_longer_called_untrained(tmp_path: Path) -> None:
    import dataclasses

    config = dataclasses.replace(compact("vfn"), vfn_weights=None)
    untrained = PredictionAware("vfn", config)
    assert untrained.label == "untrained"
    path = tmp_path / "agent.safetensors"
    save(path, {"vfn": untrained.vfn}, {"vfn": config.vfn})
    trained = PredictionAware("vfn", dataclasses.replace(config, vfn_weights=path))
    assert trained.label == ""
