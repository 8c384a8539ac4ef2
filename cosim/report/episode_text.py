"""One episode in words and a short table, beside one of another policy in the same traffic."""

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence

from cosim.report.result import EVERYBODY, LAW, NEAR_MISSES, NOISE, figure
from cosim.scenario.policy_name import label
from cosim.scenario.traffic import CHECKS_INSIDE, in_words
from cosim.types import INSIDE, Collision, EpisodeResult, HumanError, Metric

COLUMNS = 100
NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"
# By the kind of mission: what the mission vehicle has to do, and the same done.
MISSIONS = {
    "merge": ("merge", "merged"),
    "exit": ("leave at the exit", "left at the exit"),
    "roundabout": ("enter the roundabout", "entered the roundabout"),
    "intersection": ("cross the major road", "crossed the major road"),
}
DEFAULT_MISSION = ("reach its goal", "reached its goal")  # in a user's file
GUESSED = "guessed: its figures feed no gate (--mission ID names it, --mission none does without)"
MAX_REASONS = 4  # of interventions, in the list
ALWAYS_SHOWN = ("collisions", "av_caused_collisions", "mission_success")  # also when 0
# Names of parts of another figure: not listed as 0
_BREAKDOWN = re.compile(r"^av_|_av$|_hv$|^worst|^veto|^uncounted")
# Rows of the table, in words.
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
    "uncounted_overlaps": "overlaps that are no collisions",
    "min_ttc_s": "smallest time to collision",
    **{
        f"{prefix}near_misses_{kind}": f"near-misses{of}, {what}"
        for kind, what in NEAR_MISSES.items()
        for prefix, of in (("", ""), ("av_", " of AVs"))
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
    """The episode in lines of at most `COLUMNS` columns.

    Args:
        result: the episode.
        beside: an episode of another policy in the same traffic.
        mission: the kind of mission (`MISSIONS`), "" for a scenario without one.
        every: whether figures besides those of `ROWS` are shown.
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
        said.append(_unbroken_items(f"traffic {whose}"))
    if result.errors is not None:
        begun = Counter(error.kind for error in result.errors_begun).most_common()
        kinds = ", ".join(f"{count} {kind}" for kind, count in begun) or "none"
        said.append(f"human errors {result.errors}: {kinds}")
    if result.sensing is not None:
        said.append(f"sensing {result.sensing}")
    title = f"{result.scenario} / {result.demand} / {result.policy}{made}, seed {result.seed}"
    return [title, *_wrapped(said)]


def _story(episodes: Sequence[EpisodeResult], mission: str) -> list[str]:
    """The mission vehicle and whether it reached its goal, distances, collisions."""
    first = episodes[0]
    sentences = []
    if first.mission_vehicle:
        sentences.append(_mission(first, mission))
        sentences += [outcome for result in episodes if (outcome := _outcome(result, episodes, mission))]
    if len(episodes) == 2 and (compared := _distances(*episodes)):
        sentences.append(compared)
    lines = _wrapped(sentences)
    for result in episodes:
        policy = f"{_policy(result)}: " if len(episodes) == 2 else ""
        lines += _wrapped([f"{policy}{line}" for line in _collisions(result)])
    return lines


def _mission(result: EpisodeResult, mission: str) -> str:
    """The mission vehicle and its task."""
    do, _ = MISSIONS.get(mission, DEFAULT_MISSION)
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
    do, did = MISSIONS.get(mission, DEFAULT_MISSION)
    pronoun = "they" if "," in (result.mission_vehicle or "") else "it"
    start = f"With {_policy(result)} {pronoun}" if len(episodes) == 2 else pronoun.capitalize()
    if success.value and after is not None:
        return f"{start} {did} after {figure(after)}."
    seconds = result.steps * result.manifest["timing"]["decision_s"]
    return f"{start} did not {do} within {seconds:g} s."


def _distances(result: EpisodeResult, beside: EpisodeResult) -> str:
    """Differences in distance of all vehicles, AVs and humans to the other episode."""
    differences = []
    for name, vehicles in (("dt_mean_m", "all vehicles"), ("dt_av_m", "AVs"), ("dt_hv_m", "humans")):
        here, there = (episode.metrics[name].value for episode in (result, beside))
        if here is not None and there is not None:
            metres = round(here - there)
            differences.append(f"{vehicles} {abs(metres)} m {'less' if metres < 0 else 'more'}")
    if not differences:
        return ""
    return f"Mean distance with {_policy(result)}, against {_policy(beside)}: {', '.join(differences)}."


def _collisions(result: EpisodeResult) -> list[str]:
    lines = []
    for c in result.collisions:
        cause = f"{c.kind}, {'AV-caused' if c.av_caused else 'not AV-caused'}"
        where = f"on {c.lane}" if c.lane else "off the lanes"
        error = _last_error(c, result.errors_begun)
        lines.append(
            f"collision at {_clock(c.time, result)}: {c.collider} hit {c.victim} {where} ({cause}{error})"
        )
    if unchecked := _unchecked_collisions(result):
        lines.append(
            f"{unchecked} of these: humans inside junctions, which the file does not check: they drive on"
        )
    return lines or ["no collision"]


def _table(episodes: Sequence[EpisodeResult], every: bool) -> list[str]:
    """A row per figure: words, a value per episode, the difference, its name. Below it the figures of 0."""
    known = [result.metrics for result in episodes]
    names = [name for name in ROWS if name in known[0]]
    names += [name for name in known[0] if every and name not in names]
    rows, zero = [], []
    for name in names:
        found = [metrics[name] for metrics in known if name in metrics]
        values = [None if metric.value is None else abs(metric.value) > NOISE for metric in found]
        if all(value is None for value in values):
            continue
        if name not in ROWS or name in ALWAYS_SHOWN or any(values) or found[0].better == "higher":
            rows.append((_words(name, found), *map(_without_unit, found), _difference(found), name))
        elif not _BREAKDOWN.search(name):
            zero.append(ROWS[name].removeprefix("AVs: "))
    heads = ("", *map(_policy, episodes), "difference", "name")
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
    """A row's title, with the unit of figures that are no counts."""
    unit = found[0].unit
    counted = all(metric.value is None or isinstance(metric.value, int) for metric in found)
    words = ROWS.get(name, name)
    return f"{words}, {unit}" if unit and unit != "share" and not counted else words


def _without_unit(metric: Metric) -> str:
    return figure(Metric(metric.value, "", ""))


def _difference(found: Sequence[Metric]) -> str:
    if len(found) < 2 or any(m.value is None or isinstance(m.value, bool) for m in found):
        return ""
    here, there = (metric.value for metric in found)
    if here is None or there is None or here == there:
        return ""
    return f"{'+' * (here > there)}{_without_unit(Metric(here - there, '', ''))}"


def _notes(episodes: Sequence[EpisodeResult]) -> list[str]:
    """The reasons of interventions, and what limits a comparison."""
    notes = []
    for result in episodes:
        if reasons := result.interventions_by_reason:
            words = ", ".join(f"{reason} {count}" for reason, count in list(reasons.items())[:MAX_REASONS])
            more = ", ..." * (len(reasons) > MAX_REASONS)
            notes.append(f"corrections of {_policy(result)} by the car: {words}{more}")
    first = episodes[0]
    notes += [f"not comparable: {reason}" for reason in first.validity]
    if left_out := first.manifest["options_not_passed_on"]:
        notes.append(_unbroken_items(f"not passed on to SUMO: {', '.join(left_out)}"))
    return _wrapped(notes)


def _cost(episodes: Sequence[EpisodeResult]) -> list[str]:
    """Trace hashes, and the time by what it was spent on."""
    lines = []
    for result in episodes:
        policy = f" {_policy(result)}" if len(episodes) == 2 else ""
        times = {name.removesuffix("_s").replace("_", " "): value for name, value in result.timings.items()}
        total = times.pop("total", 0.0)
        kernels = times.pop("compilation", 0.0)
        parts = [f"{name} {value:.1f} s" for name, value in times.items()]
        if kernels > 0.05:
            parts.insert(0, f"compiling kernels {kernels:.1f} s (first use only)")
        lines += [
            f"trace hash{policy}: {result.trace_hash}",
            f"time{policy}: {total:.1f} s, of it {', '.join(parts)}",
        ]
    return _wrapped(map(_unbroken_items, lines))


def _policy(result: EpisodeResult) -> str:
    return label(result.policy)


def _unbroken_items(line: str) -> str:
    """A line that `_wrapped` breaks between its items only."""
    return re.sub(r"(?<![,:;]) ", NO_BREAK_SPACE, line)


def _wrapped(lines: Iterable[str]) -> list[str]:
    wrap = textwrap.TextWrapper(
        COLUMNS, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
    ).wrap
    return [part.replace(NO_BREAK_SPACE, " ") for line in lines for part in wrap(line)]


def _unchecked_collisions(result: EpisodeResult) -> int:
    """Collisions of two humans that SUMO does not check with the options of the user's file: the vehicles
    drive on."""
    if CHECKS_INSIDE not in result.manifest.get("changed_options", {}) or result.errors is not None:
        return 0
    return sum(c.kind == INSIDE and not (c.collider_is_av or c.victim_is_av) for c in result.collisions)


def _last_error(collision: Collision, begun: Sequence[HumanError]) -> str:
    """The last human error with a part in a collision, in words; "" where there is none."""
    last = max((e for e in begun if e.had_a_part(collision)), key=lambda e: e.time, default=None)
    if last is None:
        return ", after a human error" * collision.human_error_involved
    return f"; {collision.time - last.time:.1f} s before: {last.who} {last.what}"


def _clock(time: float, result: EpisodeResult) -> str:
    """A time as counted from the end of the warm-up, and on SUMO's clock, s."""
    timing = result.manifest["timing"]
    return f"{time - timing['begin_s'] - timing['warmup_s']:.1f} s (SUMO's clock: {time:.1f} s)"
