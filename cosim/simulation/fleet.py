"""Says which vehicles are AVs and mission vehicles, and gives each departed vehicle its driver."""

from __future__ import annotations

import re
from collections.abc import Mapping

import libsumo

from cosim.scenario import Scenario
from cosim.scenario.behaviors import AS_IS
from cosim.seeding import uniform
from cosim.simulation.convert import Body
from cosim.simulation.drivers import IDM_TYPE, Drivers
from cosim.types import Kind

# definitions.md, Vehicles: what an AV drives with while nobody commands it (egoistic IDM).
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
        self._rule = scenario.fleet
        self._ids = re.compile(scenario.fleet.ids) if scenario.fleet.ids is not None else None
        self._mission = re.compile(scenario.mission.vehicles) if scenario.mission.vehicles else None
        self._drivers = drivers
        self._av_parameters = av_parameters
        self._foreign = not scenario.built_in
        self._rewrite_humans = scenario.behavior != AS_IS

    def depart(self, vehicle: str, seed: int) -> Body:
        """A vehicle departed: give it its driver; what it is."""
        get = libsumo.vehicle
        mission = self._mission is not None and self._mission.fullmatch(vehicle) is not None
        is_av = not mission and self._is_av(vehicle, seed)
        if is_av:
            if self._foreign:
                adopt(vehicle)
            for name, value in AV_IDM.items():
                getattr(get, f"set{name}")(vehicle, value)
            for key, text in {**AV_LANE_CHANGE, **self._av_parameters}.items():
                get.setParameter(vehicle, key, text)
        elif self._rewrite_humans:
            if self._foreign:
                adopt(vehicle)
            self._drivers.apply(vehicle)
        return Body(Kind.AV if is_av else Kind.HV, mission, get.getLength(vehicle), get.getWidth(vehicle))

    def _is_av(self, vehicle: str, seed: int) -> bool:
        if self._ids is not None:
            return self._ids.fullmatch(vehicle) is not None
        if self._rule.penetration is not None:
            return uniform(seed, "av", vehicle) < self._rule.penetration
        if self._rule.type is not None:
            name: str = libsumo.vehicle.getTypeID(vehicle)
            return name == self._rule.type or name.startswith(f"{self._rule.type}@")
        return False


def adopt(vehicle: str) -> None:
    """Give a vehicle of a user's file the IDM type, but let it keep its body.

    `setType` replaces the car-following model (Krauss in most files); nothing else can.
    """
    get = libsumo.vehicle
    kept = {name: getattr(get, f"get{name}")(vehicle) for name in KEPT}
    get.setType(vehicle, IDM_TYPE)
    for name, value in kept.items():
        getattr(get, f"set{name}")(vehicle, value)
