"""Makes each HV in SUMO drive like its class of Table II (`cosim.scenario.behaviors`)."""

import hashlib

from cosim.errors import BadInput, one_of
from cosim.scenario.behaviors import AS_IS, DRIVER_MODELS, MOBIL, Behaviors, DriverClass, load_behaviors
from cosim.simulation.backend import sumo
from cosim.simulation.mobil import MobilDriving

# A vehicle cannot be given another car-following model while it drives, except through its type. A network
# whose types do not use IDM gets this one as an additional file (sumo_scenarios/types.add.xml).
IDM_TYPE = "cosim.idm"

# What a derived type keeps of its original: getters and setters of sumo.vehicletype, in this order.
BODY = ("VehicleClass", "Length", "Width", "Height", "MaxSpeed", "ShapeClass", "Color")

EMERGENCY_DECELERATION = 9.0  # m/s2, the limit of the tyres (SUMO's default)
LARGEST_DRAW = 1.0 - 1e-12  # in (0, 1): the division rounds up to 1 for the largest integers


def derive_idm_type(original: str, name: str) -> None:
    """Make vehicle type `name`: IDM with the size, class, maximum speed, shape and color of type `original`.

    Raises BadInput if `original` does not use IDM and the base type has not been loaded.
    """
    get = sumo.vehicletype
    if IDM_TYPE in get.getIDList():
        get.copy(IDM_TYPE, name)
        for parameter in BODY:
            getattr(get, f"set{parameter}")(name, getattr(get, f"get{parameter}")(original))
    elif get.getImperfection(original) == -1.0:  # SUMO's IDM has no driver imperfection: the value is -1
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
        one_of(behavior, self.behaviors.names, "behavior")
        one_of(driver_model, DRIVER_MODELS, "driver-model")
        if driver_model == MOBIL and behavior == AS_IS:
            raise BadInput(
                f"MOBIL needs Table II's drivers: choose another --behavior than {AS_IS}",
                field="driver-model",
                value=driver_model,
            )
        self.behavior, self.driver_model, self.seed = behavior, driver_model, seed
        self.classes: dict[str, str] = {}  # vehicle -> class, of all HVs so far
        self.mobil = MobilDriving(self.behaviors.mobil_period) if driver_model == MOBIL else None
        self._types: dict[tuple[str, str], str] = {}

    def draws(self, vehicle: str) -> tuple[float, float, float]:
        """Three uniform numbers in (0, 1) of one vehicle: for its class, desired speed and phase."""
        key = f"{self.seed}/behavior/{vehicle}".encode()
        digest = hashlib.blake2b(key, digest_size=24).digest()
        a, b, c = (
            min((int.from_bytes(digest[i : i + 8], "big") + 0.5) / 2.0**64, LARGEST_DRAW) for i in (0, 8, 16)
        )
        return a, b, c

    def apply(self, vehicle: str) -> str:
        """Make one departed HV drive like its class; returns the class ("as-is": nothing is touched)."""
        if self.behavior == AS_IS:
            return AS_IS
        u_class, u_speed, u_phase = self.draws(vehicle)
        driver = self.behaviors.draw(self.behavior, u_class)
        set_ = sumo.vehicle
        set_.setType(vehicle, self._type(set_.getTypeID(vehicle), driver))
        # setType leaves the lane-change parameters of the old type in place (SUMO 1.28): set each of them.
        for key, value in driver.lc2013:
            set_.setParameter(vehicle, f"laneChangeModel.{key}", repr(value))
        set_.setSpeedFactor(vehicle, self.behaviors.desired_speed.draw(u_speed))
        if self.mobil is not None:
            self.mobil.add(vehicle, driver.idm, driver.mobil, u_phase)
        self.classes[vehicle] = driver.name
        return driver.name

    def drop(self, vehicle: str) -> None:
        """The vehicle crashed: it changes lanes no more."""
        if self.mobil is not None:
            self.mobil.drop(vehicle)

    def pause(self, vehicle: str) -> None:
        """It makes no lane changes of its own until `resume`."""
        if self.mobil is not None:
            self.mobil.paused.add(vehicle)

    def resume(self, vehicle: str) -> None:
        """End of `pause`."""
        if self.mobil is not None:
            self.mobil.paused.discard(vehicle)

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
            set_, idm = sumo.vehicletype, driver.idm
            parameters = {
                "Tau": idm.time_headway,
                "MinGap": idm.minimum_gap,
                "Accel": idm.max_acceleration,
                # before Decel: SUMO warns when it is below the comfortable one
                "EmergencyDecel": max(EMERGENCY_DECELERATION, idm.comfortable_deceleration),
                "Decel": idm.comfortable_deceleration,
                "ApparentDecel": idm.comfortable_deceleration,
                "SpeedDeviation": 0.0,
            }
            for parameter, value in parameters.items():
                getattr(set_, f"set{parameter}")(draft, value)
            set_.setActionStepLength(draft, sumo.simulation.getDeltaT(), True)
            # SUMO's IDM keeps the 2 sqrt(a b) of its construction: setAccel and setDecel change a and b, but
            # not d* (measured: -0.06 instead of -0.44 m/s2). Copying the type constructs the model anew.
            set_.copy(draft, name)
            self._types[original, driver.name] = name
        return name
