"""The page of what another action would have changed adds up what was at stake, not how often."""

from __future__ import annotations

import numpy as np

from benchmarks.action_values import Drawn, row


def cells(*episodes: Drawn) -> list[str]:
    return [cell.strip() for cell in row("net", episodes).strip("|").split("|")]


def test_what_was_at_stake_is_added_up() -> None:
    right = Drawn(true=np.array([-3.0, -0.01]), found=np.array([-0.3, -0.2]))
    wrong = Drawn(true=np.array([1.0, 0.0]), found=np.array([-0.1, -0.2]))
    name, episodes, copies, matter, size, rightly, lost, *_ = cells(right, wrong)
    assert (name, episodes, copies, matter, size) == ("net", "2", "4", "2", "2.00")
    assert rightly.startswith("75 ("), "3 of 4 at stake; what matters to nobody does not count"
    assert lost.startswith("0.250 ("), "half a unit in one of two episodes"


def test_drives_without_copies_say_nothing() -> None:
    none = Drawn(np.zeros(0), np.zeros(0))
    assert cells(none)[2:] == ["0", "0", "nan", "- %", "-", "nan", "-", "-"]


def test_what_is_valued_apart_is_shown_apart() -> None:
    """By the copies oneself loses 2 and the others nothing; the network says 1 and 6."""
    apart = np.array([[[-2.0, 0.0], [2.0, 0.0]], [[-1.0, 6.0], [1.0, -6.0]]])
    assert cells(Drawn(np.array([-2.0, 2.0]), apart[1].sum(1), apart))[-2:] == [
        "2.00, 1.00, 1.00",
        "0.00, 6.00",
    ]
    assert cells(Drawn(np.array([-2.0, 2.0]), apart[1].sum(1)))[-2:] == ["-", "-"]


def test_a_network_that_did_not_drive_is_judged_by_what_it_values_more() -> None:
    """It would have done the other action, and would have gained 3 by that, not lost them."""
    apart = np.array([[[3.0, 0.0], [1.0, 1.0]], [[1.0, 2.0], [1.0, 3.0]]])
    drawn = Drawn(true=np.array([3.0, 2.0]), found=np.array([0.5, 0.7]), apart=apart)
    assert cells(drawn)[5].startswith("0 ("), "who drove chose wrongly"
    assert cells(drawn.by_values())[5].startswith("100 (")
