"""Derived vTypes: the body of a vehicle's own vType with another driver.

The drivers are known before SUMO starts, and `cosim.scenario.vehicle_types` writes a vType for each. A vType
that no file has is derived at run time, from the attributes that TraCI can read and set. That happens for
vTypes made by another TraCI client, or in a SUMO that cosim did not start.
"""

import sumo_scenarios
from cosim.errors import BadInput
from cosim.scenario import Fleet, Scenario
from cosim.scenario.behaviors import AS_IS, MIXED, DriverClass, load_behaviors
from cosim.scenario.vehicle_types import Driver, WrittenType, describes_driver, read_types
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import AV_TYPE
from cosim.types import Preset

# sumo_scenarios/types.add.xml: IDM; IDM with comfortable braking; IDM with late braking
IDM_TYPE, LAWFUL_TYPE, LATE_TYPE = "cosim.idm", "cosim.av.lawful", "cosim.av.late"
EMERGENCY_DECELERATION = 9.0  # m/s2, tyre limit (SUMO's default)

# Attributes kept by a vType derived at run time: getters and setters of sumo.vehicletype, in this order.
BODY = (
    *("VehicleClass", "Length", "Width", "Height", "MaxSpeed", "ShapeClass", "Color"),
    *("EmissionClass", "Mass", "SpeedFactor", "Impatience", "BoardingDuration", "Scale"),
)

_BODY_ATTRIBUTES = frozenset(
    {"vClass", "guiShape", "speedDev"}
    | {name[0].lower() + name[1:] for name in BODY}
    | {"id", "probability"}  # no vehicle attributes
)


def suffix(base: str) -> str:
    """Suffix of the name of a vType with the driver of type `base`."""
    return f"/{base.rpartition('.')[2]}"


def drivers(scenario: Scenario, av_types: frozenset[str]) -> tuple[Driver, ...]:
    """The drivers that may replace those of the vTypes in `scenario`.

    `av_types`: the vTypes of AVs, for a fleet chosen by type.
    """
    base = {
        name: {key: value for key, value in kind.attributes.items() if key != "id"}
        for name, kind in read_types([sumo_scenarios.TYPES]).types.items()
    }
    found = []
    if scenario.fleet != Fleet():
        # in a scenario folder an AV drives as its vType says; in a .sumocfg, or without a vType, by IDM
        avs, idm = av_types or None, base[IDM_TYPE]
        found.append(Driver(AV_TYPE, "", {} if scenario.built_in else idm, avs, fallback=idm))
        if scenario.preset == Preset.LAWFUL:
            found += [Driver(AV_TYPE, suffix(kind), base[kind], avs) for kind in (LAWFUL_TYPE, LATE_TYPE)]
    if scenario.behavior != AS_IS:
        known, chosen = load_behaviors(), scenario.behavior
        for name in dict(known.mixed) if chosen == MIXED else (chosen,):
            written = table_ii(known.classes[name], scenario.timing.step)
            ours = {key: repr(value) for key, value in written.items()}
            found.append(Driver("", f"/{name}", {**base[IDM_TYPE], **ours}))
    return tuple(found)


def table_ii(driver: DriverClass, step: float) -> dict[str, float]:
    """A Table II class as vType attributes, acting in every simulation `step` (s)."""
    idm = driver.idm
    return {
        "tau": idm.time_headway,
        "minGap": idm.minimum_gap,
        "accel": idm.max_acceleration,
        # before decel: SUMO warns if emergencyDecel is below decel
        "emergencyDecel": max(EMERGENCY_DECELERATION, idm.comfortable_deceleration),
        "decel": idm.comfortable_deceleration,
        "apparentDecel": idm.comfortable_deceleration,
        "actionStepLength": step,
    }


def own_type(vehicle: str) -> str:
    """The vType of a vehicle, without the suffix of its own copy (`type@vehicle`)."""
    kind: str = sumo.vehicle.getTypeID(vehicle)
    return kind.removesuffix(f"@{vehicle}")


def is_known(name: str) -> bool:
    """Whether SUMO has a type of this name."""
    try:
        sumo.vehicletype.getLength(name)
    except sumo.TraCIException:
        return False
    return True


def not_derived(kind: WrittenType) -> set[str]:
    """Attributes of this vType that a vType derived at run time lacks."""
    own = {name for name in kind.attributes if name not in _BODY_ATTRIBUTES and not describes_driver(name)}
    return own | {"parameters" for tag, _ in kind.children if tag == "param"}


def derive(name: str, own: str, base: str) -> None:
    """Make vType `name` at run time: body of `own`, as far as TraCI can read it, driver of `base`.

    Raises BadInput if `base` has not been loaded and `own` does not use IDM.
    """
    get = sumo.vehicletype
    if is_known(base):
        get.copy(base, name)
        if base != own:
            for parameter in BODY:
                getattr(get, f"set{parameter}")(name, getattr(get, f"get{parameter}")(own))
    elif get.getImperfection(own) == -1.0:  # SUMO's IDM has no driver imperfection: the value is -1
        get.copy(own, name)
    else:
        raise BadInput(
            "the IDM car-following model is needed, which this type does not use; "
            f"load {base} from sumo_scenarios/types.add.xml",
            field="vType",
            value=own,
        )
