"""The worlds that ship, as benchmarks drive them: all of them, or those in which somebody needs help."""

from __future__ import annotations

from cosim.scenario import MISSIONS, load
from sumo_scenarios import names

_KIND = {name: load(name).mission.kind for name in names()}
WORLDS = tuple(sorted(_KIND, key=lambda name: MISSIONS.index(_KIND[name])))
WITH_MISSION = tuple(name for name in WORLDS if _KIND[name] != "none")
