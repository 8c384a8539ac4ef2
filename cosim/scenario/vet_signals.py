"""Checks traffic light programs of a net or additional file for faults that SUMO refuses or misreads."""

from collections.abc import Mapping
from pathlib import Path

from cosim.errors import BadInput
from cosim.scenario.vet_rules import Place, Reader, seconds

STATES = frozenset("rugGyYsoO")  # a signal's letters in a phase (SUMO, Simulation/Traffic_Lights)
OFF = "off"  # a type and a programID: the signal is switched off
PHASELESS = frozenset({"rail_signal", "rail_crossing", OFF})  # types without phases in the file


class SignalReader(Reader):
    """The handlers of one pass for the elements tlLogic and phase; `programs` is the result."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.programs: dict[tuple[str, str], int] = {}  # (id, programID) -> signals per phase
        self._owner = ""
        self._needs_phases = False
        self._opened: Place | None = None
        self._signals: int | None = None  # of the phases so far

    def start(self, tag: str, attributes: Mapping[str, str], line: int) -> None:
        """An element opens."""
        if tag == "tlLogic":
            self._owner = attributes.get("id", "")
            if not self._owner:
                self._refuse(tag, "id", "", "is missing", "", line)
            key = (self._owner, attributes.get("programID", ""))
            if key in self.programs:
                self._refuse(tag, "programID", key[1], "is there twice", self._owner, line)
            self._needs_phases = attributes.get("type", "static") not in PHASELESS and key[1] != OFF
            self._opened, self._signals = Place(self._path, "tlLogic.id", self._owner, line), None
            self.programs[key] = 0
        elif tag == "phase" and self._opened is not None:
            self._phase(attributes, line)

    def end(self, tag: str) -> None:
        """An element closes."""
        if tag == "tlLogic" and self._opened is not None:
            if self._signals is None and self._needs_phases:
                raise self._opened.wrong("has no phase", self._owner)
            self.programs[next(reversed(self.programs))] = self._signals or 0
            self._opened = None

    def _phase(self, attributes: Mapping[str, str], line: int) -> None:
        state = attributes.get("state", "")
        if not state:
            self._refuse("phase", "state", state, "is missing", self._owner, line)
        if unknown := sorted(set(state) - STATES):
            problem = f"{unknown[0]!r} is no state of a signal ({''.join(sorted(STATES))})"
            self._refuse("phase", "state", state, problem, self._owner, line)
        if self._signals not in (None, len(state)):
            problem = f"has {len(state)} signals, the phases before it have {self._signals}"
            self._refuse("phase", "state", state, problem, self._owner, line)
        self._signals = len(state)
        duration = attributes.get("duration")
        if self._needs_phases and not seconds(duration) > 0.0:
            problem = "is missing" if duration is None else "must be more than 0"
            self._refuse("phase", "duration", duration or "", problem, self._owner, line)


def check_lengths(path: Path, programs: Mapping[tuple[str, str], int], needed: Mapping[str, int]) -> None:
    """Raises BadInput if a program of `path` has fewer signals than its connections need, by id."""
    for (name, program), signals in programs.items():
        if 0 < signals < needed.get(name, 0):
            problem = (
                f"has {signals} signals in each phase, its connections need {needed[name]} (tlLogic {name})"
            )
            raise BadInput(problem, file=path, field="tlLogic.programID", value=program)
