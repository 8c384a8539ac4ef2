"""Checks the files of the smoke test in /results as users read them: JSON, Parquet, JUnit, HTML."""

import json
import re
import sys
from pathlib import Path

import junitparser
import pyarrow.parquet

RESULTS = Path("/results")


def main() -> int:
    """Raises AssertionError at the first file that is wrong."""
    run = json.loads((RESULTS / "run.json").read_text())
    assert run["scenario"] == "merge", run["scenario"]
    assert run["steps"] > 50, run["steps"]
    assert re.fullmatch("[0-9a-f]{64}", run["trace_hash"]), run["trace_hash"]

    rows = pyarrow.parquet.read_table(RESULTS / "builtin" / "episodes.parquet").to_pylist()
    assert len({row["key"] for row in rows}) == len(rows) == 9, len(rows)
    assert {row["status"] for row in rows} == {"ok"}, rows
    again = next(r for r in rows if r["policy"] == "idm" and r["seed"] == run["seed"])
    assert again["trace_hash"] == run["trace_hash"], "one episode, run alone and in a batch, differs"

    mine = pyarrow.parquet.read_table(RESULTS / "mine" / "episodes.parquet").to_pylist()
    assert len(mine) == 8, len(mine)
    assert {row["status"] for row in mine} == {"ok"}, mine
    assert len({row["demand"] for row in mine}) == 2, {row["demand"] for row in mine}
    assert {row["penetration"] for row in mine} == {0.3}, mine

    failures = {}
    for name in ("pass", "fail"):
        file = junitparser.JUnitXml.fromfile(str(RESULTS / f"gate-{name}.xml"))
        failures[name] = (file.tests, file.failures)
    assert failures["pass"][0] >= 1, failures
    assert failures["pass"][1] == 0, failures
    assert failures["fail"][1] >= 1, failures
    assert (RESULTS / "gate-fail.md").read_text().strip()

    for folder in ("builtin", "mine"):
        page = (RESULTS / folder / "report.html").read_text()
        loaded = re.findall(r"""(?:src|href)\s*=\s*["']?((?:https?:)?//[^"'\s>]+)""", page)
        assert "</html>" in page, folder
        assert not loaded, f"report of {folder} reaches for {loaded[:3]}"
    print(f"{len(rows)} + {len(mine)} rows, 2 JUnit files, 2 reports")
    return 0


if __name__ == "__main__":
    sys.exit(main())
