"""Permitted numbers in SUMO's files: tables for nets, vehicle types and vehicles, and one check.

Source: SUMO 1.28's schemas (net_file.xsd, route.xsd), which SUMO does not apply to most inputs. It accepts
NaN, infinities and negative speeds silently (docs/reference/sumo.md). Words such as `departPos="random"` are
legal where the schema has them; SUMO itself refuses other words.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, NoReturn

from cosim.errors import BadInput, Range


@dataclass(frozen=True, slots=True)
class Number(Range):
    """The range of a numeric attribute."""

    words: bool = False  # text that is not a number is left to SUMO
    time: bool = False  # H:M:S is legal too
    distribution: bool = False  # "normc(1,0.1,0.2,2)" is legal too
    whole: bool = False  # digits only
    shape: bool = False  # a list of coordinates "x,y x,y[,z]"


FINITE = Number()
POSITIVE = Number(0.0, above=True)
NON_NEGATIVE = Number(0.0)
INDEX = Number(0.0, whole=True)
SHARE = Number(0.0, high=1.0)
TIME = Number(0.0, time=True)
WORD_OR_TIME = Number(0.0, words=True, time=True)
WORD_OR_NON_NEGATIVE = Number(0.0, words=True)
WORD_OR_FINITE = Number(words=True)

_NOT_A_SHAPE = re.compile(r"[^0-9eE+\-., \t\r\n]")  # NaN and inf contain letters that no coordinate has
_CALL = re.compile(r"\s*[A-Za-z]\w*\((.*)\)\s*", re.DOTALL)


def _each(rule: Number, names: str) -> dict[str, Number]:
    return dict.fromkeys(names.split(), rule)


def words(names: str) -> frozenset[str]:
    """ "a b c" -> {a, b, c}"""
    return frozenset(names.split())


# Vehicle classes off the road, and classes that an AV does not replace.
OFF_ROAD = words(
    "rail rail_urban rail_electric rail_fast tram subway ship aircraft drone container cable_car"
)
NOT_CARS = OFF_ROAD | words("bicycle moped motorcycle scooter wheelchair pedestrian")

_NET: Mapping[str, Mapping[str, Number]] = {
    "lane": {
        **_each(POSITIVE, "length width speed"),
        "index": INDEX,
        **_each(FINITE, "endOffset"),
    },
    "edge": _each(FINITE, "priority length"),
    "junction": _each(FINITE, "x y z radius"),
    "connection": {
        **_each(INDEX, "fromLane toLane"),
        **_each(FINITE, "linkIndex contPos visibility speed length"),
    },
    "phase": _each(TIME, "duration minDur maxDur"),
    "tlLogic": _each(WORD_OR_FINITE, "offset"),
}
_SHAPES = _each(Number(shape=True), "shape customShape outlineShape")
NET = {tag: {**_SHAPES, **rules} for tag, rules in _NET.items()}

# Lane-change attributes of SUMO 1.28. The first group affects LC2013; the second only SL2015.
LC2013 = words(
    "lcStrategic lcStrategicLookahead lcCooperative lcCooperativeSpeed lcCooperativeRoundabout lcSpeedGain "
    "lcSpeedGainRight lcSpeedGainLookahead lcSpeedGainRemainTime lcSpeedGainUrgency lcKeepRight "
    "lcKeepRightAcceptanceTime lcOpposite lcAssertive lcLookaheadLeft lcOvertakeRight "
    "lcOvertakeDeltaSpeedFactor lcSigma lcMaxSpeedLatStanding lcMaxSpeedLatFactor lcMaxDistLatStanding "
    "lcContRight lcCooperativeHelpTime lcCooperativeHelpThreshold lcCooperativeMinSpeed"
)
SL2015_ONLY = words(
    "lcSublane lcPushy lcPushyGap lcImpatience lcTimeToImpatience lcAccelLat lcTurnAlignmentDistance "
    "lcLaneDiscipline"
)
LANE_CHANGE = LC2013 | SL2015_ONLY
_LANE_CHANGE_NON_NEGATIVE = (
    "lcStrategicLookahead lcAssertive lcLookaheadLeft lcSpeedGainRight lcSpeedGainLookahead "
    "lcSpeedGainRemainTime lcSpeedGainUrgency lcCooperativeRoundabout lcPushyGap lcImpatience "
    "lcTimeToImpatience lcMaxSpeedLatStanding lcMaxDistLatStanding lcOvertakeRight lcLaneDiscipline lcSigma "
    "lcCooperativeMinSpeed lcTurnAlignmentDistance"
)
JUNCTION_MODEL = (
    "jmCrossingGap jmDriveAfterYellowTime jmDriveAfterRedTime jmDriveRedSpeed jmIgnoreKeepClearTime "
    "jmIgnoreFoeSpeed jmIgnoreFoeProb jmIgnoreJunctionFoeProb jmSigmaMinor jmStoplineGap jmStoplineGapMinor "
    "jmTimegapMinor jmExtraGap jmAdvance jmStopSignWait jmAllwayStopWait"
)
_CAR_FOLLOWING = (  # all other numbers of SUMO's car-following models: only finiteness is required
    "delta adaptTime adaptFactor tmp1 tmp2 tmp3 tmp4 tmp5 tauLast apProb k phi security estimation "
    "speedControlGain speedControlMinGap gapClosingControlGainSpeed gapClosingControlGainSpace "
    "gapControlGainSpeed gapControlGainSpace collisionAvoidanceGainSpeed collisionAvoidanceGainSpace "
    "collisionAvoidanceOverride tauCACCToACC applyDriverState cc1 cc2 cc3 cc4 cc5 cc6 cc7 cc8 cc9 c1 ccDecel "
    "constSpacing kp lambda omegaN tauEngine xi lanesCount ccAccel ploegKp ploegKd ploegH flatbedKa "
    "flatbedKv flatbedKp flatbedD flatbedH collisionMinGapFactor speedControlGainCACC "
    "gapClosingControlGainGap gapClosingControlGainGapDot gapControlGainGap gapControlGainGapDot "
    "collisionAvoidanceGainGap collisionAvoidanceGainGapDot timeToTeleport timeToTeleportBidi "
    "boardingFactor sigmaleader sigmagap sigmaerror epsilonacc taccmax treaction"
)
VEHICLE_TYPE: Mapping[str, Number] = {
    **_each(FINITE, " ".join(LANE_CHANGE)),
    **_each(NON_NEGATIVE, _LANE_CHANGE_NON_NEGATIVE),
    **_each(FINITE, JUNCTION_MODEL),
    **_each(NON_NEGATIVE, "jmCrossingGap jmDriveRedSpeed jmIgnoreFoeSpeed jmStoplineGap jmAdvance"),
    **_each(SHARE, "jmIgnoreFoeProb jmIgnoreJunctionFoeProb jmSigmaMinor sigma ccoolness"),
    **_each(FINITE, _CAR_FOLLOWING),
    **_each(
        POSITIVE,
        "length maxSpeed desiredMaxSpeed width height mass accel decel emergencyDecel apparentDecel tau "
        "stepping maxSpeedLat massFactor maxPower maxTraction tPersDrive tpreview tPersEstimate jerkmax",
    ),
    **_each(
        NON_NEGATIVE,
        "minGap minGapLat probability speedDev actionStepLength scale startupDelay speedFactorPremature "
        "personCapacity containerCapacity boardingDuration loadingDuration sigmaStep",
    ),
    "speedFactor": Number(0.0, distribution=True),
    "impatience": WORD_OR_FINITE,
}
# Text attributes of a vType; any other name is probably a typing error and causes a warning.
VEHICLE_TYPE_TEXT = words(
    "id refId vClass emissionClass maneuverAngleTimes guiShape color carFollowModel laneChangeModel "
    "latAlignment hasDriverState imgFile osgFile trainType vehdynamics maxvehpreview Mflatness Mbegin "
    "maxAccelProfile desAccelProfile parkingBadges speedTable tractionTable resistanceTable resCoef_constant "
    "resCoef_linear resCoef_quadratic curveResistance curveIntegration roeckl_sharp_radius roeckl_numerator "
    "roeckl_numerator_sharp roeckl_offset roeckl_offset_sharp locomotiveLength carriageLength carriageGap "
    "carriageDoors rotationsPerMinute vehicles"
)

_DRIVING = {
    **_each(WORD_OR_FINITE, "departPos arrivalPos departPosLat arrivalPosLat"),  # negative: from the end
    **_each(WORD_OR_NON_NEGATIVE, "departSpeed arrivalSpeed departLane arrivalLane departEdge arrivalEdge"),
    **_each(POSITIVE, "speedFactor"),
    **_each(NON_NEGATIVE, "personNumber containerNumber"),
    **_each(TIME, "begin end"),
    "depart": WORD_OR_TIME,
    "arrival": WORD_OR_TIME,
    "vehsPerHour": NON_NEGATIVE,
    "perHour": NON_NEGATIVE,
    "probability": SHARE,
    "number": Number(0.0, high=1e6),  # 2e6 vehicles in one flow hang SUMO (docs/reference/sumo.md)
    "period": Number(0.0, above=True, time=True, distribution=True),
}
_WALKING = _each(WORD_OR_FINITE, "departPos arrivalPos speed duration")
DEMAND: Mapping[str, Mapping[str, Number]] = {
    "vType": VEHICLE_TYPE,
    "vTypeDistribution": _each(NON_NEGATIVE, "probability"),
    "vehicle": _DRIVING,
    "trip": _DRIVING,
    "flow": _DRIVING,
    "person": _DRIVING,
    "personFlow": _DRIVING,
    "container": _DRIVING,
    "containerFlow": _DRIVING,
    "interval": {},  # used by calibrators, rerouters and flows: left to SUMO
    "route": {
        **_each(NON_NEGATIVE, "probability repeat"),
        **_each(FINITE, "cost"),
        **_each(TIME, "cycleTime"),
    },
    "stop": {
        **_each(WORD_OR_FINITE, "startPos endPos posLat duration until arrival started ended"),
        **_each(NON_NEGATIVE, "speed"),
    },
    "walk": _WALKING,
    "personTrip": _WALKING,
    "ride": _WALKING,
}


def some(names: Sequence[str]) -> str:
    """The first three of many names."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def seconds(value: str | None) -> float:
    """A SUMO time in s; NaN if invalid."""
    try:
        parts = [float(part) for part in (value or "").split(":")]
    except ValueError:
        return math.nan
    return sum(part * 60.0**k for k, part in enumerate(reversed(parts)))


def problem(value: str, rule: Number) -> str | None:
    """The fault of `value` under `rule`; None if it is valid."""
    if rule.shape:
        return "holds something that is not a finite number" if _NOT_A_SHAPE.search(value) else None
    try:
        number = float(value)
    except ValueError:
        return _problem_of_text(value, rule)
    wrong = rule.problem(number)
    if wrong is None and rule.whole and not (value.isascii() and value.isdigit()):
        return "must be a whole number"
    return wrong


def _problem_of_text(value: str, rule: Number) -> str | None:
    if rule.time and ":" in value:
        return next(filter(None, (problem(part, NON_NEGATIVE) for part in value.split(":"))), None)
    if rule.distribution and (call := _CALL.fullmatch(value)):
        return next(filter(None, (problem(part.strip(), FINITE) for part in call[1].split(","))), None)
    return None if rule.words and value.strip() else "is not a number"


class Place(NamedTuple):
    """The position of an attribute, for error messages."""

    file: Path
    field: str  # tag.attribute
    owner: str  # id of the element, "" without one
    line: int

    def __str__(self) -> str:
        return f"{self.owner}, line {self.line}" if self.owner else f"line {self.line}"

    def wrong(self, problem: str, value: str) -> BadInput:
        """The error; a long value is shortened, since a shape may have a thousand points."""
        shown = value if len(value) <= 80 else f"{value[:77]}..."
        return BadInput(f"{problem} ({self})", file=self.file, field=self.field, value=shown)


class Reader:
    """Base class of the handlers of one pass over an XML file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def _check(
        self, tag: str, attributes: Mapping[str, str], rules: Mapping[str, Number], owner: str, line: int
    ) -> None:
        """Refuse the first attribute that violates its rule."""
        for name, value in attributes.items():
            if name in rules and (wrong := problem(value, rules[name])):
                self._refuse(tag, name, value, wrong, owner, line)

    def _refuse(self, tag: str, name: str, value: str, wrong: str, owner: str, line: int) -> NoReturn:
        raise Place(self._path, f"{tag}.{name}", owner, line).wrong(wrong, value)
