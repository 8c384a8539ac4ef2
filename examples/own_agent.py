"""A function of one AV's observation: the AV keeps its distance and yields to the mission vehicle.

python examples/own_agent.py                               # a session in your own loop
cosim run merge --policy examples/own_agent.py:my_agent    # or as a policy of cosim's commands
"""

import cosim
from cosim.types import KINEMATIC_FEATURES, Bools, Floats32, MetaAction

X, Y, SPEED, MISSION = (KINEMATIC_FEATURES.index(name) for name in ("x", "y", "speed", "is_mission"))


def my_agent(seen: cosim.View) -> MetaAction:
    """The action of one AV."""
    return keep_distance(seen.kinematics[-1], seen.valid[-1])


def keep_distance(rows: Floats32, valid: Bools) -> MetaAction:
    """Fall back from a close vehicle ahead in the ego's lane, or from the mission vehicle beside that lane.

    rows [R,F]: the newest frame, the ego first; valid [R]: whether a row has a vehicle.
    """
    own, others = float(rows[0, SPEED]), rows[1:][valid[1:]]
    reach = 2 + 4 * (others[:, MISSION] > 0)  # m to either side
    near = (others[:, X] > 0) & (abs(others[:, Y]) < reach)
    if not near.any():
        return MetaAction.ACCELERATE
    x, speed = min(others[near][:, (X, SPEED)].tolist())
    gap = x - 5 + 2 * (speed - own)  # m, bumper to bumper, 2 s from now
    if gap < own + 2:
        return MetaAction.DECELERATE
    return MetaAction.ACCELERATE if gap > 1.5 * own + 10 else MetaAction.IDLE


def main() -> None:
    with cosim.open("merge", demand="contested", svo=45) as session:
        drive(session)


def drive(session: cosim.Session) -> None:
    """One episode, decision by decision, and its figures."""
    views, reward = session.reset(seed=7), 0.0
    while not session.over:
        step = session.act({av: my_agent(seen) for av, seen in views.items()})
        views, reward = step.observations, reward + sum(step.rewards.values())
    figures = session.result("my-agent").metrics
    print(f"sum of SVO rewards {reward:.1f}")
    for name in ("crashed", "mission_success", "dt_mean_m", "dt_mission_m", "min_ttc_s"):
        print(f"{name:<16} {figures[name].value} {figures[name].unit}")


if __name__ == "__main__":  # the simulation's own process must not run this
    main()
