"""The hybrid predictive network (P, figure 3): the next seconds as maps and as kinematics, from two branches.

Three variants of the maps (measured in docs/results/prediction_maps.md):
- `rendered` (shipped): the kinematic branch corrects every vehicle's forecast, and the rasteriser of the
  observed maps draws the predicted maps. Vehicles stay sharp, and no step of the chain blurs the next.
- `corrected`: P's convolutional map branch reads those maps and predicts a correction, block after block.
- `plain`: P's map branch alone, as written. Trained with the mean squared error it predicts empty maps.
"""

from dataclasses import dataclass, field
from typing import Literal

from torch import nn

from policy.networks.kinematic_branch import KinematicBranch, KinematicConfig
from policy.networks.map_branch import MapBranch, MapBranchConfig


@dataclass(frozen=True, slots=True)
class HpnConfig:
    """The variant and the layouts of its branches."""

    maps: Literal["rendered", "corrected", "plain"] = "rendered"
    kinematic: KinematicConfig = field(default_factory=KinematicConfig)  # not in `plain`
    map_branch: MapBranchConfig = field(default_factory=MapBranchConfig)  # not in `rendered`


class HPN(nn.Module):
    """The branches of the configured variant; `policy.chain.chain.predict` runs them (P, fig. 3).

    Untrained, `rendered` and `corrected` return the maps rendered from the forecast along the lanes.

    Args:
        config: the variant and the layouts of its branches.

    Raises:
        ValueError: `map_branch.correct` contradicts `maps`.
    """

    kinematic: KinematicBranch | None
    map_branch: MapBranch | None

    def __init__(self, config: HpnConfig) -> None:
        super().__init__()
        self.config = config
        self.kinematic = None if config.maps == "plain" else KinematicBranch(config.kinematic)
        if config.maps != "rendered" and config.map_branch.correct != (config.maps == "corrected"):
            raise ValueError("a map branch corrects rendered maps exactly when `maps` says so")
        self.map_branch = None if config.maps == "rendered" else MapBranch(config.map_branch)
