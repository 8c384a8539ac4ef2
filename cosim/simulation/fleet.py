"""Selects AVs and mission vehicles, and assigns each departed vehicle its driver."""

import math
import re
from collections.abc import Mapping

from cosim.errors import BadInput
from cosim.scenario import Scenario
from cosim.scenario.behaviors import AS_IS
from cosim.scenario.vet_rules import NOT_CARS
from cosim.seeding import uniform
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import AV_TYPE
from cosim.simulation.convert import ACTORS, Body
from cosim.simulation.derived_types import IDM_TYPE, derive, is_known, own_type
from cosim.simulation.drivers import Drivers
from cosim.types import Actor, Kind, Preset

# presets.md, Policies: IDM of an AV without a command (egoistic).
AV_IDM = {"tau": 0.8, "minGap": 2.0, "accel": 3.0, "decel": 7.0}  # s, m, m/s2
AV_LANE_CHANGE = {
    "laneChangeModel.lcCooperative": "0",
    "laneChangeModel.lcCooperativeSpeed": "0",
    "laneChangeModel.lcKeepRight": "0",
}
# Vehicle attributes kept at a change of vType: getters and setters of sumo.vehicle, set in this order.
KEPT = (
    *("Length", "Width", "Height", "MaxSpeed", "SpeedFactor", "VehicleClass"),
    *("ShapeClass", "EmissionClass", "Mass"),
)


class Fleet:
    """The fleet of an episode; draws depend on (seed, id) only, never on the order of departures."""

    def __init__(
        self,
        scenario: Scenario,
        drivers: Drivers,
        av_parameters: Mapping[str, str],
        av_types: frozenset[str] = frozenset(),
    ) -> None:
        """`av_types`: the vTypes of AVs, for a fleet chosen by type."""
        self._scenario = scenario
        self._drivers = drivers
        self._idm = {name: _number(name, av_parameters.get(name, usual)) for name, usual in AV_IDM.items()}
        others = {key: text for key, text in av_parameters.items() if key not in AV_IDM}
        self._av_parameters = {**AV_LANE_CHANGE, **others}
        self._fleet_types = av_types or {scenario.fleet.type}
        self._av_types: set[str] = set()  # AV vTypes known to SUMO

    def depart(self, vehicle: str, seed: int) -> Body:
        """Assign a departed vehicle its driver; return its constants."""
        get, s = sumo.vehicle, self._scenario
        is_av = self.is_av(vehicle, seed)
        if is_av:
            self._take_av_type(vehicle)
            for name, value in self._idm.items():  # SUMO ignores these silently in `setParameter`
                getattr(get, f"set{name[0].upper()}{name[1:]}")(vehicle, value)
            for key, text in self._av_parameters.items():
                get.setParameter(vehicle, key, text)
        elif s.behavior != AS_IS:
            self._drivers.apply(vehicle)
        size = get.getLength(vehicle), get.getWidth(vehicle)
        actor = ACTORS.get(get.getVehicleClass(vehicle), Actor.CAR)
        return Body(Kind.AV if is_av else Kind.HV, s.mission.includes(vehicle), *size, actor)

    def _take_av_type(self, vehicle: str) -> None:
        """Set the AV's vType: as its type says in a scenario folder, IDM in a user's .sumocfg."""
        own, ours = own_type(vehicle), self._scenario.built_in
        name = AV_TYPE + own
        if name not in self._av_types:
            self._av_types.add(name)
            if not is_known(name):
                derive(name, own, own if ours else IDM_TYPE)
        if ours:
            sumo.vehicle.setType(vehicle, name)
        else:
            set_type(vehicle, name)
            mean = sumo.vehicletype.getSpeedFactor(own)  # the mean, without SUMO's random draw
            sumo.vehicle.setSpeedFactor(vehicle, mean)
            limit = sumo.lane.getMaxSpeed(sumo.vehicle.getLaneID(vehicle))
            if self._scenario.preset == Preset.LAWFUL and sumo.vehicle.getSpeed(vehicle) > limit:
                sumo.vehicle.setPreviousSpeed(vehicle, limit)  # the file's departSpeed exceeds the limit

    def is_av(self, vehicle: str, seed: int) -> bool:
        """Whether a waiting or just departed vehicle is an AV. Not valid later: the driver changes the
        vType."""
        rule = self._scenario.fleet
        if self._scenario.mission.includes(vehicle):
            return False
        if rule.ids is not None:
            return re.fullmatch(rule.ids, vehicle) is not None
        if rule.penetration is not None:
            drawn = uniform(seed, "av", vehicle) < rule.penetration
            return drawn and sumo.vehicle.getVehicleClass(vehicle) not in NOT_CARS
        if rule.type is not None:
            return own_type(vehicle) in self._fleet_types
        return False


def set_type(vehicle: str, name: str) -> None:
    """Change a vehicle's vType but keep its own attributes (`type@vehicle`).

    Only `setType` replaces the car-following model (Krauss in most files).
    """
    get = sumo.vehicle
    kept = {field: getattr(get, f"get{field}")(vehicle) for field in KEPT}
    get.setType(vehicle, name)
    for field, value in kept.items():
        getattr(get, f"set{field}")(vehicle, value)


def _number(name: str, text: str | float) -> float:
    """The value of one of `AV_IDM`. Raises BadInput."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise BadInput("must be a number above 0", field=f"av_parameters.{name}", value=text)
    return value
