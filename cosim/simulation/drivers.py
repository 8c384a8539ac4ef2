"""Human drivers: reads Table II from behaviors.yaml and makes each HV in SUMO drive like its class."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import NormalDist
from typing import Any

import libsumo
import yaml

import sumo_scenarios
from cosim.errors import BadInput
from cosim.simulation.mobil import IdmParameters, MobilDriving, MobilParameters

BEHAVIORS_FILE = sumo_scenarios.BEHAVIORS

AS_IS = "as-is"
MIXED = "mixed"
LC2013, MOBIL = "lc2013", "mobil"
DRIVER_MODELS = (LC2013, MOBIL)

# What LC2013 of SUMO 1.28 really has (SUMO reads any other name in a vType without a word).
LC2013_ATTRIBUTES = frozenset(
    (
        "lcStrategic",
        "lcStrategicLookahead",
        "lcCooperative",
        "lcCooperativeSpeed",
        "lcCooperativeRoundabout",
        "lcSpeedGain",
        "lcSpeedGainRight",
        "lcSpeedGainLookahead",
        "lcSpeedGainRemainTime",
        "lcKeepRight",
        "lcKeepRightAcceptanceTime",
        "lcOpposite",
        "lcAssertive",
        "lcLookaheadLeft",
        "lcOvertakeRight",
        "lcOvertakeDeltaSpeedFactor",
        "lcSigma",
        "lcMaxSpeedLatStanding",
        "lcMaxSpeedLatFactor",
        "lcMaxDistLatStanding",
    )
)

# A vehicle cannot be given another car-following model while it drives, except through its type. A network
# whose types do not use IDM gets this one as an additional file (sumo_scenarios/types.add.xml).
IDM_TYPE = "cosim.idm"

EMERGENCY_DECELERATION = 9.0  # m/s2, what tyres give: even a gentle driver's last resort (SUMO's default)


@dataclass(frozen=True, slots=True)
class DesiredSpeed:
    """Distribution of the desired speed as a factor on the speed limit: normal, clipped."""

    mean: float
    deviation: float
    minimum: float
    maximum: float

    def draw(self, u: float) -> float:
        """The factor at quantile `u` in (0, 1)."""
        if self.deviation == 0.0:
            return self.mean
        return min(max(NormalDist(self.mean, self.deviation).inv_cdf(u), self.minimum), self.maximum)


@dataclass(frozen=True, slots=True)
class DriverClass:
    """One column of Table II and its LC2013 attributes."""

    name: str
    idm: IdmParameters
    mobil: MobilParameters
    lc2013: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Behaviors:
    """behaviors.yaml."""

    classes: Mapping[str, DriverClass]
    mixed: tuple[tuple[str, float], ...]  # class, cumulated share; the last is 1
    desired_speed: DesiredSpeed
    mobil_period: float  # s

    @property
    def names(self) -> tuple[str, ...]:
        """What `--behavior` accepts."""
        return (*self.classes, MIXED, AS_IS)

    def draw(self, behavior: str, u: float) -> DriverClass:
        """The class at quantile `u` in [0, 1) of a behaviour: one class, or the mixture."""
        if behavior != MIXED:
            return self.classes[behavior]
        return self.classes[next((name for name, share in self.mixed if u < share), self.mixed[-1][0])]


# ---------------------------------------------------------------- reading the file


class _Reader:
    """Takes numbers out of nested mappings and names the place of whatever is wrong."""

    def __init__(self, file: Path | str) -> None:
        self.file = file

    def fail(self, problem: str, field: str, value: object = None) -> BadInput:
        return BadInput(problem, file=self.file, field=field, value=value)

    def mapping(self, value: Any, field: str, required: tuple[str, ...] | None = None) -> dict[str, Any]:
        if not isinstance(value, dict) or not value:
            raise self.fail("expected a mapping", field, value)
        if required is not None:
            for name in required:
                if name not in value:
                    raise self.fail("missing", f"{field}.{name}" if field else name)
            for name in value:
                if name not in required:
                    raise self.fail(f"unknown field; known are {', '.join(required)}", field or "file", name)
        return {str(k): v for k, v in value.items()}

    def number(self, value: Any, field: str, low: float = 0.0, *, above: bool = False) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.fail("expected a finite number", field, value)
        if value < low or (above and value == low):
            raise self.fail(f"must be {'more than' if above else 'at least'} {low:g}", field, value)
        return float(value)


@lru_cache
def load_behaviors(path: Path | str | None = None) -> Behaviors:
    """Read behaviors.yaml (default: the one that ships with the worlds).

    Raises BadInput naming file, field and value.
    """
    if path is None:
        path = BEHAVIORS_FILE
    read = _Reader(path)
    try:
        document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"cannot be read: {error}", file=path) from error
    except yaml.YAMLError as error:
        raise BadInput(f"not valid YAML: {' '.join(str(error).split())}", file=path) from error
    top = read.mapping(document, "", ("desired_speed", "mixed", "mobil_period", "classes"))
    classes = {
        name: _driver_class(read, name, value)
        for name, value in read.mapping(top["classes"], "classes").items()
    }
    for reserved in (MIXED, AS_IS):
        if reserved in classes:
            raise read.fail("is not the name of a class", "classes", reserved)

    shares = read.mapping(top["mixed"], "mixed")
    for name in shares:
        if name not in classes:
            raise read.fail("unknown class", "mixed", name)
    weights = {name: read.number(value, f"mixed.{name}") for name, value in shares.items()}
    total = sum(weights.values())
    if total <= 0.0:
        raise read.fail("the shares are all 0", "mixed")
    cumulated, so_far = [], 0.0
    for name, weight in weights.items():
        so_far += weight / total
        cumulated.append((name, so_far))

    fields = ("mean", "deviation", "minimum", "maximum")
    speed = read.mapping(top["desired_speed"], "desired_speed", fields)
    desired = DesiredSpeed(
        *(read.number(speed[f], f"desired_speed.{f}", above=f != "deviation") for f in fields)
    )
    if not desired.minimum <= desired.mean <= desired.maximum:
        raise read.fail("must lie between minimum and maximum", "desired_speed.mean", desired.mean)
    period = read.number(top["mobil_period"], "mobil_period", above=True)
    return Behaviors(classes, tuple(cumulated), desired, period)


def _driver_class(read: _Reader, name: str, value: Any) -> DriverClass:
    at = f"classes.{name}"
    parts = read.mapping(value, at, ("mobil", "idm", "lc2013"))
    fields = ("time_headway", "minimum_gap", "max_acceleration", "comfortable_deceleration")
    idm = read.mapping(parts["idm"], f"{at}.idm", fields)
    numbers = [read.number(idm[f], f"{at}.idm.{f}", above=True) for f in fields]
    rule = read.mapping(parts["mobil"], f"{at}.mobil", ("politeness", "threshold", "safe_deceleration"))
    mobil = MobilParameters(
        read.number(rule["politeness"], f"{at}.mobil.politeness"),
        read.number(rule["threshold"], f"{at}.mobil.threshold"),
        read.number(rule["safe_deceleration"], f"{at}.mobil.safe_deceleration", above=True),
    )
    attributes = read.mapping(parts["lc2013"], f"{at}.lc2013")
    for key in attributes:
        if key not in LC2013_ATTRIBUTES:
            raise read.fail("LC2013 has no such attribute", f"{at}.lc2013", key)
    lc2013 = tuple((k, read.number(v, f"{at}.lc2013.{k}", -1.0)) for k, v in attributes.items())
    return DriverClass(name, IdmParameters(*numbers), mobil, lc2013)


# ---------------------------------------------------------------- into SUMO


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
