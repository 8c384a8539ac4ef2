"""AVs keep their distance and let the mission vehicle in, by a function of what one of them sees.

python examples/own_agent.py                          # a session, driven by your own loop
cosim run merge --policy examples/own_agent.py:my_agent    # or by everything that cosim has
"""

import cosim
from cosim.types import KINEMATIC_FEATURES, Bools, Floats32, MetaAction

X, Y, SPEED, MISSION = (KINEMATIC_FEATURES.index(name) for name in ("x", "y", "speed", "is_mission"))


def my_agent(seen: cosim.View) -> MetaAction:
    """What one AV does."""
    return keep_distance(seen.kinematics[-1], seen.valid[-1])


def keep_distance(rows: Floats32, valid: Bools) -> MetaAction:
    """Fall back from the vehicle close ahead in my lane; the mission vehicle counts beside it as well.

    rows [R,F]: the newest frame, myself first; valid [R]: which rows hold a vehicle.
    """
    mine, others = float(rows[0, SPEED]), rows[1:][valid[1:]]
    reach = 2 + 4 * (others[:, MISSION] > 0)  # m to either side
    near = (others[:, X] > 0) & (abs(others[:, Y]) < reach)
    if not near.any():
        return MetaAction.ACCELERATE
    x, speed = min(others[near][:, (X, SPEED)].tolist())
    gap = x - 5 + 2 * (speed - mine)  # m, bumper to bumper, 2 s from now
    if gap < mine + 2:
        return MetaAction.DECELERATE
    return MetaAction.ACCELERATE if gap > 1.5 * mine + 10 else MetaAction.IDLE


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


if __name__ == "__main__":  # the simulation starts in a process of its own: it must not run this again
    main()
