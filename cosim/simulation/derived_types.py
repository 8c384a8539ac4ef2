"""The types that vehicles drive as in place of their own: the vehicle is theirs, the driver is not.

Which drivers there will be is known before SUMO starts, and `cosim.scenario.vehicle_types` writes a type for
each. A type that no file has (made by another TraCI program, or in a SUMO that somebody else started) is
derived while SUMO drives, from what its calls can read and set.
"""

import sumo_scenarios
from cosim.errors import BadInput
from cosim.scenario import Fleet, Scenario
from cosim.scenario.behaviors import AS_IS, MIXED, DriverClass, load_behaviors
from cosim.scenario.vehicle_types import Driver, WrittenType, describes_driver, read_types
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import AV_TYPE
from cosim.types import Preset

# sumo_scenarios/types.add.xml: an IDM; one that brakes comfortably, and one that brakes late
IDM_TYPE, LAWFUL_TYPE, LATE_TYPE = "cosim.idm", "cosim.av.lawful", "cosim.av.late"
EMERGENCY_DECELERATION = 9.0  # m/s2, the limit of the tyres (SUMO's default)

# What a type keeps that is derived while SUMO drives: getters and setters of sumo.vehicletype, in this order.
BODY = (
    *("VehicleClass", "Length", "Width", "Height", "MaxSpeed", "ShapeClass", "Color"),
    *("EmissionClass", "Mass", "SpeedFactor", "Impatience", "BoardingDuration", "Scale"),
)

_BODY_ATTRIBUTES = frozenset(
    {"vClass", "guiShape", "speedDev"}
    | {name[0].lower() + name[1:] for name in BODY}
    | {"id", "probability"}  # which describe no vehicle
)


def suffix(base: str) -> str:
    """What the name of a type ends with that drives as type `base`."""
    return f"/{base.rpartition('.')[2]}"


def drivers(scenario: Scenario, av_types: frozenset[str]) -> tuple[Driver, ...]:
    """Everybody who may drive a vehicle of `scenario` in place of its type's own driver.

    `av_types`: the types that are meant where the scenario's fleet is one by type.
    """
    base = {
        name: {key: value for key, value in kind.attributes.items() if key != "id"}
        for name, kind in read_types([sumo_scenarios.TYPES]).types.items()
    }
    found = []
    if scenario.fleet != Fleet():
        # in our worlds an AV drives as its type says, one of a user's file, or of no type, by IDM
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
    """A class of Table II as attributes of a type; it acts in every step (s) of the simulation."""
    idm = driver.idm
    return {
        "tau": idm.time_headway,
        "minGap": idm.minimum_gap,
        "accel": idm.max_acceleration,
        # before decel: SUMO warns when it is below the comfortable one
        "emergencyDecel": max(EMERGENCY_DECELERATION, idm.comfortable_deceleration),
        "decel": idm.comfortable_deceleration,
        "apparentDecel": idm.comfortable_deceleration,
        "actionStepLength": step,
    }


def own_type(vehicle: str) -> str:
    """The type of a vehicle; of its own copy of one (`type@vehicle`) the type."""
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
    """What a type that is derived while SUMO drives does not have of this one."""
    own = {name for name in kind.attributes if name not in _BODY_ATTRIBUTES and not describes_driver(name)}
    return own | {"parameters" for tag, _ in kind.children if tag == "param"}


def derive(name: str, own: str, base: str) -> None:
    """Make type `name` where no file has: type `own`, as far as SUMO's calls can tell, driven as `base`.

    Raises BadInput where the base type has not been loaded and the type's own driver is no IDM.
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
