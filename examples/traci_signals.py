"""Your own signal control, written with traci only: ends an unused green if vehicles wait at a red.

cosim run CITY.sumocfg --penetration 0.3 --policy vfn-p --traci-port 8813 &
python examples/traci_signals.py 8813
"""

import sys

import traci


def waits(light: str, wanted: str) -> bool:
    """Whether a vehicle is on a lane whose signal shows one of the states `wanted`."""
    states = traci.trafficlight.getRedYellowGreenState(light)
    lanes = traci.trafficlight.getControlledLanes(light)
    return any(
        traci.lane.getLastStepVehicleNumber(lane)
        for lane, state in zip(lanes, states, strict=True)
        if state in wanted
    )


def switch(light: str) -> None:
    """End the present phase if no vehicle uses its green and a vehicle waits at its red."""
    green = "y" not in traci.trafficlight.getRedYellowGreenState(light).lower()
    if green and waits(light, "r") and not waits(light, "Gg"):
        traci.trafficlight.setPhaseDuration(light, 0.0)


def main() -> None:
    """Step with SUMO until its end time, if it has one, or until it ends."""
    traci.init(int(sys.argv[1]), numRetries=60)
    traci.setOrder(1)
    lights, end = traci.trafficlight.getIDList(), traci.simulation.getEndTime()
    try:
        while end < 0.0 or traci.simulation.getTime() < end:
            traci.simulationStep()
            for light in lights:
                switch(light)
        traci.close()
    except traci.exceptions.FatalTraCIError:
        print("SUMO has ended")


if __name__ == "__main__":
    main()
