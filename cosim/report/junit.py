"""A comparison as a JUnit file, which every CI server reads: one test case per threshold and group."""

from __future__ import annotations

import re
from pathlib import Path

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from cosim.files import whole
from cosim.report.compare import FAILED, SKIPPED, Check, Comparison
from cosim.report.pairing import Group

_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write(comparison: Comparison, path: Path) -> None:
    """Write it whole or not at all. Raises OSError."""
    suite = TestSuite("cosim compare")
    suite.add_property("a", _clean(comparison.a))
    suite.add_property("b", _clean(comparison.b))
    suite.add_property("verdict", _clean(comparison.verdict))
    for check in comparison.checks:
        suite.add_testcase(_case(check))
    for compared in comparison.groups:
        if compared.group.failed or compared.group.refused:
            suite.add_testcase(_broken(compared.group))
    suites = JUnitXml("cosim compare")
    suites.add_testsuite(suite)
    suites.update_statistics()  # type: ignore[no-untyped-call]
    with whole(path) as draft:
        suites.write(str(draft), pretty=True)


def _case(check: Check) -> TestCase:
    case = TestCase(_clean(check.threshold.text), classname=_clean(check.group.name))
    message = _clean(f"{check.finding}; {check.figures}" if check.figures else check.finding)
    if check.status == FAILED:
        case.result = [Failure(f"{check.threshold.measure.name}: {message}", "threshold")]
    elif check.status == SKIPPED:
        case.result = [Skipped(message)]
    else:
        case.system_out = message
    return case


def _broken(group: Group) -> TestCase:
    """Simulations that gave no figures: no threshold can speak for them."""
    case = TestCase("every simulation finished", classname=_clean(group.name))
    rows = [*group.failed, *group.refused]
    lines = [f"{row['key']} {row['status']}: {row.get('error') or 'no reason given'}" for row in rows]
    case.result = [Error(_clean(f"{len(rows)} did not: {lines[0]}"), "simulation")]
    case.system_err = _clean("\n".join(lines))
    return case


def _clean(text: str) -> str:
    """Without the characters that XML has no place for."""
    return _NOT_XML.sub("?", text)
