"""A trained agent, rebuilt from its weights and their card."""

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from cosim.errors import BadInput
from cosim.files.yaml_input import dataclass_from
from cosim.scenario.policy_name import PolicyName
from cosim.types import ObservationConfig, Policy
from policy.agents import altruist
from policy.agents.approaches import (
    APPROACHES,
    AgentConfig,
    chain_of,
    configure,
    predictor_of,
    shipped,
    vfn_of,
)
from policy.agents.prediction_aware import PredictionAware
from policy.checkpoint import read_card, sha256
from policy.networks.hpn import HpnConfig
from policy.prediction.traffic import TrafficConfig
from policy.safety import SafetyConfig

OTHER_HPN = "trained with another HPN"
Section = TypeVar("Section")


def trained(name: PolicyName) -> Policy:
    """`altruist`, or the approach at its training sizes with the shipped HPN and predictors.

    Raises BadInput (WeightsMismatch is one) when the card or the weights do not fit.
    """
    weights = Path(name.place)
    if read_card(weights)["data"].get("policy") != altruist.NAME:
        return PredictionAware(name.label, config(weights))
    agent = altruist.read(weights)
    agent.name = name.label
    return agent


def check(weights: Path) -> None:
    """Raises BadInput as `trained`, for the card."""
    if read_card(weights)["data"].get("policy") != altruist.NAME:
        config(weights)


def config(weights: Path) -> AgentConfig:
    """The agent's configuration from the card of `weights`. Raises BadInput naming card and field."""
    card, file = read_card(weights), weights.with_suffix(".json")
    about: dict[str, Any] = card["data"]
    approach = about.get("policy")
    if approach not in APPROACHES or "vfn" not in card["configs"]:
        raise BadInput("not the card of a value network", file=file, field="data.policy", value=approach)

    def section(kind: type[Section], name: str) -> Section:
        return dataclass_from(kind, about.get(name, {}), file, f"data.{name}")

    vfn = vfn_of(card, file)
    hpn = shipped("hpn")
    other = hpn is not None and about.get("hpn_sha256", sha256(hpn)) != sha256(hpn)
    agent = configure(
        approach,
        section(ObservationConfig, "observation"),
        chain_of(card, file),
        section(HpnConfig, "hpn"),
        vfn,
    )
    return replace(
        agent,
        predictor=predictor_of(card, agent),
        safety=section(SafetyConfig, "safety"),
        traffic=section(TrafficConfig, "traffic"),
        vfn_weights=weights,
        hpn_weights=hpn,
        note=OTHER_HPN if other else "",
    )
