"""What is counted of collisions that forks avoid."""

from __future__ import annotations

from benchmarks.avoidable import Outcome, line
from cosim.report.result import error_of
from cosim.types import Collision, HumanError


def collision(time: float) -> Collision:
    return Collision(time, "hv.1", "av.1", False, True, "collision", "sumo", "a_0", 0.0, 0.0)


def test_the_last_error_with_a_part_in_it_is_found() -> None:
    errors = [
        HumanError(10.0, "hv.1", "inattention", 14.0, ""),
        HumanError(15.0, "hv.2", "hard_braking", 16.0, "", near="av.1"),
        HumanError(17.0, "hv.3", "cut_in", 19.0, "", near="hv.4"),
    ]
    assert error_of(collision(18.0), errors) == errors[1]
    assert error_of(collision(12.0), errors) == errors[0]
    assert error_of(collision(9.0), errors) is None
    assert error_of(collision(30.0), errors) is None, "remembered for five seconds"


def test_a_line_counts_what_was_avoidable_of_what_collided() -> None:
    outcomes = [
        Outcome("idm", "merge", 1, False),
        Outcome("idm", "merge", 2, True, False, "cut_in", 2.0, "brakes hard", 1.0),
        Outcome("idm", "merge", 3, True, False, "cut_in", 2.0, "goes left", 3.0),
        Outcome("idm", "merge", 4, True),
    ]
    cells = line("merge", "idm", outcomes)
    assert cells[3:6] == ["4", "3: 75.0 (30.1 to 95.4) %", "2 of 3"]
    assert cells[6].startswith("2: 67 ")
    assert cells[7:] == ["1", "0", "0", "1", "2.0"]
