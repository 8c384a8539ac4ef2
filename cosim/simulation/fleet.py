"""Decides which vehicles are AVs and mission vehicles, and gives each departed vehicle its driver."""

import re
from collections.abc import Mapping

from cosim.scenario import Scenario
from cosim.scenario.behaviors import AS_IS
from cosim.scenario.vet_rules import NOT_CARS
from cosim.seeding import uniform
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import AV_TYPE
from cosim.simulation.convert import ACTORS, Body
from cosim.simulation.drivers import IDM_TYPE, Drivers
from cosim.types import Actor, Kind, Preset

# definitions.md, Vehicles: what an AV drives with while it has no command (egoistic IDM).
AV_IDM = {"Tau": 0.8, "MinGap": 2.0, "Accel": 3.0, "Decel": 7.0}
AV_LANE_CHANGE = {
    "laneChangeModel.lcCooperative": "0",
    "laneChangeModel.lcCooperativeSpeed": "0",
    "laneChangeModel.lcKeepRight": "0",
}
# What a vehicle keeps when its type changes: getters and setters of sumo.vehicle, in this order.
KEPT = ("Length", "Width", "MaxSpeed", "SpeedFactor", "VehicleClass")


class Fleet:
    """Decides for every vehicle that departs; the draws depend on (seed, id) only, never on the order."""

    def __init__(self, scenario: Scenario, drivers: Drivers, av_parameters: Mapping[str, str]) -> None:
        self._scenario = scenario
        self._drivers = drivers
        self._av_parameters = av_parameters
        self._av_types: dict[str, str] = {}  # a vehicle's own type -> the type of such an AV

    def depart(self, vehicle: str, seed: int) -> Body:
        """A vehicle departed: give it its driver; what it is."""
        get, s = sumo.vehicle, self._scenario
        mission = s.mission.includes(vehicle)
        is_av = not mission and self._is_av(vehicle, seed)
        if is_av:
            self._take_av_type(vehicle)
            for name, value in AV_IDM.items():
                getattr(get, f"set{name}")(vehicle, value)
            for key, text in {**AV_LANE_CHANGE, **self._av_parameters}.items():
                get.setParameter(vehicle, key, text)
        elif s.behavior != AS_IS:
            self._drivers.apply(vehicle)
        size = get.getLength(vehicle), get.getWidth(vehicle)
        actor = ACTORS.get(get.getVehicleClass(vehicle), Actor.CAR)
        return Body(Kind.AV if is_av else Kind.HV, mission, *size, actor)

    def _take_av_type(self, vehicle: str) -> None:
        """In our worlds an AV drives as its type says, one of a user's file by IDM."""
        own, ours = sumo.vehicle.getTypeID(vehicle), self._scenario.built_in
        name = self._av_types.get(own)
        if name is None:
            name = self._av_types[own] = AV_TYPE + own
            sumo.vehicletype.copy(own if ours else IDM_TYPE, name)
        if ours:
            sumo.vehicle.setType(vehicle, name)
        else:
            set_type(vehicle, name)
            mean = sumo.vehicletype.getSpeedFactor(own)  # not a draw about it
            sumo.vehicle.setSpeedFactor(vehicle, mean)
            limit = sumo.lane.getMaxSpeed(sumo.vehicle.getLaneID(vehicle))
            if self._scenario.preset == Preset.LAWFUL and sumo.vehicle.getSpeed(vehicle) > limit:
                sumo.vehicle.setPreviousSpeed(vehicle, limit)  # its file asks for more

    def _is_av(self, vehicle: str, seed: int) -> bool:
        rule = self._scenario.fleet
        if rule.ids is not None:
            return re.fullmatch(rule.ids, vehicle) is not None
        if rule.penetration is not None:
            drawn = uniform(seed, "av", vehicle) < rule.penetration
            return drawn and sumo.vehicle.getVehicleClass(vehicle) not in NOT_CARS
        if rule.type is not None:
            name: str = sumo.vehicle.getTypeID(vehicle)
            return name == rule.type or name.startswith(f"{rule.type}@")
        return False


def set_type(vehicle: str, name: str) -> None:
    """Give a vehicle another type; its size, class and maximum speed stay.

    `setType` replaces the car-following model (Krauss in most files); nothing else can.
    """
    get = sumo.vehicle
    kept = {field: getattr(get, f"get{field}")(vehicle) for field in KEPT}
    get.setType(vehicle, name)
    for field, value in kept.items():
        getattr(get, f"set{field}")(vehicle, value)
