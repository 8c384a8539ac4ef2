"""A user's own policy as `cosim.types.Policy`: class, factory or function; errors name the user's code."""

import inspect
import math
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from cosim.files.code import guarded
from cosim.observation.view import View, views
from cosim.scenario.policy_name import PolicyName
from cosim.types import (
    COMPACT,
    ContinuousAction,
    Decision,
    History,
    LookAhead,
    LooksAhead,
    MetaAction,
    ObservationConfig,
    PolicyContext,
)

NEEDED = ("observation", "reset", "decide")  # required members of `cosim.types.Policy`
ACTIONS = f"0 to {len(MetaAction) - 1}"


class OwnPolicy:
    """`cosim.types.Policy` around a user's object.

    A decision may be a `Decision`, a `MetaAction`, its number, or None: SUMO drives that AV.

    Raises BadInput, naming file and line, when the user's code raises or returns another value.
    """

    def __init__(self, inner: Any, name: PolicyName) -> None:
        file = name.code.file()
        self._inner, self._place = inner, file or name.place
        lacking = [field for field in NEEDED if not hasattr(inner, field)]
        if lacking:
            needed = f"a policy needs {', '.join(lacking)} (cosim.types.Policy); a function, one argument"
            raise self._wrong(needed, name.member)
        if not isinstance(inner.observation, ObservationConfig):
            raise self._wrong("must be a cosim.types.ObservationConfig", f"{name.member}.observation")
        self.name = name.label
        self.label = str(getattr(inner, "label", ""))
        self.observation: ObservationConfig = inner.observation
        self.av_parameters: Mapping[str, str] = getattr(inner, "av_parameters", {})
        for key, value in self.av_parameters.items():
            if not (isinstance(key, str) and isinstance(value, str)):
                raise self._wrong(
                    "must map SUMO's parameters to text", f"{name.member}.av_parameters", (key, value)
                )
        more = guarded(self._place, "files", lambda: [Path(f) for f in getattr(inner, "files", ())])
        for path in more:
            if not path.is_file():
                raise self._wrong("no such file", f"{name.member}.files", str(path))
        self.files = tuple(f for f in (file, *more) if f is not None)

    def looks_ahead(self, look: LookAhead) -> None:
        """Calls the user's method, if defined (`cosim.types.LooksAhead`)."""
        if isinstance(self._inner, LooksAhead):
            guarded(self._place, "looks_ahead", self._inner.looks_ahead, look)

    def reset(self, context: PolicyContext) -> None:
        """Start an episode."""
        guarded(self._place, "reset", self._inner.reset, context)

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One decision per AV that the user's code commands."""
        answer = guarded(self._place, "decide", self._inner.decide, histories)
        if not isinstance(answer, Mapping):
            raise self._wrong("must return a mapping of AV to decision", "decide", type(answer).__name__)
        found = {}
        for av, decision in answer.items():
            if av not in histories:
                raise self._wrong(f"decided for an id that is no AV on the road: {av!r}", "decide")
            if decision is not None:
                found[av] = self._decision(decision)
        return found

    def _decision(self, value: Any) -> Decision:
        found = value
        if isinstance(value, ContinuousAction):
            found = value.decision if value.lane_offset in (-1, 0, 1) else None
        whole: Decision = found if isinstance(found, Decision) else Decision(found)
        try:
            if not math.isfinite(whole.accel or 0.0):
                raise ValueError
            return whole._replace(action=MetaAction(operator.index(whole.action)))
        except (TypeError, ValueError):
            problem = (
                f"must decide for a Decision, a MetaAction ({ACTIONS}), a ContinuousAction or None, "
                "with a finite acceleration and a lane offset of 1, 0 or -1"
            )
            raise self._wrong(problem, "decide", value) from None

    def _wrong(self, problem: str, field: str, value: object = None) -> BadInput:
        return BadInput(problem, file=self._place, field=field, value=value)


class PerVehicle:
    """A function from one AV's `cosim.View` to an action of `Session.act`, applied to every AV.

    Its attribute `observation` configures the view; the default is compact maps.
    """

    def __init__(self, act: Callable[[View], Any]) -> None:
        self._act = act
        self.observation = getattr(act, "observation", COMPACT)

    def reset(self, context: PolicyContext) -> None:
        """Nothing to reset: the function has no state."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Any]:
        """The function's result for each AV."""
        return {av: self._act(view) for av, view in views(histories).items()}


def own(name: PolicyName) -> OwnPolicy:
    """A fresh instance of a user's policy.

    Raises BadInput when it cannot be imported, found or called.
    """
    found = name.code.load("--policy")
    if _takes_one(found):
        return OwnPolicy(PerVehicle(found), name)
    return OwnPolicy(guarded(name.place, name.member, found), name)


def _takes_one(found: Any) -> bool:
    """Whether `found` is a function with a required argument, the view."""
    if not inspect.isfunction(found):
        return False
    needed = [p for p in inspect.signature(found).parameters.values() if p.default is p.empty]
    return bool([p for p in needed if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)])
