"""Arms of a comparison: whose episodes are whose, and which of two arms' episodes are pairs."""

from __future__ import annotations

from cosim.report.compare import Compared, compare
from cosim.report.figures import Row
from cosim.report.pairing import Side
from cosim.report.run_folder import Run


def of_world(run: Run, world: str) -> list[Row]:
    """The rows of one world."""
    return [row for row in run.rows if row["scenario"] == world]


def differences(before: Run, after: Run) -> dict[str, Compared]:
    """World -> the pairs of both on equal seeds; arms may differ in their SVO.

    Raises BadInput when they have nothing in common.
    """
    groups = compare(Side(before), Side(after), across=("svo_deg",)).groups
    return {str(found.group.identity["scenario"]): found for found in groups}
