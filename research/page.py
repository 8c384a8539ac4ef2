"""The page of a claim, its picture and its CSV."""

from __future__ import annotations

import csv
import itertools
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.files import whole
from cosim.report import wording
from cosim.report.compare import PairedFigure
from cosim.report.figures import Measure
from cosim.workers.tasks import OK
from research import picture
from research.drive import Settings
from research.evaluate import Found, Line, traffic_of
from research.schema import Claim, Condition

OUT = Path("docs/results")
FEW = 2  # arms to compare with, so that the secondary figures are shown against each
WIDTH = 100  # columns of prose
# Columns of a table before the scenarios: head -> the option that the title of a block may give instead
COLUMNS = {"n": "", "preset": "preset", "errors": "errors", "sensing": "sensing", "drivers": "behavior"}
COLUMNS |= {"weights": ""}
TESTS = {"mcnemar": "McNemar's exact test", "signed_rank": "Wilcoxon's signed ranks"}
WORDS = {"yes": "Yes.", "no": "No.", "unresolved": "Unresolved."}


def write(found: Found, settings: Settings, out: Path) -> Path:
    """NAME.md, NAME.svg and data/NAME.csv; returns the page."""
    name = found.claim.name
    picture.draw(found, out / f"{name}.svg")
    write_csv(out / "data" / f"{name}.csv", found.lines())
    path = out / f"{name}.md"
    with whole(path) as draft:
        draft.write_text("\n".join(lines(found, settings)), encoding="utf-8")
    return path


def lines(found: Found, settings: Settings) -> list[str]:
    """The page: verdict, table, picture, conditions, tests, power, command."""
    claim, about = found.claim, (conditions(found, settings), f"{tests(found)} {powered(found)}")
    command = (
        f"Made by `python -m research page {claim.name}{flags(settings)}` ({claim.digest}); "
        f"`data/{claim.name}.csv`."
    )
    rows, same = table(found)
    return [
        *(f"# {claim.sentence}", "", *wrapped(verdict(found)), ""),
        *(*rows, "", f"![{claim.name}]({claim.name}.svg)", ""),
        *(
            line
            for text in filter(None, (same, arms(claim), claim.note, *about, command))
            for line in (*wrapped(text), "")
        ),
    ]


def wrapped(text: str) -> list[str]:
    """The text in lines of at most `WIDTH` columns."""
    return textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def verdict(found: Found) -> str:
    """`**No.** ...`: the answer, the effect with its interval, and the verdicts by condition."""
    claim = found.claim
    effects = [
        f"difference to `{against}` {_difference(one)}, {one.n} pairs"
        for against, one in found.overall.items()
    ]
    counts = {word: sum(t.verdict == word for t in found.tested) for word in WORDS}
    parts = [f"{n} {word}" for word, n in counts.items() if n]
    word = WORDS[found.verdict]
    if found.verdict == "yes" and counts["yes"] < len(found.tested):  # of a claim that must hold somewhere
        word = f"Yes, in {counts['yes']} of {len(found.tested)}."
    return (
        f"**{word}** Source: {claim.source}. "
        f"`{claim.primary.metric}` of `{claim.compare.arm}`: "
        f"{'; '.join(effects)}. By condition: {', '.join(parts)}."
    )


def table(found: Found) -> tuple[list[str], str]:
    """A row for every arm and difference, a column for every scenario; block by block of the matrix.

    Also a sentence of the columns that are left out because they are equal in all rows.
    """
    claim = found.claim
    primary = found.measures[claim.primary.metric]
    scenarios = list(dict.fromkeys(condition.scenario for condition, _ in found.arms))
    heads = [_column_head(primary, "%"), *COLUMNS, *scenarios]
    rows = []
    for values in dict.fromkeys(condition.values for condition, _ in found.arms):
        here = [Condition(scenario, values) for scenario in scenarios]
        if text := here[0].text:
            rows.append([f"**{text}**", *[""] * (len(heads) - 1)])
        for arm in claim.every_arm:
            figures = (_figure_cell(found, condition, arm) for condition in here)
            rows.append([_arm_name(found, here[0], arm), *_arm_cells(found, here, arm), *figures])
        rows += _differences(found, here)
    same = dict(_same(rows))
    titled = {number for number, option in enumerate(COLUMNS.values(), 1) if option in claim.matrix}
    kept = [number for number, _ in enumerate(heads) if number not in {*same, *titled}]
    shown = [[row[number] for number in kept] for row in (heads, ["---"] * len(heads), *rows)]
    about = ", ".join(f"{heads[number]} {value}" for number, value in same.items() if value != "-")
    return [f"| {' | '.join(row)} |" for row in shown], f"In all rows: {about}." if about else ""


def arms(claim: Claim) -> str:
    """What all arms have in common, and the options of each arm that neither the table nor its name gives."""
    shared = {name: value for name, value in claim.options.items() if name not in COLUMNS.values()}
    own = {
        arm: {name: value for name, value in options.items() if str(value).partition("=")[0] != arm}
        for arm, options in claim.every_arm.items()
    }
    parts = [f"Default: {_options(shared)}."] if shared else []
    return " ".join([*parts, *(f"`{arm}`: {_options(options)}." for arm, options in own.items() if options)])


def conditions(found: Found, settings: Settings) -> str:
    """Seeds, the paper's figures, shortened and failed episodes."""
    first = min(arm.seeds.start for arm in found.arms.values())
    failed = sum(row["status"] != OK for arm in found.arms.values() for row in arm.rows)
    parts = [f"Seeds from {first} on."]
    if found.claim.secondary:
        against = ", ".join(f"`{arm}`" for arm in _shown_against(found.claim))
        parts.append(f"Other figures: `{found.claim.compare.arm}`; difference to {against}.")
    for option in found.claim.pool:
        values = " and ".join(str(value) for value in found.claim.matrix[option])
        parts.append(f"Episodes of {option} {values} count together.")
    if found.claim.published:
        parts.append("Brackets and crosses are the paper's figures.")
    if any(arm.network for arm in found.arms.values()):
        parts.append("A network is one training: intervals leave out what another training would change.")
    if settings.duration is not None:
        parts.append(f"**Episodes are cut to {settings.duration:g} s.**")
    if failed:
        parts.append(f"{failed} episodes failed and are left out.")
    return " ".join(parts)


def tests(found: Found) -> str:
    """The paragraph on the statistical test."""
    claim = found.claim
    smallest = wording.number(claim.power.smallest, found.measures[claim.primary.metric], signed=True).lstrip(
        "+"
    )
    return (
        f"95 % intervals. p: {TESTS[claim.test]}, Holm's correction ({len(found.tested)} tests). "
        f"Smallest effect of interest: {smallest}, {claim.holds} "
        "([verdicts](../guides/reproduction.md#how-it-works))."
    )


def powered(found: Found) -> str:
    """The paragraph on the power of the tests."""
    known = [t.power for t in found.tested if not math.isnan(t.power)]
    span = f"{_span(round(100 * x) for x in known)} %" if known else "unknown"
    pairs = _span(t.found.n for t in found.tested)
    return f"Power: {span} ({pairs} pairs)."


def flags(settings: Settings) -> str:
    """The command's flags that affect the page."""
    default = Settings()
    words = [] if settings.scale == default.scale else [f"--scale {settings.scale:g}"]
    words += [f"--seeds {s.start}:{s.stop}" for s in [settings.seeds] if s is not None]
    words += [f"--scenario {name}" for name in settings.scenarios]
    words += [] if settings.duration is None else [f"--duration {settings.duration:g}"]
    words += ["--untrained"] if settings.untrained else []
    return " ".join(["", *words])


def write_csv(path: Path, found: Iterable[Line]) -> None:
    """Write the figures as CSV; NA is an empty cell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Line._fields)
        writer.writerows([_plain(value) for value in line] for line in found)


# ---- inside ----


def _same(rows: Sequence[Sequence[str]]) -> Iterator[tuple[int, str]]:
    """Columns about episodes that have one value in all rows: number and value. Block titles are empty."""
    for number in range(1, 1 + len(COLUMNS)):
        values = {row[number] for row in rows} - {""}
        if len(values) == 1:
            yield number, values.pop()


def _arm_name(found: Found, condition: Condition, name: str) -> str:
    label = found.arms[condition, name].label
    return f"{name} ({label})" if label else name


def _arm_cells(found: Found, here: Sequence[Condition], name: str) -> list[str]:
    arm = found.arms[here[0], name]
    count = _span(len(found.arms[c, name].rows) for c in here)
    return [count, *traffic_of(arm), arm.weights or "-"]


def _figure_cell(found: Found, condition: Condition, name: str) -> str:
    """`2.3 % (1.1 to 4.7)`, and the paper's figure in brackets."""
    measure = found.measures[found.claim.primary.metric]
    text = wording.interval(found.figure(condition, name, measure.name), measure, unit=False)
    published = found.claim.published.get(condition.scenario, {}).get(name)
    return text if published is None else f"{text} [{published:g}]"


def _options(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} `{value}`" for name, value in options.items())


def _differences(found: Found, here: Sequence[Condition]) -> Iterator[list[str]]:
    """Rows of the primary figure against each arm, and of the others (many arms: against the first)."""
    claim = found.claim
    _, *about = _arm_cells(found, here, claim.compare.arm)
    for against in claim.compare.against:
        tested = [t for c in here for t in found.tested if (t.condition, t.against) == (c, against)]
        texts = [f"{_difference(t.found, False)}, {wording.p_value(t.p_holm)}: {t.verdict}" for t in tested]
        yield [f"difference to {against}", _span(t.found.n for t in tested), *about, *texts]
    others = _shown_against(claim)
    for metric, against in itertools.product(claim.secondary, others):
        pairs = [found.difference(condition, against, metric) for condition in here]
        if not any(pair.n for pair in pairs):  # for example figures of AVs against an arm without any
            continue
        name = _column_head(found.measures[metric], "%") + (f", {against}" if len(others) > 1 else "")
        yield [name, _span(p.n for p in pairs), *about, *map(_level, pairs)]


def _shown_against(claim: Claim) -> Sequence[str]:
    """The arms against which the secondary figures are shown."""
    return claim.compare.against if len(claim.compare.against) <= FEW else claim.compare.against[:1]


def _difference(one: PairedFigure, unit: bool = True) -> str:
    return wording.interval(one.difference, one.measure, signed=True, unit=unit)


def _level(one: PairedFigure) -> str:
    """`3.0; +1.0 (+0.2 to +1.8)`: the claim's arm, and its difference."""
    if not one.b.known:
        return "NA"
    return f"{wording.number(one.b.value, one.measure, unit=False)}; {_difference(one, False)}"


def _column_head(measure: Measure, share: str) -> str:
    unit = share if measure.is_share else measure.unit
    return f"{measure.name}, {unit}" if unit else measure.name


def _span(counts: Iterable[int]) -> str:
    low, high = min(known := [*counts]), max(known)
    return str(low) if low == high else f"{low} to {high}"


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return "" if value is None else value
