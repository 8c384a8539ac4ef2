"""Your own simulation, written with traci only; cosim's agents join and drive a share of the vehicles.

python examples/traci_owner.py CITY.sumocfg 8813 &
cosim join localhost:8813 --penetration 0.3 --policy vfn-p
"""

import sys

import traci

from sumo_scenarios import TYPES  # the vehicle types of AVs; or put the file into your .sumocfg

DURATION = 120.0  # s


def main() -> None:
    """Start SUMO for two clients, and drive."""
    options = ["--num-clients", "2", "--step-length", "0.1", "--lanechange.duration", "2"]
    options += ["--collision.action", "warn", "--collision.mingap-factor", "0", "--no-step-log"]
    options += ["--collision.check-junctions", "--additional-files", str(TYPES)]
    traci.start(["sumo", "-c", sys.argv[1], *options], port=int(sys.argv[2]))  # waits for the other client
    traci.setOrder(1)
    most = 0
    while traci.simulation.getTime() < DURATION:
        traci.simulationStep()
        kinds = [traci.vehicle.getTypeID(vehicle) for vehicle in traci.vehicle.getIDList()]
        most = max(most, sum("cosim.av." in kind for kind in kinds))
    traci.close()
    print(f"{DURATION:g} s driven, at most {most} AVs at once")


if __name__ == "__main__":
    main()
