"""Assigns each HV in SUMO a driver class of Table II (`cosim.scenario.behaviors`)."""

import hashlib

from cosim.errors import BadInput, one_of
from cosim.scenario.behaviors import AS_IS, DRIVER_MODELS, MOBIL, Behaviors, DriverClass, load_behaviors
from cosim.simulation.backend import sumo
from cosim.simulation.derived_types import IDM_TYPE, derive, is_known, own_type, table_ii
from cosim.simulation.mobil import MobilDriving

LARGEST_DRAW = 1.0 - 1e-12  # in (0, 1): the division rounds up to 1 for the largest integers


class Drivers:
    """Assigns every HV of an episode its class; a new object per episode (a reload drops the types).

    The draw is a hash of (seed, vehicle id), independent of the order of departures. So two episodes of one
    seed have the same drivers under different AV policies.
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
        self.classes: dict[str, str] = {}  # HV -> class, of all departed HVs
        self.mobil = MobilDriving(self.behaviors.mobil_period) if driver_model == MOBIL else None
        self._types: set[str] = set()  # known to SUMO

    def draws(self, vehicle: str) -> tuple[float, float, float]:
        """Three uniform numbers in (0, 1) for a vehicle's class, desired speed and MOBIL phase."""
        key = f"{self.seed}/behavior/{vehicle}".encode()
        digest = hashlib.blake2b(key, digest_size=24).digest()
        a, b, c = (
            min((int.from_bytes(digest[i : i + 8], "big") + 0.5) / 2.0**64, LARGEST_DRAW) for i in (0, 8, 16)
        )
        return a, b, c

    def apply(self, vehicle: str) -> str:
        """Apply the driver class to a departed HV; return the class ("as-is": nothing changes)."""
        if self.behavior == AS_IS:
            return AS_IS
        u_class, u_speed, u_phase = self.draws(vehicle)
        driver = self.behaviors.draw(self.behavior, u_class)
        set_ = sumo.vehicle
        set_.setType(vehicle, self._type(own_type(vehicle), driver))
        # setType keeps the lane-change parameters of the old type (SUMO 1.28): set each of them.
        for key, value in driver.lc2013:
            set_.setParameter(vehicle, f"laneChangeModel.{key}", repr(value))
        set_.setSpeedFactor(vehicle, self.behaviors.desired_speed.draw(u_speed))
        if self.mobil is not None:
            self.mobil.add(vehicle, driver.idm, driver.mobil, u_phase)
        self.classes[vehicle] = driver.name
        return driver.name

    def drop(self, vehicle: str) -> None:
        """The vehicle crashed: no further lane changes."""
        if self.mobil is not None:
            self.mobil.drop(vehicle)

    def pause(self, vehicle: str) -> None:
        """Suspend the vehicle's MOBIL lane changes until `resume`."""
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
        """The vType that combines an original vType with a driver class."""
        name = f"{original}/{driver.name}"
        if name not in self._types:
            self._types.add(name)
            if not is_known(name):
                self._derive(name, original, driver)
        return name

    def _derive(self, name: str, original: str, driver: DriverClass) -> None:
        """Derive the vType at run time: see `cosim.simulation.derived_types`."""
        draft, set_ = f"{name}/draft", sumo.vehicletype
        derive(draft, original, IDM_TYPE)
        for parameter, value in table_ii(driver, sumo.simulation.getDeltaT()).items():
            getattr(set_, f"set{parameter[0].upper()}{parameter[1:]}")(draft, value)
        set_.setSpeedDeviation(draft, 0.0)
        # SUMO's IDM computes 2 sqrt(a b) once, at construction: setAccel and setDecel do not update d*
        # (measured: -0.06 instead of -0.44 m/s2). Copying the type constructs the model anew.
        set_.copy(draft, name)
