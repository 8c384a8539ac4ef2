"""Somebody's own policy behind our protocol: class, factory or function, its mistakes named as its own."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import operator
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from cosim.errors import BadInput, CosimError, hint
from cosim.observation.view import View, views
from cosim.scenario.policy_name import PolicyName
from cosim.types import COMPACT, Decision, History, MetaAction, ObservationConfig, PolicyContext

NEEDED = ("observation", "reset", "decide")  # of `cosim.types.Policy`; the rest has defaults
ACTIONS = f"0 to {len(MetaAction) - 1}"


class OwnPolicy:
    """`cosim.types.Policy` around an object of the user's.

    A decision may be a `Decision`, a `MetaAction`, its number, or None: SUMO drives that AV.

    Raises BadInput whenever his code raises or answers something else, naming the file and line.
    """

    def __init__(self, inner: Any, name: PolicyName, file: Path | None) -> None:
        self._inner, self._place = inner, file or name.place
        lacking = [field for field in NEEDED if not hasattr(inner, field)]
        if lacking:
            raise self._wrong(f"a policy needs {', '.join(lacking)} (cosim.types.Policy)", name.member)
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
        more = self._guard("files", lambda: [Path(f) for f in getattr(inner, "files", ())])
        for path in more:
            if not path.is_file():
                raise self._wrong("no such file", f"{name.member}.files", str(path))
        self.files = tuple(f for f in (file, *more) if f is not None)

    def reset(self, context: PolicyContext) -> None:
        """A new episode begins."""
        self._guard("reset", self._inner.reset, context)

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One decision per AV he wants to command."""
        answer = self._guard("decide", self._inner.decide, histories)
        if not isinstance(answer, Mapping):
            raise self._wrong("must return a mapping of AV to decision", "decide", type(answer).__name__)
        found = {}
        for av, decision in answer.items():
            if av not in histories:
                raise self._wrong(f"decided for one that is no AV on the road: {av!r}", "decide")
            if decision is not None:
                found[av] = self._decision(decision)
        return found

    def _decision(self, value: Any) -> Decision:
        whole: Decision = value if isinstance(value, Decision) else Decision(value)
        try:
            return whole._replace(action=MetaAction(operator.index(whole.action)))
        except (TypeError, ValueError):
            problem = f"must decide for a Decision, a MetaAction ({ACTIONS}) or None"
            raise self._wrong(problem, "decide", value) from None

    def _guard(self, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except CosimError:
            raise
        except (Exception, SystemExit) as error:
            raise raised(error, self._place, what) from error

    def _wrong(self, problem: str, field: str, value: object = None) -> BadInput:
        return BadInput(problem, file=self._place, field=field, value=value)


class PerVehicle:
    """A function of one AV's `cosim.View`, as `Session.act` wants it, that commands every AV alike.

    Its attribute `observation` says what it wants to see; without one it sees compact maps.
    """

    def __init__(self, act: Callable[[View], Any]) -> None:
        self._act = act
        self.observation = getattr(act, "observation", COMPACT)

    def reset(self, context: PolicyContext) -> None:
        """It remembers nothing."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Any]:
        """What the function says of each."""
        return {av: self._act(view) for av, view in views(histories).items()}


def load(name: PolicyName) -> tuple[Any, Path | None]:
    """The class, factory or function that `name` stands for, and the file it is in.

    Raises BadInput: it cannot be imported, or has nothing of that name that can be called.
    """
    module = _module(name)
    found = getattr(module, name.member, None)
    if not callable(found):
        known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        problem = f"nothing to call of this name{hint(name.member, known)}"
        raise BadInput(problem, file=name.place, field="--policy", value=name.member)
    file = getattr(module, "__file__", None)
    return found, Path(file) if file else None


def own(name: PolicyName) -> OwnPolicy:
    """A fresh policy of the user's.

    Raises BadInput as `load`, and when its class or factory cannot be called.
    """
    found, file = load(name)
    try:
        inner = PerVehicle(found) if _takes_one(found) else found()
    except Exception as error:
        raise raised(error, name.place, name.member) from error
    return OwnPolicy(inner, name, file)


def raised(error: BaseException, place: object, what: str) -> BadInput:
    """What his code raised, in one line; of a file of his the deepest line that is in it."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(place)]
    where = f"{place}:{lines[-1]}" if lines else place
    return BadInput(f"{type(error).__name__}: {error}", file=where, field=what)


def _takes_one(found: Any) -> bool:
    """Whether it is a function that must be given something: a view."""
    if not inspect.isfunction(found):
        return False
    needed = [p for p in inspect.signature(found).parameters.values() if p.default is p.empty]
    return bool([p for p in needed if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)])


def _module(name: PolicyName) -> ModuleType:
    """A file is imported once a process, with its folder on the path, as if it were run."""
    try:
        if not name.place.endswith(".py"):
            return importlib.import_module(name.place)
        path = Path(name.place)
        known = f"cosim_own_{path.stem}_{hashlib.sha256(name.place.encode()).hexdigest()[:8]}"
        if known in sys.modules:
            return sys.modules[known]
        spec = importlib.util.spec_from_file_location(known, path)
        assert spec is not None and spec.loader is not None  # noqa: PT018
        module = importlib.util.module_from_spec(spec)
        if str(path.parent) not in sys.path:
            sys.path.insert(0, str(path.parent))
        sys.modules[known] = module  # dataclasses and pickle look there
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[known]
            raise
        return module
    except Exception as error:
        raise raised(error, name.place, "import") from error
