"""Makes each HV in SUMO drive like its class of Table II (`cosim.scenario.behaviors`)."""

from __future__ import annotations

import hashlib

import libsumo

from cosim.errors import BadInput
from cosim.scenario.behaviors import AS_IS, DRIVER_MODELS, MOBIL, Behaviors, DriverClass, load_behaviors
from cosim.simulation.mobil import MobilDriving

# A vehicle cannot be given another car-following model while it drives, except through its type. A network
# whose types do not use IDM gets this one as an additional file (sumo_scenarios/types.add.xml).
IDM_TYPE = "cosim.idm"

EMERGENCY_DECELERATION = 9.0  # m/s2, what tyres give: even a gentle driver's last resort (SUMO's default)


def derive_idm_type(original: str, name: str) -> None:
    """Make vehicle type `name`: IDM with the size, class, maximum speed and looks of type `original`.

    Raises BadInput if `original` does not use IDM and the base type has not been loaded.
    """
    get = libsumo.vehicletype
    if IDM_TYPE in get.getIDList():
        get.copy(IDM_TYPE, name)
        get.setVehicleClass(name, get.getVehicleClass(original))
        get.setLength(name, get.getLength(original))
        get.setWidth(name, get.getWidth(original))
        get.setHeight(name, get.getHeight(original))
        get.setMaxSpeed(name, get.getMaxSpeed(original))
        get.setShapeClass(name, get.getShapeClass(original))
        get.setColor(name, get.getColor(original))
    elif get.getImperfection(original) == -1.0:  # SUMO's IDM has no driver imperfection and says -1
        get.copy(original, name)
    else:
        raise BadInput(
            "Table II needs the IDM car-following model, which this type does not use; "
            f"load {IDM_TYPE} from sumo_scenarios/types.add.xml",
            field="vType",
            value=original,
        )


class Drivers:
    """Gives every HV of an episode its class; a new object per episode (types vanish with a reload).

    The draw is a hash of (seed, vehicle id): it does not depend on who departs first, so that two episodes
    of one seed under different AV policies meet the same drivers.
    """

    def __init__(
        self, behavior: str, driver_model: str, seed: int, behaviors: Behaviors | None = None
    ) -> None:
        self.behaviors = behaviors or load_behaviors()
        if behavior not in self.behaviors.names:
            raise BadInput(
                f"unknown behavior; known are {', '.join(self.behaviors.names)}",
                field="behavior",
                value=behavior,
            )
        if driver_model not in DRIVER_MODELS:
            raise BadInput(
                f"unknown driver model; known are {', '.join(DRIVER_MODELS)}",
                field="driver-model",
                value=driver_model,
            )
        if driver_model == MOBIL and behavior == AS_IS:
            raise BadInput(
                f"MOBIL needs Table II's drivers: choose another --behavior than {AS_IS}",
                field="driver-model",
                value=driver_model,
            )
        self.behavior, self.driver_model, self.seed = behavior, driver_model, seed
        self.classes: dict[str, str] = {}  # vehicle -> class, of everybody applied so far
        self.mobil = MobilDriving(self.behaviors.mobil_period) if driver_model == MOBIL else None
        self._types: dict[tuple[str, str], str] = {}

    def draws(self, vehicle: str) -> tuple[float, float, float]:
        """Three uniform numbers in (0, 1) of one vehicle: for its class, desired speed and phase."""
        key = f"{self.seed}/behavior/{vehicle}".encode()
        digest = hashlib.blake2b(key, digest_size=24).digest()
        a, b, c = ((int.from_bytes(digest[i : i + 8], "big") + 0.5) / 2.0**64 for i in (0, 8, 16))
        top = 1.0 - 1e-12  # the division rounds up to 1 for the largest integers
        return min(a, top), min(b, top), min(c, top)

    def apply(self, vehicle: str) -> str:
        """Make one departed HV drive like its class; returns the class ("as-is": nothing is touched)."""
        if self.behavior == AS_IS:
            return AS_IS
        u_class, u_speed, u_phase = self.draws(vehicle)
        driver = self.behaviors.draw(self.behavior, u_class)
        set_ = libsumo.vehicle
        set_.setType(vehicle, self._type(set_.getTypeID(vehicle), driver))
        # setType leaves the lane-change parameters of the old type in place (SUMO 1.28): set each of them.
        for key, value in driver.lc2013:
            set_.setParameter(vehicle, f"laneChangeModel.{key}", repr(value))
        set_.setSpeedFactor(vehicle, self.behaviors.desired_speed.draw(u_speed))
        if self.mobil is not None:
            self.mobil.add(vehicle, driver.idm, driver.mobil, u_phase)
        self.classes[vehicle] = driver.name
        return driver.name

    def step(self, time: float) -> None:
        """After every SUMO step (`time` in s): MOBIL's decisions; LC2013 decides inside SUMO."""
        if self.mobil is not None:
            self.mobil.step()

    def _type(self, original: str, driver: DriverClass) -> str:
        """The vehicle type of a class, derived from a vehicle's own type once per episode."""
        name = self._types.get((original, driver.name))
        if name is None:
            name = f"{original}/{driver.name}"
            draft = f"{name}/draft"
            derive_idm_type(original, draft)
            set_, idm = libsumo.vehicletype, driver.idm
            set_.setTau(draft, idm.time_headway)
            set_.setMinGap(draft, idm.minimum_gap)
            set_.setAccel(draft, idm.max_acceleration)
            # Emergency deceleration first: SUMO warns when it is below the comfortable one.
            set_.setEmergencyDecel(draft, max(EMERGENCY_DECELERATION, idm.comfortable_deceleration))
            set_.setDecel(draft, idm.comfortable_deceleration)
            set_.setApparentDecel(draft, idm.comfortable_deceleration)
            set_.setActionStepLength(draft, libsumo.simulation.getDeltaT(), True)
            set_.setSpeedDeviation(draft, 0.0)
            # SUMO's IDM keeps the 2 sqrt(a b) of its construction: setAccel and setDecel change a and b, but
            # not d* (measured: -0.06 instead of -0.44 m/s2). Copying the type constructs the model anew.
            set_.copy(draft, name)
            self._types[original, driver.name] = name
        return name
