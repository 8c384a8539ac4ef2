"""One thread and deterministic kernels for torch, if a policy imported it (figures.md, Reproducibility)."""

import sys


def make_torch_deterministic() -> None:
    """Call it after the policy is constructed; cosim itself never imports torch."""
    torch = sys.modules.get("torch")
    if torch is None:
        return
    torch.set_num_threads(1)
    torch.set_deterministic_debug_mode("error")  # use_deterministic_algorithms would import the compiler
    torch.utils.deterministic.fill_uninitialized_memory = False  # costs 6 ms a decision, changes nothing
