"""A Ray cluster of two nodes on this machine, one killed in mid-run; prints {key: trace hash}.

`test_evaluate.py` runs it in a process of its own: python tests/sumo/ray_two_nodes.py FLAGS..., where FLAGS
are those of `cosim evaluate`.
"""

from __future__ import annotations

import json
import sys

from ray.cluster_utils import Cluster

from cosim.batch import matrix
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.spec import FIELDS, read
from cosim.cli.main import parser
from cosim.workers.ray_engine import RayEngine
from policy.agents import check_name


def main() -> None:
    args = parser().parse_args(["evaluate", *sys.argv[1:]])
    spec = read(None, {name: getattr(args, name) for name in FIELDS})
    plan = matrix.plan(matrix.cells(spec), range(*spec.seeds), check_name)
    tasks = [cell.task(case) for cell, case in plan.cases()]
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    doomed = cluster.add_node(num_cpus=1)
    hashes: dict[str, str] = {}
    begun: set[str] = set()
    for outcome in RayEngine(EpisodeRunner, workers=2, address=cluster.address).run(tasks):
        hashes[outcome.key] = outcome.value["trace_hash"] if outcome.ok else str(outcome.error)
        begun.add(outcome.key.partition("-")[0])
        if doomed is not None and len(begun) == 2:  # each node keeps to a cell: both are at work
            cluster.remove_node(doomed, allow_graceful=False)
            doomed = None
    cluster.shutdown()
    if doomed is not None:
        raise SystemExit("one node did all the work: nothing was tried")
    print(json.dumps(hashes))


if __name__ == "__main__":
    main()
