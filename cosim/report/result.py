"""One episode's result: a short table to read, a run folder to keep."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from cosim.files import cannot, whole
from cosim.scenario.traffic import CHECKS_INSIDE, in_words
from cosim.types import INSIDE, Collision, EpisodeResult, HumanError, Metric

# Columns that the table of an episode shows -> the measure of them that reports and comparisons show first.
FIRST = {
    "crashed": "collision_rate",
    "collisions": "",
    "av_caused_collisions": "av_caused_collision_rate",
    "teleports": "",
    "emergency_stops": "",
    "mission_success": "mission_success_rate",
    "mission_time_s": "",
    "dt_mission_m": "dt_mission_m",
    "dt_av_m": "dt_av_m",
    "dt_mean_m": "dt_mean_m",
    "min_ttc_s": "min_ttc_s",
    "hard_brakings_av": "hard_brakings_av",
    "veto_rate": "veto_rate",
    "vehicles_inserted": "",
    "vehicles_never_inserted": "",
}

# What happened to all vehicles that wanted to depart (figures.md, Everybody), in words.
EVERYBODY = {
    "total_delay_s": "delay of all",
    "total_delay_av_s": "delay of AVs",
    "total_delay_hv_s": "delay of humans",
    "total_delay_slowest_tenth_s": "delay of the slowest tenth",
    "arrivals": "arrivals",
    "arrivals_av": "arrivals of AVs",
    "arrivals_hv": "arrivals of humans",
    "mean_speed_mps": "mean speed",
    "longest_wait_s": "longest wait",
    "mean_squared_wait_s2": "mean squared wait",
    "co2_kg": "CO2",
    "co2_kg_per_vehicle_km": "CO2 per vehicle-km",
}
# What an AV must not do (figures.md, The law), in words: shown together, in red when it is not 0.
LAW = {
    "red_light_violations": "red lights",
    "stop_sign_violations": "stop signs",
    "right_of_way_violations": "right of way",
    "person_conflicts": "person conflicts",
    "junctions_blocked": "junctions blocked",
    "avs_stuck": "AVs stuck",
    "speeding_share": "speeding",
    "worst_speeding_mps": "worst speeding",
}
# Near-misses (figures.md), by the end of their columns' names.
NEAR_MISSES = {"ttc": "TTC < 1.5 s", "drac": "DRAC > 3.35 m/s2", "pet": "PET < 1 s"}
LAW_IN_ANY_CASE = 3  # the first of them are said of one episode even when they are 0
REASONS = 4  # of interventions, that are said
GUESSED = "guessed: its figures feed no gate (--mission ID names it, --mission none does without)"


def table(result: EpisodeResult, *, first: bool = True) -> str:
    """The figures with their units: the `first` ones, or all."""
    label = f" ({result.policy_label})" if result.policy_label else ""
    lines = [
        f"{result.scenario} / {result.demand} / {result.policy}{label}",
        f"  behaviour {result.behavior}, drivers {result.driver_model}, preset {result.preset}, "
        f"svo {result.svo_deg:g} deg, seed {result.seed}, {result.steps} decisions",
    ]
    if whose := in_words(result.manifest):
        lines.append(f"  traffic {whose}")
    if result.errors is not None:
        begun = Counter(error.kind for error in result.errors_begun).most_common()
        words = ", ".join(f"{count} {kind}" for kind, count in begun) or "none"
        lines.append(f"  human errors {result.errors}: {words}")
    if result.mission_vehicle is not None:
        lines.append(f"  mission vehicle {result.mission_vehicle}" + f", {GUESSED}" * result.mission_guessed)
    shown = [name for name in FIRST if name in result.metrics] if first else result.metrics
    lines += [f"  {name:<24} {figure(result.metrics[name])}" for name in shown]
    lines += everybody_lines(result) + near_miss_lines(result) + law_lines(result)
    for c in result.collisions:
        who = f"{c.kind}, {'AV-caused' if c.av_caused else 'not AV-caused'}"
        who += _error(c, result.errors_begun)
        where = f"on {c.lane}" if c.lane else "off the lanes"
        lines.append(f"  collision at {_clock(c.time, result)}: {c.collider} hit {c.victim} {where} ({who})")
    if overlooked := _overlooked(result):
        lines.append(f"  {overlooked} of these: humans inside junctions, not checked in the file: they go on")
    lines += [f"  not comparable: {reason}" for reason in result.validity]
    lines += [f"  not passed on to SUMO: {option}" for option in result.manifest["options_not_passed_on"]]
    lines.append(f"  trace_hash               {result.trace_hash}")
    times = ", ".join(f"{name.removesuffix('_s')} {value:.2f} s" for name, value in result.timings.items())
    lines.append(f"  time spent               {times}")
    return "\n".join(lines)


def _overlooked(result: EpisodeResult) -> int:
    """Collisions of two humans that the options of the user's file would not have shown: none is a wreck."""
    if CHECKS_INSIDE not in result.manifest.get("changed_options", {}) or result.errors is not None:
        return 0
    return sum(c.kind == INSIDE and not (c.collider_is_av or c.victim_is_av) for c in result.collisions)


def error_of(collision: Collision, begun: Sequence[HumanError]) -> HumanError | None:
    """The last error with a part in it: of one of both, or of somebody before one of them."""
    return max((e for e in begun if e.had_a_part(collision)), key=lambda e: e.time, default=None)


def _error(collision: Collision, begun: Sequence[HumanError]) -> str:
    """The last human error with a part in a collision, in words; nothing where there is none."""
    last = error_of(collision, begun)
    if last is None:
        return ", a human had erred" * collision.human_error_involved
    return f"; {collision.time - last.time:.1f} s before: {last.who} {last.what}"


def everybody_lines(result: EpisodeResult) -> list[str]:
    """`everybody   delay of all 12.6 s, delay of AVs 13.4 s, ...`, two lines; what is NA is left out."""
    found = [
        f"{words} {figure(result.metrics[name])}"
        for name, words in EVERYBODY.items()
        if name in result.metrics and result.metrics[name].value is not None
    ]
    shown = (found[:4], found[4:])
    heads = ("everybody", "")
    return [f"  {head:<24} {', '.join(line)}" for head, line in zip(heads, shown, strict=True) if line]


def near_miss_lines(result: EpisodeResult) -> list[str]:
    """`near-misses   3 TTC < 1.5 s (1 with an AV), ...`; nothing where there is none."""
    said = []
    for kind, what in NEAR_MISSES.items():
        count, avs = (result.metrics.get(f"{who}near_misses_{kind}") for who in ("", "av_"))
        if count and count.value:
            said.append(f"{count.value} {what} ({(avs and avs.value) or 0} with an AV)")
    return [f"  {'near-misses':<24} {', '.join(said)}"] if said else []


def law_lines(result: EpisodeResult) -> list[str]:
    """`law   0 red lights, ...` and, where the car corrected its agent, how often and why."""
    known = {name: result.metrics[name] for name in LAW if name in result.metrics}
    known = {name: metric for name, metric in known.items() if metric.value is not None}
    said = [
        n for k, n in enumerate(LAW) if n in known and (k < LAW_IN_ANY_CASE or round(known[n].value or 0, 3))
    ]
    lines = []
    if said:
        words = ", ".join(
            f"{100 * float(known[n].value or 0):.2g} % {LAW[n]}"
            if n == "speeding_share"
            else f"{LAW[n]} {figure(known[n])}"
            if n == "worst_speeding_mps"
            else f"{known[n].value} {LAW[n]}"
            for n in said
        )
        lines.append(f"  {'law':<24} {words}")
    if reasons := result.interventions_by_reason:
        words = ", ".join(f"{count} {why}" for why, count in list(reasons.items())[:REASONS])
        words += ", ..." * (len(reasons) > REASONS)
        lines.append(f"  {'interventions':<24} {sum(reasons.values())} ({words})")
    return lines


def _clock(time: float, result: EpisodeResult) -> str:
    """A moment of SUMO's clock in s, and as counted from the end of the warm-up."""
    timing = result.manifest["timing"]
    return f"{time - timing['begin_s'] - timing['warmup_s']:.1f} s (SUMO's clock: {time:.1f} s)"


def write_folder(folder: Path, result: EpisodeResult, outputs: Sequence[str] = ()) -> None:
    """`result.json`, `manifest.json` and `metrics.txt`; each appears whole or not at all.

    Films, pages and SUMO's outputs of an earlier run in this folder go, but for `outputs`, this run's own.

    Raises BadInput when it cannot be written.
    """
    everything = result.document()
    texts = {
        "manifest.json": json.dumps(everything["manifest"], indent=2),
        "metrics.txt": table(result),
        "result.json": json.dumps(everything, indent=2),
    }
    old = [*folder.glob("replay*.html"), *folder.glob("replay*.mp4"), *folder.glob("replay*.gif")]
    old += [file for file in (folder / "outputs").glob("*.xml") if file.stem not in outputs]
    with cannot("write", file=folder, field="--out"):
        for file in old:
            file.unlink()
        for name, text in texts.items():
            with whole(folder / name) as draft:
                draft.write_text(text + "\n")


def figure(metric: Metric) -> str:
    """One figure with its unit, as people read it; NA is said."""
    value = metric.value
    if value is None:
        return "NA"
    if isinstance(value, bool):
        return "yes" if value else "no"
    shown = f"{value:.3g}" if isinstance(value, float) and abs(value) < 100 else f"{value:.0f}"
    return f"{shown} {metric.unit}".rstrip()
