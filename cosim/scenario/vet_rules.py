"""What the numbers in SUMO's files may be: tables for nets, vehicle types and vehicles, and one check.

Taken from SUMO 1.28's own schemas (net_file.xsd, route.xsd), which SUMO does not apply to most inputs: it
accepts NaN, infinities and negative speeds silently (docs/sumo.md). Words such as
`departPos="random"` are legal where the schema has them; SUMO itself refuses a word it does not know.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Number:
    """The range of a numeric attribute."""

    low: float = -math.inf
    above: bool = False  # strictly more than `low`
    high: float = math.inf
    words: bool = False  # text that is not a number is SUMO's to judge
    time: bool = False  # H:M:S is legal too
    distribution: bool = False  # "normc(1,0.1,0.2,2)" is legal too
    whole: bool = False  # digits only


FINITE = Number()
POSITIVE = Number(0.0, above=True)
NON_NEGATIVE = Number(0.0)
INDEX = Number(0.0, whole=True)
SHARE = Number(0.0, high=1.0)
TIME = Number(0.0, time=True)
WORD_OR_TIME = Number(0.0, words=True, time=True)
WORD_OR_NON_NEGATIVE = Number(0.0, words=True)
WORD_OR_FINITE = Number(words=True)

_NOT_A_SHAPE = re.compile(r"[^0-9eE+\-., \t\r\n]")  # NaN and inf have letters that no coordinate has
_CALL = re.compile(r"\s*[A-Za-z]\w*\((.*)\)\s*", re.DOTALL)


def _each(rule: Number, names: str) -> dict[str, Number]:
    return dict.fromkeys(names.split(), rule)


def words(names: str) -> frozenset[str]:
    """ "a b c" -> {a, b, c}"""
    return frozenset(names.split())


NET: Mapping[str, Mapping[str, Number]] = {
    "lane": {
        **_each(POSITIVE, "length width"),
        **_each(NON_NEGATIVE, "speed"),
        **_each(INDEX, "index"),
        **_each(FINITE, "endOffset"),
    },
    "edge": _each(FINITE, "priority length"),
    "junction": _each(FINITE, "x y z radius"),
    "connection": {
        **_each(INDEX, "fromLane toLane"),
        **_each(FINITE, "linkIndex contPos visibility speed length"),
    },
    "phase": _each(TIME, "duration"),
    "tlLogic": _each(WORD_OR_FINITE, "offset"),
}
SHAPES = frozenset({"shape", "customShape", "outlineShape"})

# Lane-change attributes SUMO 1.28 knows. The first group moves LC2013; the second only SL2015.
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
_CAR_FOLLOWING = (  # every remaining number of SUMO's car-following models: only finiteness is demanded
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
# Further attributes of a vType that are text; any other name is a slip of the pen worth a warning.
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
    "number": Number(0.0, high=1e6),  # 2e6 vehicles in one flow hang SUMO (docs/sumo.md)
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
    "interval": {},  # calibrators, rerouters and flows share the name: SUMO's to judge
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


def problem(value: str, rule: Number) -> str | None:
    """What is wrong with `value` under `rule`; None when it is fine."""
    try:
        number = float(value)
    except ValueError:
        return _problem_of_text(value, rule)
    if math.isnan(number) or math.isinf(number):
        return "must be finite"
    if number < rule.low or (rule.above and number == rule.low):
        return f"must be {'more than' if rule.above else 'at least'} {rule.low:g}"
    if rule.whole and not (value.isascii() and value.isdigit()):
        return "must be a whole number"
    if number > rule.high:
        return f"must be at most {rule.high:g}"
    return None


def _problem_of_text(value: str, rule: Number) -> str | None:
    if rule.time and ":" in value:
        bad = [problem(part, NON_NEGATIVE) for part in value.split(":")]
        return next((b for b in bad if b is not None), None)
    if rule.distribution and (call := _CALL.fullmatch(value)):
        bad = [problem(part.strip(), FINITE) for part in call[1].split(",")]
        return next((b for b in bad if b is not None), None)
    return None if rule.words and value.strip() else "is not a number"


def shape_problem(value: str) -> str | None:
    """What is wrong with a list of coordinates "x,y x,y[,z]"; None when it is fine."""
    bad = _NOT_A_SHAPE.search(value)
    return None if bad is None else "holds something that is not a finite number"


def clip(value: str) -> str:
    """A value as an error shows it: a shape may have a thousand points."""
    return value if len(value) <= 80 else f"{value[:77]}..."
