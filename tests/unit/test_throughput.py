"""Throughput of networks of other authors: every driver on the same seeds, arrivals beside no AVs."""

from __future__ import annotations

from pathlib import Path

from benchmarks import throughput


def test_a10kw_is_driven_on_every_seed_and_other_games_on_the_first() -> None:
    games = [Path("game/A10KW.sumocfg"), Path("game/grid6.sumocfg")]
    wanted = list(throughput.cases(games, range(5, 8), False, 60.0))
    assert len(wanted) == (3 + 1) * len(throughput.DRIVERS)
    assert {case.key[2] for case in wanted if case.key[0] == "grid6"} == {5}
    assert {case.options["what"] for case in wanted} == {str(game) for game in games}


def test_a_network_is_shown_where_all_drivers_drove_it_and_with_an_interval_of_five_seeds() -> None:
    shares = dict(zip(throughput.DRIVERS, (1.0, 0.9, 0.95, 1.1, 1.0), strict=True))
    rows = [
        throughput.Drive("A10KW", driver, seed, round(share * (1000 + seed)), 40.0, 1, 2, 1)
        for seed in range(6)
        for driver, share in shares.items()
    ]
    rows.append(throughput.Drive("grid6", throughput.NONE, 0, 100, 1.0, 0, 0, 0))
    text = "\n".join(throughput.page(rows, 900.0))
    assert "| A10KW | 6 | no AVs | 1,002 |  | 40 |  |  |  |" in text
    assert "| A10KW | 6 | `idm` | 902 | -10.0 % (" in text
    assert "| +10.0 % (" in text
    assert ") | 40 | 6 | 12 | 6 |" in text
    assert "grid6" not in text
