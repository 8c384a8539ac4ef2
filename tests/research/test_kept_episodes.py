"""The kept episodes of what changes most, the car and the scripts, are those that today's code drives."""

from __future__ import annotations

from research import audit, drive, kept
from research.drive import Settings
from research.schema import chosen

CLAIM = "label_free"
SCRIPTS = {"car-alone", "yield-rule", "altruist-rule"}


def test_kept_episodes_of_car_and_scripts_are_those_of_today() -> None:
    """Identities hold no source code: whoever changes how the car drives must drive the claims again."""
    settings = Settings(workers=1, scenarios=("merge", "exit"))
    work = drive.planned([*chosen([CLAIM])], settings)
    rows = {
        row["policy"]: row
        for row in kept.episodes(settings.kept).rows
        if row["cell"] in work.wanted and row["policy"] in SCRIPTS
    }
    again = audit.driven_again([*rows.values()], work, settings)

    assert {*rows} == SCRIPTS
    assert [again[row["key"]]["trace_hash"] for row in rows.values()] == [
        row["trace_hash"] for row in rows.values()
    ]
