"""One episode in words and a short table, beside one of another policy in the same traffic."""

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence

from cosim.report.result import EVERYBODY, LAW, NEAR_MISSES, figure
from cosim.scenario.policy_name import label
from cosim.scenario.traffic import CHECKS_INSIDE, in_words
from cosim.types import INSIDE, Collision, EpisodeResult, HumanError, Metric

COLUMNS = 100
NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"
# What a mission vehicle has to do, by the kind of mission, and that it did it.
MISSIONS = {
    "merge": ("merge", "merged"),
    "exit": ("leave at the exit", "left at the exit"),
    "roundabout": ("enter the roundabout", "entered the roundabout"),
    "intersection": ("cross the major road", "crossed the major road"),
}
REACH = ("reach its goal", "reached its goal")  # of a mission vehicle of a user's file
GUESSED = "guessed: its figures feed no gate (--mission ID names it, --mission none does without)"
REASONS = 4  # of interventions, that are listed
ALWAYS = ("collisions", "av_caused_collisions", "mission_success")  # rows that are shown even when they are 0
_PART = re.compile(r"^av_|_av$|_hv$|^worst|^veto")  # a row's name, of a part of another: not listed as 0
# The rows of the table, in words.
ROWS = {
    "mission_success": "mission fulfilled",
    "mission_time_s": "mission fulfilled after",
    "dt_mission_m": "distance of the mission vehicle",
    "dt_av_m": "mean distance of AVs",
    "dt_hv_m": "mean distance of humans",
    "dt_mean_m": "mean distance of all vehicles",
    **{name: words for name, words in EVERYBODY.items() if name not in ("mean_squared_wait_s2", "co2_kg")},
    "collisions": "collisions",
    "av_caused_collisions": "collisions caused by an AV",
    "min_ttc_s": "smallest time to collision",
    **{
        f"{who}near_misses_{kind}": f"near-misses{whose}, {what}"
        for kind, what in NEAR_MISSES.items()
        for who, whose in (("", ""), ("av_", " of AVs"))
    },
    "hard_brakings_av": "hard brakings of AVs",
    **{name: words if words.startswith("AVs") else f"AVs: {words}" for name, words in LAW.items()},
    "interventions": "corrections by the car",
    "veto_rate": "share of decisions vetoed",
    "emergency_stops": "emergency stops",
    "teleports": "teleports",
    "vehicles_never_inserted": "vehicles never inserted",
}


def text(
    result: EpisodeResult, beside: EpisodeResult | None = None, *, mission: str = "", every: bool = False
) -> str:
    """What happened, in lines of at most `COLUMNS` columns.

    Args:
        result: the episode.
        beside: one of another policy in the same traffic.
        mission: the kind of mission, of a scenario that has one (`MISSIONS`).
        every: every figure, not those of `ROWS` alone.
    """
    episodes = [result] if beside is None else [result, beside]
    paragraphs = (
        _head(result),
        _story(episodes, mission),
        _table(episodes, every),
        _notes(episodes),
        _cost(episodes),
    )
    return "\n\n".join("\n".join(lines) for lines in paragraphs if lines)


# ---- inside ----


def _head(result: EpisodeResult) -> list[str]:
    made = f" ({result.policy_label})" if result.policy_label else ""
    seconds = result.steps * result.manifest["timing"]["decision_s"]
    said = [
        f"{seconds:g} s, {figure(result.metrics['vehicles_inserted'])}, humans {result.behavior} "
        f"({result.driver_model}), preset {result.preset}, SVO {result.svo_deg:g} degrees"
    ]
    if whose := in_words(result.manifest):
        said.append(_list(f"traffic {whose}"))
    if result.errors is not None:
        begun = Counter(error.kind for error in result.errors_begun).most_common()
        kinds = ", ".join(f"{count} {kind}" for kind, count in begun) or "none"
        said.append(f"human errors {result.errors}: {kinds}")
    if result.sensing is not None:
        said.append(f"sensing {result.sensing}")
    title = f"{result.scenario} / {result.demand} / {result.policy}{made}, seed {result.seed}"
    return [title, *_wrapped(said)]


def _story(episodes: Sequence[EpisodeResult], mission: str) -> list[str]:
    """Who the mission vehicle is, what became of it, who drove how far, who crashed."""
    first = episodes[0]
    said = []
    if first.mission_vehicle:
        said.append(_mission(first, mission))
        said += [outcome for one in episodes if (outcome := _outcome(one, episodes, mission))]
    if len(episodes) == 2 and (compared := _distances(*episodes)):
        said.append(compared)
    lines = _wrapped(said)
    for one in episodes:
        whose = f"{_name(one)}: " if len(episodes) == 2 else ""
        lines += _wrapped([f"{whose}{line}" for line in _crashes(one)])
    return lines


def _mission(result: EpisodeResult, mission: str) -> str:
    """Who the mission vehicle is."""
    do, _ = MISSIONS.get(mission, REACH)
    driver = "human driver" if mission in MISSIONS else "driver"
    name = result.mission_vehicle or ""
    if "," in name:
        return f"{name} are the mission vehicles: {driver}s that have to {do}."
    guess = f" It is {GUESSED}." if result.mission_guessed else ""
    return f"{name} is the mission vehicle: the {driver} that has to {do}.{guess}"


def _outcome(result: EpisodeResult, episodes: Sequence[EpisodeResult], mission: str) -> str:
    success, after = (result.metrics.get(name) for name in ("mission_success", "mission_time_s"))
    if success is None or success.value is None:
        return ""
    do, did = MISSIONS.get(mission, REACH)
    who = "they" if "," in (result.mission_vehicle or "") else "it"
    start = f"With {_name(result)} {who}" if len(episodes) == 2 else who.capitalize()
    if success.value and after is not None:
        return f"{start} {did} after {figure(after)}."
    seconds = result.steps * result.manifest["timing"]["decision_s"]
    return f"{start} did not {do} within {seconds:g} s."


def _distances(result: EpisodeResult, beside: EpisodeResult) -> str:
    """How much further all, AVs and humans drove than beside."""
    said = []
    for name, who in (("dt_mean_m", "all vehicles"), ("dt_av_m", "AVs"), ("dt_hv_m", "humans")):
        here, there = (one.metrics[name].value for one in (result, beside))
        if here is not None and there is not None:
            metres = round(here - there)
            said.append(f"{who} {abs(metres)} m {'less' if metres < 0 else 'more'}")
    if not said:
        return ""
    return f"Mean distance with {_name(result)}, against {_name(beside)}: {', '.join(said)}."


def _crashes(result: EpisodeResult) -> list[str]:
    lines = []
    for c in result.collisions:
        who = f"{c.kind}, {'AV-caused' if c.av_caused else 'not AV-caused'}"
        where = f"on {c.lane}" if c.lane else "off the lanes"
        error = _error(c, result.errors_begun)
        lines.append(
            f"collision at {_clock(c.time, result)}: {c.collider} hit {c.victim} {where} ({who}{error})"
        )
    if overlooked := _overlooked(result):
        lines.append(f"{overlooked} of these: humans inside junctions, not checked in the file: they go on")
    return lines or ["no collision"]


def _table(episodes: Sequence[EpisodeResult], every: bool) -> list[str]:
    """A row per figure: words, a value per episode, the difference, its name. What is 0 stands below."""
    known = [one.metrics for one in episodes]
    names = [name for name in ROWS if name in known[0]]
    names += [name for name in known[0] if every and name not in names]
    rows, zero = [], []
    for name in names:
        found = [metrics[name] for metrics in known if name in metrics]
        values = [metric.value for metric in found]
        if all(value is None for value in values):
            continue
        if name not in ROWS or name in ALWAYS or any(values):
            rows.append((_words(name, found), *map(_bare, found), _difference(found), name))
        elif not _PART.search(name):
            zero.append(ROWS[name].removeprefix("AVs: "))
    heads = ("", *map(_name, episodes), "difference", "name")
    cells = [heads, *rows] if len(episodes) == 2 else [(*row[:-2], row[-1]) for row in (heads, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  "
        + "  ".join(
            cell.ljust(width) if k in (0, len(row) - 1) else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
    return lines + _wrapped([f"none or 0: {', '.join(zero)}"] if zero else [])


def _words(name: str, found: Sequence[Metric]) -> str:
    """What a row is called, with the unit of what is not counted."""
    unit = found[0].unit
    counted = all(metric.value is None or isinstance(metric.value, int) for metric in found)
    words = ROWS.get(name, name)
    return f"{words}, {unit}" if unit and not counted else words


def _bare(metric: Metric) -> str:
    return figure(Metric(metric.value, "", ""))


def _difference(found: Sequence[Metric]) -> str:
    if len(found) < 2 or any(m.value is None or isinstance(m.value, bool) for m in found):
        return ""
    here, there = (metric.value for metric in found)
    if here is None or there is None or here == there:
        return ""
    return f"{'+' * (here > there)}{_bare(Metric(here - there, '', ''))}"


def _notes(episodes: Sequence[EpisodeResult]) -> list[str]:
    """Why cars corrected their agents, and what a reader must know before comparing."""
    said = []
    for one in episodes:
        if reasons := one.interventions_by_reason:
            words = ", ".join(f"{why} {count}" for why, count in list(reasons.items())[:REASONS])
            more = ", ..." * (len(reasons) > REASONS)
            said.append(f"corrections of {_name(one)} by the car: {words}{more}")
    result = episodes[0]
    said += [f"not comparable: {reason}" for reason in result.validity]
    if left_out := result.manifest["options_not_passed_on"]:
        said.append(_list(f"not passed on to SUMO: {', '.join(left_out)}"))
    return _wrapped(said)


def _cost(episodes: Sequence[EpisodeResult]) -> list[str]:
    """Trace hashes, and what the time was spent on."""
    lines = []
    for one in episodes:
        whose = f" {_name(one)}" if len(episodes) == 2 else ""
        times = {name.removesuffix("_s").replace("_", " "): value for name, value in one.timings.items()}
        total = times.pop("total", 0.0)
        kernels = times.pop("compilation", 0.0)
        parts = [f"{name} {value:.1f} s" for name, value in times.items()]
        if kernels > 0.05:
            parts.insert(0, f"compiling kernels {kernels:.1f} s (first use only)")
        lines += [
            f"trace hash{whose}: {one.trace_hash}",
            f"time{whose}: {total:.1f} s, of it {', '.join(parts)}",
        ]
    return _wrapped(map(_list, lines))


def _name(result: EpisodeResult) -> str:
    return label(result.policy)


def _list(line: str) -> str:
    """A line that is broken between its items only."""
    return re.sub(r"(?<![,:;]) ", NO_BREAK_SPACE, line)


def _wrapped(lines: Iterable[str]) -> list[str]:
    wrap = textwrap.TextWrapper(
        COLUMNS, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
    ).wrap
    return [part.replace(NO_BREAK_SPACE, " ") for line in lines for part in wrap(line)]


def _overlooked(result: EpisodeResult) -> int:
    """Collisions of two humans that the options of the user's file would not have shown: none is a wreck."""
    if CHECKS_INSIDE not in result.manifest.get("changed_options", {}) or result.errors is not None:
        return 0
    return sum(c.kind == INSIDE and not (c.collider_is_av or c.victim_is_av) for c in result.collisions)


def _error(collision: Collision, begun: Sequence[HumanError]) -> str:
    """The last human error with a part in a collision, in words; nothing where there is none."""
    last = max((e for e in begun if e.had_a_part(collision)), key=lambda e: e.time, default=None)
    if last is None:
        return ", after a human error" * collision.human_error_involved
    return f"; {collision.time - last.time:.1f} s before: {last.who} {last.what}"


def _clock(time: float, result: EpisodeResult) -> str:
    """A moment of SUMO's clock in s, and as counted from the end of the warm-up."""
    timing = result.manifest["timing"]
    return f"{time - timing['begin_s'] - timing['warmup_s']:.1f} s (SUMO's clock: {time:.1f} s)"
