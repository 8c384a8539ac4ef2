"""The page of what a network learned pairs arms on equal seeds and leaves out what was not driven."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import learned
from cosim.report import run_folder


def row(policy: str, svo: float, seed: int, served: bool, errors: str | None = None) -> dict[str, object]:
    return {
        "policy": policy,
        "svo_deg": svo,
        "scenario": "merge",
        "errors": errors,
        "seed": seed,
        "status": "ok",
        "mission_success": served,
        "mission_time_s": 20.0 if served else None,
        "av_involved_collisions": 0 if served else 1,
        "dt_av_m": 600.0,
        "dt_mean_m": 610.0,
    }


def test_arms_are_paired_on_equal_seeds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    weights = tmp_path / "weights.safetensors"
    weights.touch()
    mine = [row("net", 60.0, seed, True) for seed in range(6)] + [row("net", 0.0, 0, False)]
    theirs = [row("idm", 60.0, seed, seed == 5) for seed in range(2, 9)]
    parts = {"network": mine, "others": theirs}
    monkeypatch.setattr(run_folder, "read", lambda folder: SimpleNamespace(rows=parts[folder.name]))
    page = "\n".join(learned.page(Path("runs"), f"net={weights}", ["idm"], ["none", "stress"], ["about"]))
    assert "## merge, errors `none`" in page
    assert "stress" not in page, "nothing was driven there"
    assert "## exit" not in page
    assert "| net at 60 degrees | 6 | 100 %" not in page, "shares have intervals"
    assert "| net at 60 degrees | 6 | 100 (61 to 100) % | 20.0" in page
    assert "- less idm at 60 degrees (4 pairs): served 75 (" in page
    assert "episodes with an AV in a collision -75 (" in page
    assert "- less net at 0 degrees (1 pairs)" in page
