"""SUMO options for a user's file: the file's own (`as-is`), or those that cosim's drivers and figures need
(`controlled`). Every result lists the changed options (formats.md, Traffic options)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from cosim.errors import BadInput, one_of
from cosim.scenario.behaviors import AS_IS
from cosim.scenario.sumocfg import boolean, time_of
from cosim.types import Timing, Traffic

if TYPE_CHECKING:
    from cosim.scenario import Fleet, Scenario

STEP, STEP_NEEDED = "step-length", "AVs are commanded, and conflicts measured, every 0.1 s"
CHECKS_INSIDE = "collision.check-junctions"
SUMO_STEP = "1"  # s, SUMO's default


@dataclass(frozen=True, slots=True)
class Rule:
    """A SUMO option of controlled traffic."""

    default: str  # SUMO's default
    used: str  # "": the option is not passed on
    why: str
    forced: bool = True  # overrides the file's value


RULES: Mapping[str, Rule] = {
    "lateral-resolution": Rule("-1", "", "AVs change lanes by LC2013, which has no sublane model"),
    # continuous lateral motion
    "lanechange.duration": Rule("0", "2", "a lane change is a movement that others can see", forced=False),
    "time-to-teleport": Rule("300", "-1", "a teleport would put a vehicle before an AV", forced=False),
    # docs/reference/sumo.md: not `none`, with which SUMO reports no collision
    "collision.action": Rule("teleport", "warn", "collisions are counted, and who crashed stands"),
    CHECKS_INSIDE: Rule("false", "true", "collisions inside junctions are counted"),
    "collision.mingap-factor": Rule("-1", "0", "only contact is a collision"),
}
ONLY_AS_IS = ("collision.action", "lateral-resolution")
USUAL = {name: rule.used for name, rule in RULES.items() if not rule.forced}
FORCED = {name: rule.used for name, rule in RULES.items() if rule.forced and rule.used}


class Changed(NamedTuple):
    """An option with another value than in the file."""

    option: str
    file: str  # the file's value, else SUMO's default
    used: str
    why: str


def clocks(step: float) -> Timing:
    """The default clocks, rounded up to multiples of SUMO's `step` (s)."""
    usual = Timing()
    frame = step * _times(usual.frame, step)
    return Timing(step=step, frame=frame, decision=frame * _times(usual.decision, frame))


def check_timing(timing: Timing, file: object, field: str, value: object) -> None:
    """Raises BadInput unless each clock is a multiple of the next faster one (observation.md, Clocks)."""
    for name, long, short in (
        ("frame", timing.frame, timing.step),
        ("decision", timing.decision, timing.frame),
    ):
        ratio = long / short if short > 0.0 else 0.0
        if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6:
            problem = f"a {name} of {long:g} s is not a whole number of {short:g} s"
            raise BadInput(problem, file=file, field=field, value=value)


def stepped(timing: Timing, typed: Mapping[str, str], traffic: str) -> Timing:
    """`timing` with the step length typed after `--`, if any. Raises BadInput."""
    if STEP not in typed:
        return timing
    place, field, text = "command line", f"--{STEP}", typed[STEP]
    step = time_of(text, place, field)
    if traffic == Traffic.AS_IS:
        if step <= 0.0:
            raise BadInput("must be above 0", file=place, field=field, value=text)
        return clocks(step)
    found = replace(timing, step=step)
    check_timing(found, place, field, text)
    return found


def settled(scenario: Scenario, typed: Mapping[str, str], wanted: str | None) -> Scenario:
    """`scenario` with the clocks and options of its kind of traffic.

    If cosim controls no driver (`driven`), the traffic of a user's .sumocfg is as-is. `typed`: options of the
    command line, which take precedence. `wanted`: `--traffic`.

    Raises:
        BadInput: `as-is` although cosim controls a driver; a step that does not divide a frame.
    """
    reason = _driven(scenario)
    reason = "the scenario's own file says how it drives" if scenario.built_in else reason
    if wanted is not None and one_of(wanted, Traffic.ALL, "--traffic") == Traffic.AS_IS and reason:
        raise BadInput(f"cannot be: {reason}", field="--traffic", value=wanted)
    traffic = wanted or (Traffic.CONTROLLED if reason else Traffic.AS_IS)
    if traffic == Traffic.CONTROLLED and typed.get("collision.action", "warn") != "warn":
        problem = "collisions are counted, never removed"
        raise BadInput(problem, field="--collision.action", value=typed["collision.action"])
    keeps = scenario.built_in or traffic == Traffic.AS_IS
    timing = stepped(scenario.timing if keeps else Timing(), typed, traffic)
    own = dict(scenario.options)
    file_step = own.pop(STEP, None)
    if traffic == Traffic.AS_IS:
        return replace(scenario, traffic=traffic, timing=timing, options=tuple(own.items()))
    changed = []
    rules = {STEP: Rule(SUMO_STEP, f"{timing.step:g}", STEP_NEEDED, forced=STEP not in typed), **RULES}
    written = own if file_step is None else {STEP: file_step, **own}
    for name, rule in rules.items():
        if scenario.built_in and name not in written:
            continue  # not set in a scenario folder: cosim decides
        file, used = written.get(name, rule.default), rule.used or rule.default
        if (rule.forced or name not in written) and not _same(file, used):
            changed.append(Changed(name, file, used, rule.why))
    overruled = {*ONLY_AS_IS, *(c.option for c in changed)}
    options = tuple((k, v) for k, v in own.items() if k not in overruled)
    return replace(scenario, traffic=traffic, timing=timing, options=options, changed=tuple(changed))


def driven(fleet: Fleet | None, behavior: str | None, errors: str | None) -> str:
    """The drivers that cosim controls in a user's file, in words; "": none. An option of None: unchanged."""
    if fleet is not None and fleet.may_have_avs:
        return f"AVs are driven (by {fleet.describe()})"
    if behavior not in (None, AS_IS):
        return f"human drivers are of Table II ({behavior})"
    return "" if errors is None else f"human drivers make errors ({errors})"


def in_words(manifest: Mapping[str, Any]) -> str:
    """`as-is`, or `controlled: step-length 1 -> 0.1, ...` for a user's file; "" for a scenario folder."""
    changed = manifest.get("changed_options", {})
    words = ", ".join(f"{name} {c['file']} -> {c['used']}" for name, c in changed.items())
    return ": ".join(filter(None, (manifest.get("traffic", ""), words)))


def check(scenario: Scenario) -> None:
    """Raises BadInput for as-is traffic with drivers controlled by cosim, if these were set after `load`."""
    if scenario.traffic == Traffic.AS_IS and (reason := _driven(scenario)):
        raise BadInput(f"{reason}: load the scenario with them", field="traffic", value=scenario.traffic)


def _driven(scenario: Scenario) -> str:
    return driven(
        scenario.fleet, scenario.behavior, None if scenario.errors is None else scenario.errors.name
    )


def _times(wanted: float, unit: float) -> int:
    """`wanted` as a multiple of `unit`, rounded up."""
    return max(math.ceil(wanted / unit - 1e-6), 1)


def _same(a: str, b: str) -> bool:
    """Whether SUMO parses two values of these options as equal."""
    try:
        return float(a) == float(b)
    except ValueError:
        return a == b or (b in ("true", "false") and boolean(a) == boolean(b))
