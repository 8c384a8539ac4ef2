"""The approaches of Table III as configurations of one agent: what each network sees, and what masks it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from cosim.errors import BadInput
from cosim.files.yaml_input import dataclass_from
from cosim.types import COMPACT, PAPER, ObservationConfig
from policy.agents import APPROACHES as APPROACHES
from policy.chain.chain import ChainConfig
from policy.checkpoint import SHIPPED, read_card
from policy.inputs.tensors import PLANE_CHANNELS
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import TABLE_1, VfnConfig
from policy.prediction.traffic import TrafficConfig
from policy.safety import SafetyConfig

# extractor with a frozen encoder in place of convolutions: Conv3D reads all frames, Conv2D the newest one
ENCODED: Mapping[str, Literal["frames", "frame"]] = {"conv3d": "frames", "conv2d": "frame"}


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """The configuration of one agent. Defaults: compact size, `vfn-p`."""

    observation: ObservationConfig = COMPACT
    predicted_maps: bool = True  # False: the VFN sees the history only (Table III, `vfn`)
    mask: bool = True  # False: no safety prioritizer, the action of highest value is taken
    predictor: str = "gp-indirect"  # of the mask and of the chain's kinematics; `hold` for `vfn`
    chain: ChainConfig = field(default_factory=ChainConfig)
    hpn: HpnConfig = field(default_factory=HpnConfig)
    vfn: VfnConfig = field(default_factory=VfnConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    init_seed: int = 0  # seed of untrained weights, the same in every process
    bf16: bool = False  # autocast; off, because its results depend on the processor
    vfn_weights: Path | None = None  # a checkpoint of policy.checkpoint; None: untrained
    hpn_weights: Path | None = None
    note: str = ""  # part of the label


def compact(name: str) -> AgentConfig:
    """The compact configuration of an approach with its shipped weights. The card of the weights gives the
    layout of the network and the drawing of predicted maps."""
    weights = shipped(name)
    if weights is None:
        config = configure(name, COMPACT, ChainConfig(), HpnConfig(), VfnConfig())
    else:
        card, file = read_card(weights), weights.with_suffix(".json")
        config = configure(name, COMPACT, chain_of(card, file), HpnConfig(), vfn_of(card, file))
        config = replace(config, predictor=predictor_of(card, config))
    return replace(config, vfn_weights=weights, hpn_weights=shipped("hpn"))


def paper(name: str) -> AgentConfig:
    """The paper-size configuration: 64 x 512, one frame a step, M = 20, T's Table 1 read literally."""
    config = configure(name, PAPER, ChainConfig(every=1), HpnConfig(), TABLE_1)
    return replace(config, hpn_weights=shipped("hpn"))  # inputs are vehicles, not pixels: fits all sizes


def configure(
    name: str, observation: ObservationConfig, chain: ChainConfig, hpn: HpnConfig, vfn: VfnConfig
) -> AgentConfig:
    """The approach `name` at any map size; the VFN's inputs follow from both.

    Raises BadInput for an unknown approach, or for map channels that its network cannot read.
    """
    if name not in APPROACHES:
        raise BadInput(f"no such approach ({', '.join(APPROACHES)})", field="policy", value=name)
    approach = APPROACHES[name]
    encoded = vfn.encoded
    if (encoded or not approach.kinematics) and observation.channels != PLANE_CHANNELS:
        how = "with an encoder reads" if encoded else "sees maps alone and reads"
        problem = f"{name} {how} the channels {', '.join(PLANE_CHANNELS)}"
        raise BadInput(problem, field="observation.channels", value=", ".join(observation.channels))
    return AgentConfig(
        observation=observation,
        predicted_maps=approach.predicted_maps,
        mask=approach.mask != "none",
        predictor="cs" if approach.mask == "none" else approach.mask,
        chain=chain,
        hpn=hpn,
        vfn=replace(
            vfn,
            height=observation.height,
            width=observation.width,
            channels=len(observation.channels),
            frames=observation.frames + (chain.hypotheses if approach.predicted_maps else 0),
            rows=observation.rows,
            extractor=ENCODED[approach.extractor] if encoded else approach.extractor,
            kinematic=vfn.kinematic if approach.kinematics else 0,
            dueling=vfn.dueling and approach.learning != "a2c",
            parts=1 if approach.learning == "a2c" else vfn.parts,
            critic=approach.learning == "a2c",
        ),
    )


def vfn_of(card: Mapping[str, Any], file: Path) -> VfnConfig:
    """The layout of the value network described by the card `file`. Raises BadInput naming file and field."""
    return dataclass_from(VfnConfig, card["configs"].get("vfn", {}), file, "configs.vfn")


def chain_of(card: Mapping[str, Any], file: Path) -> ChainConfig:
    """The prediction of maps during training of the network. Raises BadInput as `vfn_of`."""
    return dataclass_from(ChainConfig, card["data"].get("chain", {}), file, "data.chain")


def predictor_of(card: Mapping[str, Any], config: AgentConfig) -> str:
    """The predictor behind the safety mask during training of the network."""
    return str(card["data"].get("predictor", config.predictor))


def shipped(name: str) -> Path | None:
    """The weights in the package; None if the package has none."""
    path = SHIPPED / f"{name}.safetensors"
    return path if path.is_file() else None
