"""What a short command does not load: the causes of a slow start, not its seconds."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("numba", "libsumo", "torch", "matplotlib", "scipy.linalg", "pyarrow", "sqlalchemy")

PARENT = """
import sys
from cosim.cli import main, run

class Nobody:  # instead of a process
    def __init__(self, *_, **__): pass
    def kill(self): pass
    def close(self): pass
    def call(self, *_, **__): raise KeyboardInterrupt

run.Worker = Nobody
assert main.main(["run", "merge", "--policy", sys.argv[1]]) == 130
print(*sys.modules)
"""

WORKER = """
import sys
from cosim.cli.run import Driver
from cosim.workers.determinism import make_torch_deterministic

Driver(sys.argv[1])
make_torch_deterministic()
print(*sys.modules)
"""


def loaded(code: str, policy: str) -> set[str]:
    """The modules that a fresh process has loaded in the end."""
    done = subprocess.run(
        [sys.executable, "-c", code, policy], capture_output=True, text=True, check=True, timeout=120
    )
    return set(done.stdout.split())


def test_the_process_that_the_user_started_loads_neither_simulator_nor_networks() -> None:
    for policy in ("idm", "vfn-p"):
        assert loaded(PARENT, policy).isdisjoint(HEAVY), policy


def test_the_process_that_simulates_loads_torch_for_networks_only_and_never_its_compiler() -> None:
    rule, network = loaded(WORKER, "idm"), loaded(WORKER, "vfn-p")
    assert rule.isdisjoint({"torch", "scipy.linalg", "matplotlib", "sqlalchemy"})
    assert {"libsumo", "numba"} <= rule, "loaded before the scenario is known"
    assert "torch" in network
    assert network.isdisjoint({"torch._dynamo", "torch._inductor", "scipy.linalg", "matplotlib"})


def test_one_verb_does_not_load_the_others() -> None:
    modules = loaded(
        "import sys; from cosim.cli.main import parser; parser('doctor'); print(*sys.modules)", ""
    )
    assert "cosim.cli.doctor" in modules
    assert "cosim.cli.run" not in modules
