"""A comparison for people and machines: text for a terminal, Markdown for a pull request, JSON, JUnit."""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from cosim.files import whole
from cosim.report import wording
from cosim.report.changes import changes
from cosim.report.compare import FAILED, PASSED, SKIPPED, Compared, Comparison, PairedFigure
from cosim.report.figures import HEADLINE, INCIDENCES, Row
from cosim.report.pairing import Group, driver
from cosim.report.result import EVERYBODY, LAW
from cosim.report.summary import not_comparable, reasons

_MARK = {PASSED: "pass", FAILED: "FAIL", SKIPPED: "n/a "}
_EMOJI = {PASSED: "✅ pass", FAILED: "❌ **fail**", SKIPPED: "n/a"}
COLUMNS = 100  # of a terminal
_INDENT, _GAP = "  ", "  "  # of a table's lines, and between its columns
_MAX_LISTED = 20  # failed simulations, and unmatched cells of one side, that are listed by name
_FORBIDDEN_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class _Cell:
    """One cell of a table."""

    value: str
    bounds: str = ""  # `4.4 to 26.1`
    count: str = ""  # `3/40`, or the p of a difference
    pairs: str = ""  # `37 pairs`, where they are not all

    @property
    def line(self) -> str:
        """`12.5 % (4.4 to 26.1), 3/40`"""
        value = f"{self.value} ({self.bounds})" if self.bounds else self.value
        return ", ".join(filter(None, (value, self.count, self.pairs)))

    @property
    def lines(self) -> tuple[str, str]:
        """The value with its count, and below it the interval: narrower than `line`."""
        first, second = (self.value, self.count), (self.bounds and f"({self.bounds})", self.pairs)
        return ", ".join(filter(None, first)), ", ".join(filter(None, second))


def document(comparison: Comparison) -> dict[str, Any]:
    """Plain JSON values."""
    return {
        "a": comparison.a,
        "b": comparison.b,
        "verdict": comparison.verdict,
        "exit_code": comparison.exit_code,
        "unfinished": [*comparison.unfinished],
        "checks": [
            {
                "threshold": check.threshold.text,
                "group": check.group.name,
                "status": check.status,
                "finding": check.finding,
            }
            for check in comparison.checks
        ],
        "groups": [_group_document(compared) for compared in comparison.groups],
        "only_in_a": comparison.unmatched[0],
        "only_in_b": comparison.unmatched[1],
    }


def text(comparison: Comparison) -> str:
    """Tables and verdict for a terminal."""
    lines = [f"A  {comparison.a}", f"B  {comparison.b}"]
    lines += [part for line in _unfinished(comparison) for part in _wrapped(line, "")]
    lines.append("")
    for compared in comparison.groups:
        notes = (*_notes(compared), *changes(compared.figures).lines)
        lines += [*_wrapped(compared.group.name, ""), *(part for note in notes for part in _wrapped(note))]
        lines += _table([_cells(figure) for figure in _shown(comparison, compared)])
        for check in comparison.checks:
            if check.group is compared.group:
                lines += _wrapped(f"{_MARK[check.status]}  {check.threshold.text}:  {check.finding}")
        lines.append("")
    lines += [part for line in _unmatched(comparison) for part in _wrapped(line, "")]
    return "\n".join([*lines, comparison.verdict])


def markdown(comparison: Comparison) -> str:
    """Tables and verdict for a pull request comment."""
    lines = [f"### cosim compare: {comparison.verdict}", ""]
    lines += [f"A: `{comparison.a}`, B: `{comparison.b}`; 95 % intervals, pairs on equal seeds", ""]
    lines += [part for line in _unfinished(comparison) for part in (f"**{_html(line)}**", "")]
    if comparison.checks:
        lines += ["| | fails on | group | finding |", "|---|---|---|---|"]
        for check in comparison.checks:
            group, finding = _html(check.group.name), _html(check.finding)
            lines.append(_row((_EMOJI[check.status], f"`{check.threshold.text}`", group, finding)))
        lines.append("")
    for compared in comparison.groups:
        lines += ["<details>", f"<summary>{_html(compared.group.name)}</summary>", ""]
        lines += [f"{_html(note)}  " for note in (*_notes(compared), *changes(compared.figures).lines)]
        lines += ["", "| | A | B | B - A |", "|---|---|---|---|"]
        for figure in _shown(comparison, compared):
            lines.append(_row([_html(cell.line) for cell in _cells(figure)]))
        lines += ["", "</details>", ""]
    lines += [f"{_html(line)}  " for line in _unmatched(comparison)]
    return "\n".join(lines).rstrip() + "\n"


def junit(comparison: Comparison, path: Path) -> None:
    """Write the JUnit file for CI servers atomically.

    It has a test case per threshold and group, one per group with simulations without figures, and one if the
    batch is unfinished. Raises OSError.
    """
    suite = TestSuite("cosim compare")
    for name, value in (("a", comparison.a), ("b", comparison.b), ("verdict", comparison.verdict)):
        suite.add_property(name, _clean(value))
    for check in comparison.checks:
        case = TestCase(_clean(check.threshold.text), classname=_clean(check.group.name))
        message = _clean(f"{check.finding}; {check.figures}" if check.figures else check.finding)
        if check.status == FAILED:
            case.result = [Failure(f"{check.threshold.measure.name}: {message}", "threshold")]
        elif check.status == SKIPPED:
            case.result = [Skipped(message)]
        else:
            case.system_out = message
        suite.add_testcase(case)
    if comparison.undecided:
        case = TestCase("every episode was driven", classname="cosim compare")
        case.result = [Error(_clean("; ".join(comparison.unfinished)), "unfinished")]
        suite.add_testcase(case)
    for group in (compared.group for compared in comparison.groups):
        if rows := [*group.failed, *group.refused]:
            case = TestCase("every simulation finished", classname=_clean(group.name))
            lines = [f"{row['key']} {row['status']}: {_reason(row)}" for row in rows]
            case.result = [Error(_clean(f"{len(rows)} did not: {lines[0]}"), "simulation")]
            case.system_err = _clean("\n".join(lines))
            suite.add_testcase(case)
    suites = JUnitXml("cosim compare")
    suites.add_testsuite(suite)
    suites.update_statistics()  # type: ignore[no-untyped-call]
    with whole(path) as draft:
        suites.write(str(draft), pretty=True)


# ---- inside ----


def _reasons(group: Group) -> str:
    """Why episodes of the pairs are not comparable."""
    return "; ".join(reasons([row for pair in group.pairs for row in pair if not_comparable(row)]))


def _pairs(count: int) -> str:
    return wording.counted(count, "pair")


def _wrapped(note: str, indent: str = "  ") -> list[str]:
    """Lines of at most `COLUMNS` columns; longer words are not broken."""
    wrapper = textwrap.TextWrapper(COLUMNS, indent, "    ", break_on_hyphens=False, break_long_words=False)
    return wrapper.wrap(note)


def _table(rows: Sequence[Sequence[_Cell]]) -> list[str]:
    """The table for a terminal: values, and below them their intervals.

    A name that leaves no room for its values within `COLUMNS` has a line of its own.
    """
    table = [tuple(map(_Cell, ("", "A", "B", "B - A"))), *rows]
    names = [row[0].value for row in table]
    columns = [[part for row in table for part in row[k].lines] for k in (1, 2, 3)]
    widths = [max(map(len, column)) for column in columns]
    room = COLUMNS - len(_INDENT) - sum(len(_GAP) + width for width in widths)
    first = max((len(name) for name in names if len(name) <= room), default=0)
    lines = []
    for name, (_, *cells) in zip(names, table, strict=True):
        above, beside = (name, "") if len(name) > first else ("", name)
        values, bounds = zip(*(cell.lines for cell in cells), strict=True)
        both = ((beside, *values), ("", *bounds))
        lines += [above, *(_GAP.join(map(str.ljust, texts, (first, *widths))) for texts in both)]
    return [(_INDENT + line).rstrip() for line in lines if line.strip()]


def _clean(text: str) -> str:
    """The text without the characters that XML forbids."""
    return _FORBIDDEN_IN_XML.sub("?", text)


def _reason(row: Row) -> str:
    return str(row.get("error") or "no reason given")


def _group_document(compared: Compared) -> dict[str, Any]:
    group = compared.group
    return {
        **group.identity,
        "name": group.name,
        "a": group.a,
        "b": group.b,
        "pairs": len(group.pairs),
        "identical": group.identical,
        "not_comparable": group.not_comparable,
        "mission_guessed": group.mission_guessed,
        "human_errors": dict(zip(("a", "b", "both"), group.errors_begun, strict=True)),
        "failed": [row["key"] for row in group.failed],
        "refused": [row["key"] for row in group.refused],
        "only_in_a": group.unpaired[0],
        "only_in_b": group.unpaired[1],
        **asdict(changes(compared.figures)),
        "figures": {name: figure.document() for name, figure in compared.figures.items()},
    }


def _shown(comparison: Comparison, compared: Compared) -> list[PairedFigure]:
    """Figures of the table that apply: of the headline and of thresholds.

    Figures of all vehicles, of the law and of near-misses are included if they are not 0.
    """
    gated = [check.threshold.measure.name for check in comparison.checks]
    always = {*HEADLINE, *gated}
    names = dict.fromkeys((*HEADLINE, *EVERYBODY, *INCIDENCES, *LAW, *gated))
    figures = [compared.figures[name] for name in names if name in compared.figures]
    return [f for f in figures if f.n and (f.measure.name in always or f.a.value or f.b.value)]


def _cells(figure: PairedFigure) -> tuple[_Cell, _Cell, _Cell, _Cell]:
    """Name, A, B, B - A."""
    m = figure.measure
    arrow = {"higher": " ↑", "lower": " ↓"}.get(m.better, "")
    n = figure.n
    p = "" if figure.p is None or n < wording.SEVERAL else wording.p_value(figure.p)
    difference = wording.value_and_bounds(figure.difference, m, signed=True, unit=not m.per, n=n)
    # The unit stands beside the difference, and beside A and B of a share; the name of an incidence has it.
    a, b = (wording.value_and_bounds(side, m, unit=m.is_share, n=n) for side in (figure.a, figure.b))
    counts_a, counts_b = figure.counts
    return (
        _Cell(m.name + arrow),
        _Cell(*a, counts_a),
        _Cell(*b, counts_b),
        _Cell(*difference, p, _pairs(n) if figure.na else ""),
    )


def _notes(compared: Compared) -> list[str]:
    """Lines above a group's table: number of pairs, policies, and limits of the comparison."""
    group = compared.group
    caution = " (a single pair cannot show a difference)" * (len(group.pairs) == 1)
    notes = [f"{_pairs(len(group.pairs))}{caution}, A {driver(group.a)}, B {driver(group.b)}"]
    counted = {
        f"{_pairs(group.identical)} drove exactly alike (same trace hash)": group.identical,
        f"{_pairs(group.not_comparable)} with an episode that is not comparable ({_reasons(group)})": (
            group.not_comparable
        ),
        f"{_pairs(group.mission_guessed)} with a guessed mission vehicle: its figures feed no gate": (
            group.mission_guessed
        ),
        f"{group.unpaired[0]} episodes of A have no partner and do not count": group.unpaired[0],
        f"{group.unpaired[1]} episodes of B have no partner and do not count": group.unpaired[1],
    }
    notes += [note for note, count in counted.items() if count]
    begun_a, begun_b, both = group.errors_begun
    if either := begun_a + begun_b - both:
        words = f"human errors: {begun_a} in A, {begun_b} in B"
        notes.append(f"{words}; {100 * both / either:.0f} % of all began in both, in the same second")
    for row in [*group.failed, *group.refused][:_MAX_LISTED]:
        notes.append(f"{row['status']} {row['key']} ({row['policy']}, seed {row['seed']}): {_reason(row)}")
    hidden = len(group.failed) + len(group.refused) - _MAX_LISTED
    return [*notes, f"and {hidden} more"] if hidden > 0 else notes


def _unfinished(comparison: Comparison) -> list[str]:
    """The driven part of an unfinished batch; [] for a finished one."""
    pairs = sum(len(compared.group.pairs) for compared in comparison.groups)
    return (
        [f"unfinished: {'; '.join(comparison.unfinished)}, {_pairs(pairs)}"] if comparison.unfinished else []
    )


def _unmatched(comparison: Comparison) -> list[str]:
    return [
        f"only in {side}, not compared: {'; '.join(names[:_MAX_LISTED])}"
        + (f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else "")
        for side, names in zip("AB", comparison.unmatched, strict=True)
        if names
    ]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _html(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")
