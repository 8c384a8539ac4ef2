"""Training of the three compared HPNs: the shipped one, and two ablations of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from policy import checkpoint
from policy.networks.hpn import HPN, HpnConfig
from policy.networks.kinematic_branch import KinematicConfig
from policy.training.kinematics import KinematicTask, KinematicTraining
from policy.training.loop import Line, LoopConfig
from policy.training.map_branch import MapTask, MapTraining

VARIANTS: dict[str, HpnConfig] = {
    "hpn": HpnConfig(),
    "hpn-no-history": HpnConfig(kinematic=KinematicConfig(history=False)),  # P, figure 6
    "hpn-plain": HpnConfig(maps="plain"),  # P's figure 3 as written
}


@dataclass(frozen=True, slots=True)
class HpnTraining:
    """One training run. Defaults: one hour on a CPU core."""

    stride: int = 4  # decisions between two samples of an episode: consecutive ones are nearly equal
    updates: int = 6000
    batch: int = 16  # moments per update: about 600 vehicles

    @property
    def map_stride(self) -> int:
        """The stride for `hpn-plain`, whose samples are whole maps."""
        return 5 * self.stride

    def loop(self, variant: HpnConfig) -> LoopConfig:
        """The training length of a variant; an update of `hpn-plain` costs four times as much."""
        return LoopConfig.of(-(-self.updates // 3) if variant.maps == "plain" else self.updates)


def make_task(
    variant: HpnConfig,
    training: HpnTraining,
    seed: int,
    train: Sequence[Any],
    validation: Sequence[Any],
    device: str,
) -> KinematicTask | MapTask:
    """The training of a variant's branch on its examples (`policy.training.moments`)."""
    sets, updates = (train, validation), training.loop(variant).updates
    if variant.maps == "plain":
        maps = MapTraining(batch=training.batch, seed=seed)
        return MapTask(variant.map_branch, maps, updates, *sets, device)
    kinematics = KinematicTraining(batch=training.batch, seed=seed)
    return KinematicTask(variant.kinematic, kinematics, updates, *sets, device)


def assemble(name: str, task: KinematicTask | MapTask) -> HPN:
    """The complete HPN with the trained branch."""
    network = HPN(VARIANTS[name])
    branch = network.kinematic if isinstance(task, KinematicTask) else network.map_branch
    assert branch is not None
    branch.load_state_dict(task.network.state_dict())
    return network.eval()


def save(path: Path, name: str, network: HPN, last: Line, data: Mapping[str, Any]) -> None:
    """Weights and card; the card names the variant, its training data and the last validation losses."""
    measured = {k: round(v, 6) for k, v in last.items() if k.startswith("validation_")}
    checkpoint.save(path, {"hpn": network}, {"hpn": network.config}, {"variant": name, **measured}, data)


def load(path: Path) -> tuple[str, HPN]:
    """The variant's name and the trained HPN. Raises BadInput, WeightsMismatch."""
    card = checkpoint.read_card(path)
    name = str(card["measured"].get("variant"))
    if name not in VARIANTS:
        raise BadInput("these weights are no HPN's", file=path, field="variant", value=name)
    network = HPN(VARIANTS[name])
    checkpoint.load(path, {"hpn": network}, {"hpn": network.config})
    return name, network.eval()
