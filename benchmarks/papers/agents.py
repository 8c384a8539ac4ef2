"""Who drives: the policies by name, and learned ones with other weights, another mask or other senses."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from benchmarks.unled import Unled
from cosim.errors import BadInput
from cosim.types import Policy, PolicyContext
from policy import checkpoint
from policy.agents import APPROACHES, make
from policy.agents.approaches import AgentConfig, compact, shipped, vfn_of
from policy.agents.prediction_aware import PredictionAware
from policy.checkpoint import sha256
from policy.networks.vfn import VFN, VfnConfig

PERCEPTION = 125.0  # m, what an AV's own sensors reach
# options that shipped episodes do not name: their defaults are what was done without them
NEWER = {
    "chain": ("shade",),
    "observation": ("road_version", "signal_timing"),
    "safety": ("assisted",),
    "vfn": ("latent", "others", "parts", "most", "meets", "assisted"),
}


@dataclass(frozen=True, slots=True)
class Agent:
    """One way to drive all AVs. Defaults: as `--policy` has it."""

    name: str  # in rows, tables and pictures
    policy: str = ""  # of `--policy`; "": the name
    weights: str = ""  # file of the value network; "": the shipped one
    mask: Literal["", "none", "cs", "gp-indirect"] = ""  # of the prioritizer; "": the approach's own
    perception_range: float = PERCEPTION
    share_perception: bool = True  # V2V
    share_intentions: bool = True  # V2V
    led: bool = True  # by the network; False: every action is worth the same
    made_by: str = ""  # the command that makes the weights, where it is not the usual one

    @property
    def base(self) -> str:
        """The name of the policy."""
        return self.policy or self.name

    @property
    def learned(self) -> bool:
        """Whether it has networks."""
        return self.base in APPROACHES

    @property
    def command(self) -> str:
        """What makes its weights."""
        if self.made_by:
            return self.made_by
        return f"cosim train {self.base} --out runs/{self.base}"


def config(agent: Agent, untrained: bool = False) -> AgentConfig:
    """Its configuration at compact size; `untrained`: with the value network of initial weights."""
    c = compact(agent.base)
    if agent.weights:
        path = Path(agent.weights)
        c = replace(c, vfn_weights=path if path.is_file() else None)
        if path.is_file():
            c = replace(c, vfn=vfn_of(checkpoint.read_card(path), path))  # it may differ from what ships
    if untrained:
        c = replace(c, vfn_weights=None)
    if agent.mask == "none":
        c = replace(c, mask=False)  # the chain keeps its predictor
    elif agent.mask:
        c = replace(c, mask=True, predictor=agent.mask)
    seen = replace(
        c.observation, perception_range=agent.perception_range, share_perception=agent.share_perception
    )
    return replace(c, observation=seen)


def missing(agent: Agent) -> str | None:
    """Which weights are not there and what makes them, or do not fit; None when it can drive."""
    if not agent.learned or not agent.led:
        return None
    c = config(agent)
    if c.vfn_weights is None:
        file = agent.weights or f"policy/weights/{agent.base}.safetensors"
        return f"no weights {file}, made by `{agent.command}`"
    if c.predicted_maps and c.chain.source == "hpn" and c.hpn_weights is None:
        return "no weights policy/weights/hpn.safetensors, made by `cosim train hpn`"
    return _misfit(c.vfn_weights, c.vfn)


@cache
def _misfit(weights: Path, vfn: VfnConfig) -> str | None:
    """Why the value network's weights do not load; None when they do."""
    try:
        checkpoint.load(weights, {"vfn": VFN(vfn)}, {"vfn": vfn})
    except BadInput as error:
        return str(error)
    return None


def fingerprint(agent: Agent, untrained: bool = False) -> dict[str, Any]:
    """All that decides how it drives, weights by their hash: equal fingerprints drive alike."""
    if not agent.learned:
        return {"policy": agent.base}
    c = config(agent, untrained)
    needed = ("vfn", "hpn", "predictor") if agent.led else ("predictor",)
    weights = {name: sha256(path) for name in needed if (path := _file(c, name))}
    plain = json.loads(json.dumps(asdict(replace(c, vfn_weights=None, hpn_weights=None))))
    defaults = json.loads(json.dumps(asdict(AgentConfig())))
    for part, names in NEWER.items():
        given, usual = plain[part], defaults[part]
        plain[part] = {k: v for k, v in given.items() if k not in names or v != usual[k]}
    setting = {} if agent.led else {"led": False}
    return {"config": plain, "weights": weights, "v2v": agent.share_intentions, **setting}


def short(document: Any) -> str:
    """The first digits of a document's SHA-256."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]


def build(agent: Agent, untrained: bool = False) -> Policy:
    """A fresh policy under the agent's own name."""
    if not agent.learned:
        return make(agent.base)
    if not agent.led:
        return Unled(agent.name, config(agent, untrained), agent.share_intentions)
    kind = PredictionAware if agent.share_intentions else _WithoutIntentions
    return kind(agent.name, config(agent, untrained))


class _WithoutIntentions(PredictionAware):
    """Its AVs do not share their intentions."""

    def reset(self, context: PolicyContext) -> None:
        super().reset(replace(context, share_intentions=False))


def _file(c: AgentConfig, name: str) -> Path | None:
    files = {"vfn": c.vfn_weights, "hpn": c.hpn_weights, "predictor": shipped(c.predictor)}
    return files[name]
