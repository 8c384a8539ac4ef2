"""Entries are seen in the very step, on the very link, and who has the right of way is named with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.workers.worker import Worker

STEPS = 1200
SLOW = 0.05  # m/s, below which the least speed is not looked for


class Drive:
    """Drives a world with all vehicles watched, as AVs that disregard signals or as SUMO drives them."""

    def __init__(self, configuration: Path) -> None:
        import libsumo

        quiet = ["--no-step-log", "true", "--no-warnings", "true", "--step-length", "0.1"]
        libsumo.start(["sumo", "-c", str(configuration), "--lanechange.duration", "2", "--seed", "7", *quiet])
        self._configuration = configuration

    def compare(self, speed_mode: int) -> tuple[list[Any], list[Any]]:
        """What the watcher reports, and what a look at everybody in every step finds: s, id, lane inside,
        least speed m/s, the signal's state, and the foes inside the junction; of who leaves the place where
        one waits inside, the speed, and "inside" for the state."""
        import libsumo

        from cosim.simulation.convert import read_road
        from cosim.simulation.entries import EntryWatcher

        get = libsumo.vehicle
        road = read_road((), self._configuration)
        watcher = EntryWatcher(road, 0.1)
        before: dict[str, int] = {}
        last: dict[str, list[tuple[float, float]]] = {}  # (odometer, speed) of every step
        seen, found = [], []
        for _ in range(STEPS):
            libsumo.simulationStep()
            now = round(libsumo.simulation.getTime(), 1)
            departed = libsumo.simulation.getDepartedIDList()
            for name in departed:
                get.setSpeedMode(name, speed_mode)
            for entry in watcher.step(now, departed):
                here = road.lanes[road.links[entry.link].via].start
                inside = {name for name, _ in entry.foes if self._junction(road, name) == here}
                what = entry.vehicle, road.links[entry.link].via, round(max(entry.least_speed, SLOW), 3)
                seen.append((now, *what, "inside" if entry.inside else entry.state, sorted(inside)))
            for name in get.getIDList():
                lane = road.index[get.getLaneID(name)]
                was, before[name] = before.get(name, lane), lane
                via = road.lanes[lane]
                if via.internal and not road.lanes[was].internal:
                    number = next(k for k, link in enumerate(road.links) if link.via == lane)
                    link = road.links[number]
                    line = get.getDistance(name) - get.getLanePosition(name)
                    least = min(v for at, v in last[name] if at >= line - 10.0)
                    state = self._state(road, link.signal)
                    inside = self._inside(road, link) if state != "G" else set()
                    if link.signal >= 0 or link.foes:
                        found.append(
                            (now, name, lane, round(max(least, SLOW), 3), state, sorted(inside - {name}))
                        )
                elif via.internal and lane in road.lanes[was].successors:
                    link = next((link for link in road.links if link.via == was), None)
                    if link is not None and link.foes:
                        speed = round(max(get.getSpeed(name), SLOW), 3)
                        foes = sorted(self._inside(road, link) - {name})
                        found.append((now, name, was, speed, "inside", foes))
                last.setdefault(name, []).append((get.getDistance(name), get.getSpeed(name)))
        return sorted(seen), sorted(found)

    def _inside(self, road: Any, link: Any) -> set[str]:
        """Who is inside the junction on the way of a link with the right of way over this one."""
        import libsumo

        inside: set[str] = set()
        for foe in link.foes:
            if self._state(road, road.links[foe].signal) in ("r", "u"):
                continue
            way = road.links[foe].via
            while road.lanes[way].internal:
                inside |= set(libsumo.lane.getLastStepVehicleIDs(road.lanes[way].id))
                way = road.lanes[way].successors[0]
        return inside

    @staticmethod
    def _junction(road: Any, name: str) -> str:
        """The junction in which a vehicle is, "" for none."""
        import libsumo

        lane = road.lanes[road.index[libsumo.vehicle.getLaneID(name)]]
        return lane.start if lane.internal else ""

    @staticmethod
    def _state(road: Any, signal: int) -> str:
        import libsumo

        if signal < 0:
            return ""
        light, index = road.signals[signal]
        state: str = libsumo.trafficlight.getRedYellowGreenState(light)[index]
        return state

    def close(self) -> None:
        import libsumo

        libsumo.close()


@pytest.mark.parametrize("speed_mode", [31, 7])
@pytest.mark.parametrize("world", ["grid_signals", "stop_signs", "roundabout2"])
def test_the_watcher_sees_what_a_look_at_everybody_in_every_step_sees(
    law_worlds: dict[str, Path], world: str, speed_mode: int
) -> None:
    with Worker(Drive, law_worlds[world]) as worker:
        seen, found = worker.call("compare", speed_mode)
    assert len(found) > 10
    assert seen == found
