"""Configurations of a training: shipped ones, one's own, and those that change another one."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from cosim.errors import BadInput
from cosim.learning.configuration import configuration
from cosim.learning.train_vfn import chosen_reward
from cosim.rewards import RewardConfig
from cosim.types import COMPACT
from policy.agents.approaches import configure
from policy.chain.chain import ChainConfig
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import VfnConfig
from policy.training.config import TrainingFile


def written(folder: Path, name: str, text: str) -> str:
    file = folder / f"{name}.yaml"
    file.write_text(text)
    return str(file)


@pytest.mark.parametrize("name", ["paper", "papers", "smoke"])
def test_what_ships_can_be_read_and_written_whole(name: str, tmp_path: Path) -> None:
    found = configuration(name)
    whole = written(tmp_path, "whole", yaml.safe_dump(found.values))
    assert configuration(whole).file == found.file != TrainingFile()


def test_a_file_changes_only_what_it_says_of_its_base(tmp_path: Path) -> None:
    written(tmp_path, "mine", "base: papers\nexplore: {learners: 7}\ntraining: {batch: 16}")
    found = configuration(
        written(tmp_path, "again", "base: mine.yaml\ntraining: {iterations: 9, svo: [45]}")
    ).file
    papers = configuration("papers").file
    training = replace(papers.training, iterations=9, svo=(45.0,), batch=16)
    assert found == replace(papers, explore=replace(papers.explore, learners=7), training=training)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "base: paperz",
            "mine.yaml: base='paperz': no such file, and no shipped configuration of this name, did",
        ),
        ("base: [papers]", "mine.yaml: base=['papers']: the name of a configuration"),
        ("base: other.yaml", "other.yaml: base='mine.yaml': is its own base"),
        ("base: broken.yaml", "broken.yaml: training.iteration=3: unknown field"),
        (
            "base: papers\ntraining: {interaction: 1.9}",
            "interaction=1.9: must be a share",
        ),
        ("training: {learning_rate: -1}", "training.learning_rate=-1.0: must be above 0"),
        (
            "observation: compct",
            "observation='compct': must be one of compact, paper, smoke, did you mean 'compact'",
        ),
        ("safety: {critical_th: -3}", "safety.critical_th=-3.0: must be 0 or more"),
        ("svo: 1\nsvo: 2", "mine.yaml: line=2: not YAML: 'svo' appears twice in this mapping"),
        ("base: papers\ntraining: 3", "mine.yaml: training=3: a mapping is needed"),
    ],
)
def test_a_wrong_base_is_named_with_its_file(tmp_path: Path, text: str, said: str) -> None:
    written(tmp_path, "other", "base: mine.yaml")
    written(tmp_path, "broken", "training: {iteration: 3}")
    with pytest.raises(BadInput) as refused:
        configuration(written(tmp_path, "mine", text))
    assert said in str(refused.value)


def test_a_network_of_maps_alone_refuses_channels_that_it_cannot_read() -> None:
    seen, sizes = replace(COMPACT, channels=("av", "hv", "road")), (ChainConfig(), HpnConfig(), VfnConfig())
    assert configure("vfn-p", seen, *sizes).vfn.channels == 3
    with pytest.raises(BadInput, match=r"observation\.channels='av, hv, road': conv2d-dqn sees maps alone"):
        configure("conv2d-dqn", seen, *sizes)


def test_a_training_has_at_most_sixty_fields() -> None:
    def count(kind: type) -> int:
        kinds = typing.get_type_hints(kind)
        return sum(
            count(kinds[field.name]) if dataclasses.is_dataclass(kinds[field.name]) else 1
            for field in dataclasses.fields(kind)  # type: ignore[arg-type]
        )

    assert 50 < count(TrainingFile) <= 60


def test_a_named_reward_has_the_weights_of_the_configuration() -> None:
    weights = RewardConfig(mission=200.0, social=0.02)
    assert chosen_reward("t", weights) == replace(weights, variant="t")
    assert chosen_reward("", weights) == weights
    assert chosen_reward("mine.py:Reward", weights) == "mine.py:Reward"
