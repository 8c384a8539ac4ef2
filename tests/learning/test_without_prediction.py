"""A network that is shown the present in place of predictions, and the same without predicted frames."""

from dataclasses import replace

import pytest
import torch

from benchmarks.without_prediction import shown_the_present, with_predicted_frames, without_predicted_frames
from policy.networks.vfn import VFN, VfnConfig

CONFIG = VfnConfig(frames=14, extractor="frames", others=False, parts=2)


@pytest.mark.parametrize("meets", [False, True])
def test_the_predicted_frames_are_folded_into_the_present(meets: bool) -> None:
    """Same values, whatever is predicted; and of another past other values."""
    torch.manual_seed(0)
    network = VFN(replace(CONFIG, meets=meets)).eval()
    for part in [network, *([] if network.met is None else [network.met])]:
        torch.nn.init.normal_(part.value.weight)
    maps = torch.randn(3, 14, CONFIG.latent)
    rest = torch.zeros(3, 14, 16, 9), torch.randn(3, 64).round(), torch.randn(3, 2)
    foreseeing = network(maps, *rest)
    own, config = without_predicted_frames(network, past=10)
    assert config.frames == 10
    shown_the_present(network, past=10)
    torch.testing.assert_close(network(maps, *rest), own(maps[:, :10], *rest))
    assert not torch.allclose(network(maps, *rest), foreseeing)
    other = torch.cat([maps[:, :9], torch.randn(3, 5, CONFIG.latent)], 1)
    assert not torch.allclose(network(other, *rest), own(maps[:, :10], *rest))


def test_one_without_predicted_frames_values_alike_in_the_wider_layout() -> None:
    torch.manual_seed(0)
    wide = replace(CONFIG, meets=True)
    own = VFN(replace(wide, frames=10)).eval()
    for part in (own, own.met):
        assert part is not None
        torch.nn.init.normal_(part.value.weight)
    made = with_predicted_frames(own, wide)
    maps = torch.randn(3, 14, CONFIG.latent)
    rest = torch.zeros(3, 14, 16, 9), torch.randn(3, 64).round(), torch.randn(3, 2)
    torch.testing.assert_close(made(maps, *rest), own(maps[:, :10], *rest))
    back, config = without_predicted_frames(made, past=10)
    assert config == own.config
    assert all(torch.equal(back.state_dict()[name], value) for name, value in own.state_dict().items())
