"""One training run as one document: sizes, reward, exploration and schedule (policy/configs/*.yaml)."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from cosim.rewards import RewardConfig
from cosim.types import COMPACT, PAPER, SMOKE
from policy.agents.approaches import AgentConfig, configure, shipped
from policy.chain.chain import ChainConfig, Hypotheses
from policy.networks.frame_encoder import EncoderConfig
from policy.networks.hpn import HpnConfig
from policy.networks.vfn import Layout, VfnConfig
from policy.safety import SafetyConfig, Thresholds
from policy.training.curriculum import VfnTraining
from policy.training.explorer import ExploreConfig
from policy.training.hpn import HpnTraining
from policy.training.sight import SightTraining

SIZES = {"compact": COMPACT, "paper": PAPER, "smoke": SMOKE}  # of the maps


@dataclass(frozen=True, slots=True)
class TrainingFile:
    """The sections of a configuration file; missing sections keep the compact default."""

    observation: Literal["compact", "paper", "smoke"] = "compact"  # `SIZES`
    chain: Hypotheses = field(default_factory=Hypotheses)
    vfn: Layout = field(default_factory=Layout)
    safety: Thresholds = field(default_factory=Thresholds)
    reward: RewardConfig = field(default_factory=RewardConfig)
    explore: ExploreConfig = field(default_factory=ExploreConfig)
    training: VfnTraining = field(default_factory=VfnTraining)
    prediction: HpnTraining = field(default_factory=HpnTraining)  # cosim train hpn
    sight: SightTraining = field(default_factory=SightTraining)  # cosim train encoder


def agent_config(name: str, file: TrainingFile) -> AgentConfig:
    """The approach `name` at the sizes of `file`: its value network untrained, its HPN the shipped one."""
    seen, layout = SIZES[file.observation], VfnConfig(**asdict(file.vfn))
    config = configure(name, seen, ChainConfig(**asdict(file.chain)), HpnConfig(), layout)
    return replace(config, safety=SafetyConfig(**asdict(file.safety)), hpn_weights=shipped("hpn"))


def encoder_of(file: TrainingFile) -> EncoderConfig:
    """The frame encoder for the maps of `file`, with the latent size of its value network."""
    seen = SIZES[file.observation]
    return EncoderConfig(seen.height, seen.width)


def described(name: str, agent: AgentConfig, file: TrainingFile) -> dict[str, Any]:
    """The card's description of agent, rewards and exploration for the approach's weights."""
    parts = ("observation", "hpn", "chain", "safety", "traffic")
    about: dict[str, Any] = {part: asdict(getattr(agent, part)) for part in parts}
    about["predictor"] = agent.predictor
    return {"policy": name, **about, "reward": asdict(file.reward), "explore": asdict(file.explore)}
