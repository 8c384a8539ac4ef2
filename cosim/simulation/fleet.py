"""Decides which vehicles are AVs and mission vehicles, and gives each departed vehicle its driver."""

import re
from collections.abc import Mapping

import libsumo

from cosim.scenario import Scenario
from cosim.scenario.behaviors import AS_IS
from cosim.scenario.vet_rules import NOT_CARS
from cosim.seeding import uniform
from cosim.simulation.convert import Body
from cosim.simulation.drivers import IDM_TYPE, Drivers
from cosim.types import Kind

# definitions.md, Vehicles: what an AV drives with while it has no command (egoistic IDM).
AV_IDM = {"Tau": 0.8, "MinGap": 2.0, "Accel": 3.0, "Decel": 7.0}
AV_LANE_CHANGE = {
    "laneChangeModel.lcCooperative": "0",
    "laneChangeModel.lcCooperativeSpeed": "0",
    "laneChangeModel.lcKeepRight": "0",
}
# What a vehicle of a user's file keeps: getters and setters of libsumo.vehicle, in this order.
KEPT = ("Length", "Width", "MaxSpeed", "SpeedFactor", "VehicleClass")


class Fleet:
    """Decides for every vehicle that departs; the draws depend on (seed, id) only, never on the order."""

    def __init__(self, scenario: Scenario, drivers: Drivers, av_parameters: Mapping[str, str]) -> None:
        self._scenario = scenario
        self._drivers = drivers
        self._av_parameters = av_parameters

    def depart(self, vehicle: str, seed: int) -> Body:
        """A vehicle departed: give it its driver; what it is."""
        get, s = libsumo.vehicle, self._scenario
        mission = s.mission.includes(vehicle)
        is_av = not mission and self._is_av(vehicle, seed)
        if not s.built_in and (is_av or s.behavior != AS_IS):
            factor = libsumo.vehicletype.getSpeedFactor(get.getTypeID(vehicle))
            set_type(vehicle)
            if is_av:
                get.setSpeedFactor(vehicle, factor)  # its type's mean, not a draw about it
        if is_av:
            for name, value in AV_IDM.items():
                getattr(get, f"set{name}")(vehicle, value)
            for key, text in {**AV_LANE_CHANGE, **self._av_parameters}.items():
                get.setParameter(vehicle, key, text)
        elif s.behavior != AS_IS:
            self._drivers.apply(vehicle)
        return Body(Kind.AV if is_av else Kind.HV, mission, get.getLength(vehicle), get.getWidth(vehicle))

    def _is_av(self, vehicle: str, seed: int) -> bool:
        rule = self._scenario.fleet
        if rule.ids is not None:
            return re.fullmatch(rule.ids, vehicle) is not None
        if rule.penetration is not None:
            drawn = uniform(seed, "av", vehicle) < rule.penetration
            return drawn and libsumo.vehicle.getVehicleClass(vehicle) not in NOT_CARS
        if rule.type is not None:
            name: str = libsumo.vehicle.getTypeID(vehicle)
            return name == rule.type or name.startswith(f"{rule.type}@")
        return False


def set_type(vehicle: str, name: str = IDM_TYPE) -> None:
    """Give a vehicle another type, by default IDM; its size, class and maximum speed stay.

    `setType` replaces the car-following model (Krauss in most files); nothing else can.
    """
    get = libsumo.vehicle
    kept = {name: getattr(get, f"get{name}")(vehicle) for name in KEPT}
    get.setType(vehicle, name)
    for name, value in kept.items():
        getattr(get, f"set{name}")(vehicle, value)
