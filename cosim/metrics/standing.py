"""Standing AVs: blocked junctions, and AVs that stand for long without a reason."""

from collections.abc import Sequence

import numpy as np

from cosim.geometry import gap_ahead
from cosim.metrics.context import AV, MetricContext, slow
from cosim.metrics.law import AvCounts, Ways, persons_near
from cosim.road import Crossing
from cosim.types import Metric, Offence, Snapshot

STANDSTILL = 0.1  # m/s, SUMO's own threshold of a halting vehicle
BLOCKED_AFTER = 5.0  # s inside a junction
STUCK_AFTER = 60.0  # s
QUEUE_GAP = 10.0  # m, gap to the vehicle ahead in a queue
BRAKING = -0.1  # m/s2
CLOSED = frozenset(map(ord, "ruyY"))  # red and yellow states of a signal


class Standing(AvCounts):
    """figures.md, The law: `junctions_blocked` and `avs_stuck`."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._road = context.road
        self._signals: dict[int, tuple[int, ...]] = {}  # lane -> the signals of its links
        self._crossings: dict[int, tuple[Crossing, ...]] = {}  # lane -> over its links, or over its own one
        ways = Ways(context.road)
        for number, link in enumerate(context.road.links):
            if link.signal >= 0:
                self._signals[link.origin] = (*self._signals.get(link.origin, ()), link.signal)
            if over := ways.crossings(number):
                for lane in (link.origin, *context.road.inside[number]):
                    self._crossings[lane] = (*self._crossings.get(lane, ()), *over)
        self._waiting: dict[str, float] = {}  # AV -> s, since when it stands without a reason
        self._inside: dict[str, tuple[str, float]] = {}  # AV -> the junction in which it stands, since (s)
        self._stuck: set[str] = set()
        self._wrecks: set[str] = set()
        self._blocked: set[tuple[str, str, float]] = set()
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        s = snapshot
        self._wrecks.update(s.events.wrecked)
        any_stands = slow(s.kind, s.speed, AV, STANDSTILL)
        standing = np.flatnonzero((s.kind == AV) & (s.speed < STANDSTILL)).tolist() if any_stands else ()
        inside, waiting = self._inside, self._waiting
        self._inside, self._waiting = {}, {}
        reasons = self._reasons(s, standing) if standing else frozenset()
        for row in standing:
            if (name := s.ids[row]) in self._wrecks:
                continue
            self._waiting[name] = since = s.time if row in reasons else waiting.get(name, s.time)
            if s.time - since > STUCK_AFTER and name not in self._stuck:
                self._stuck.add(name)
                self.offences.append(Offence(s.time, name, f"stood for {STUCK_AFTER:.0f} s without a reason"))
            if junction := self._blocks(int(s.lane[row])):
                before = inside.get(name)
                here = before if before and before[0] == junction else (junction, s.time)
                self._inside[name] = here
                if s.time - here[1] > BLOCKED_AFTER and (name, *here) not in self._blocked:
                    self._blocked.add((name, *here))
                    self.offences.append(Offence(s.time, name, f"blocked junction {junction}"))

    def result(self) -> dict[str, Metric]:
        return {
            "junctions_blocked": self.count(len(self._blocked), "times"),
            "avs_stuck": self.count(len(self._stuck), "vehicles"),
        }

    def _blocks(self, number: int) -> str:
        """The junction blocked by a vehicle that stands on this lane, "" for none."""
        if number < 0 or not self._road.lanes[number].internal or self._road.waits_inside(number):
            return ""
        return self._road.lanes[number].start

    def _reasons(self, s: Snapshot, standing: Sequence[int]) -> frozenset[int]:
        """The rows among `standing` with a reason to stand, of their own or of the head of their queue; a
        human head of a queue needs no reason."""
        queued = np.flatnonzero((s.speed < STANDSTILL) | (s.accel < BRAKING))
        _, leaders = gap_ahead(s, self._road.straight_on, queued, QUEUE_GAP)
        ahead = dict(
            zip(queued.tolist(), leaders.tolist(), strict=True)
        )  # row -> row of the next, -1 for none
        planned, lanes = set(s.events.stopped), s.lane.tolist()
        waits: dict[int, bool] = {}  # lane -> whether a signal at its end, or a person, asks to wait
        found: dict[int, bool] = {}
        for row in standing:
            queue = []
            while row in ahead and row not in found:
                queue.append(row)
                if (lane := lanes[row]) not in waits:
                    waits[lane] = self._at_signal(s, lane) or self._for_persons(s, lane)
                alone = ahead[row] not in ahead and s.kind[row] != AV
                found[row] = waits[lane] or s.ids[row] in planned or alone
                if found[row]:
                    break
                row = ahead[row]
            if found.get(row, False):
                found.update(dict.fromkeys(queue, True))
        return frozenset(row for row in standing if found[row])

    def _at_signal(self, s: Snapshot, lane: int) -> bool:
        """Whether a signal at the end of the lane is red or yellow."""
        return any(k < len(s.signals) and int(s.signals[k]) in CLOSED for k in self._signals.get(lane, ()))

    def _for_persons(self, s: Snapshot, lane: int) -> bool:
        """Whether a person is on a crossing over the lane's paths through the junction."""
        return any(persons_near(s, one, 0.5 * one.width) for one in self._crossings.get(lane, ()))
