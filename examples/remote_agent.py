"""The agent of own_agent.py, with the simulation on a server: only the first line of the session differs.

cosim serve &
python examples/remote_agent.py [http://127.0.0.1:8000]
"""

import sys

from own_agent import my_agent

from cosim.service import client


def main(url: str) -> None:
    with client.open(url, "merge", demand="contested", svo=45) as session:
        views, reward = session.reset(seed=7), 0.0
        while not session.over:
            step = session.act({av: my_agent(seen) for av, seen in views.items()})
            views, reward = step.observations, reward + sum(step.rewards.values())
        figures = session.result("my-agent").metrics
    print(f"sum of SVO rewards {reward:.1f}")
    for name in ("crashed", "mission_success", "dt_mean_m", "dt_mission_m", "min_ttc_s"):
        print(f"{name:<16} {figures[name].value} {figures[name].unit}")


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["http://127.0.0.1:8000"]))
