"""One thread, deterministic kernels for whatever torch a policy brought (figures.md, Reproducibility)."""

import sys


def make_torch_deterministic() -> None:
    """Call after construction of the policy; without torch (which cosim never imports) it does nothing."""
    torch = sys.modules.get("torch")
    if torch is None:
        return
    torch.set_num_threads(1)
    torch.set_deterministic_debug_mode("error")  # use_deterministic_algorithms would import the compiler
    torch.utils.deterministic.fill_uninitialized_memory = False  # costs 6 ms a decision, changes nothing
