"""`cosim bench attribution`: the effect of a value network's inputs on choices and on whole episodes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.matrix import Plan
from cosim.batch.record import planned
from cosim.errors import BadInput, one_of
from cosim.files import write_csv
from cosim.learning.picture import save
from cosim.learning.prediction_data import spread
from cosim.policies import make
from cosim.report.statistics import holm, mean, paired_mean, paired_share, share, signed_rank
from cosim.scenario.options import EpisodeOptions
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task
from policy.agents.oracle import Oracle
from policy.agents.prediction_aware import PredictionAware
from policy.attribution import ORACLE, SUMS, Questioned, Replaced, replacements

PAGE, TABLE, PICTURE = "attribution.md", "attribution.csv", "attribution.png"
CLOSED_LOOP = "closed_loop.csv"
SHARED = ("crashed", "mission_success")  # boolean figures of an episode, and numeric figures:
FIGURES = ("mission_time_s", "av_near_misses_ttc", "hard_brakings_av", "dt_mean_m", "dt_av_m", "dt_mission_m")
TESTED_FIGURE = "dt_mission_m"  # figure of the significance test
NOTHING = "nothing", ""  # no replacement
PANELS = 3  # of the picture, beside one another
SHARES = ("choices_changed", "unmasked_changed")
HEAD = (
    "| input | replacement | decisions | choices changed | best valued changed | mean abs dq | spread |",
    "|---|---|---:|---:|---:|---:|---:|",
)
HEAD_OF_ALL = (
    "| policy | inputs that never change a choice | largest share of choices that a replacement changes |",
    "|---|---|---|",
)
METHOD = """\
The agent drives as in `cosim run`. At every decision the same network is evaluated again with one input
replaced: "zeroed"; "as at present", by the newest perceived frame instead of the others; or "another AV's",
by its input of the same time, if two or more AVs decide. Choices changed: the action that is carried out,
after the prioritizer; best valued changed: the action before it. Counts and shares are of the decisions of
single AVs, with Wilson's 95 % intervals (decisions of one episode are not independent). Mean abs dq: the
mean absolute change of the five action values; spread: the best value minus the second best."""


def questioned(policy: str) -> Questioned:
    """The policy with attribution. Raises BadInput without a value network."""
    made = make(policy)
    if not isinstance(made, PredictionAware):
        raise BadInput("has no value network whose inputs could be replaced", field="--policy", value=policy)
    return Questioned(made.name, made.config)


class Asking(EpisodeRunner):
    """Hosted by an engine's worker: drives as `cosim run`, with attribution at every decision."""

    def policy(self, case: EpisodeOptions) -> Questioned:
        """The policy of `case` with attribution."""
        self._agent = questioned(case.policy)
        return self._agent

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """One episode: the document of `cosim run --json`, and the `answers`."""
        return super().run(case, warnings, outputs, progress) | {"answers": self._agent.answers}


class Replacing(EpisodeRunner):
    """Hosted by an engine's worker: drives with one input of the network replaced."""

    _what: tuple[str, str] = NOTHING

    def run(  # type: ignore[override]
        self, case: EpisodeOptions, warnings: tuple[str, ...], what: tuple[str, str], progress: Progress
    ) -> dict[str, Any]:
        """One episode with `what` replaced; the document of `cosim run --json`."""
        if what != self._what:
            self.close()  # host of the same cell with another replaced input
            self._what = what
        return super().run(case, warnings, None, progress)

    def policy(self, case: EpisodeOptions) -> PredictionAware:
        """The policy of `case`, with that input replaced."""
        agent = questioned(case.policy)
        if self._what == ORACLE:
            return Oracle(agent.name, agent.config)
        return Replaced(agent.name, agent.config, None if self._what == NOTHING else self._what)


def attribution(
    out: Path,
    policies: Sequence[str],
    scenarios: Sequence[str],
    demand: str,
    seeds: range,
    svo_deg: float = 45.0,
    duration: float | None = None,
    *,
    errors: str | None = None,
    preset: str | None = None,
    closed_loop: bool = False,
    by: str = TESTED_FIGURE,
    replaced: Sequence[str] = (),
    workers: int = 1,
    command: str = "",
) -> None:
    """Measure the attribution; writes TABLE, PICTURE and PAGE into `out`.

    `closed_loop`: also drive every episode with each of `policy.attribution.replacements`; writes CLOSED_LOOP
    and a part of PAGE, with a test of the figure `by` per scenario. `replaced`: only these inputs. `errors`:
    of the human drivers. `preset`: None for that of the scenario.

    Raises BadInput as `cosim.batch.record.planned`, for a policy without a value network, for a figure
    outside of FIGURES, and for an input that a policy does not have.
    """
    if by not in FIGURES:
        raise BadInput(f"must be one of {', '.join(FIGURES)}", field="--by", value=by)
    for policy in policies:
        inputs = {what[0] for what in _replacements(questioned(policy))}
        for name in replaced:
            one_of(name, sorted(inputs), "--replace")
    asked = {"scenario": scenarios, "demand": demand or None, "policy": policies, "svo": svo_deg}
    plan = planned(seeds, **asked, duration=duration, errors=errors, preset=preset)
    tasks = [cell.task(case) for cell, case in plan.cases()]
    driven = spread(LocalEngine(Asking, workers=workers), tasks, "attribution")
    names = dict.fromkeys(episode["policy"] for episode in driven)
    tables = {name: table([e for e in driven if e["policy"] == name]) for name in names}
    write_csv(out / TABLE, [{"policy": policy} | row for policy, rows in tables.items() for row in rows])
    draw(out / PICTURE, tables)
    page = markdown(driven, tables, command)
    if closed_loop:
        rows: list[dict[str, Any]] = []
        for part in closed(plan, workers, replaced):
            rows += part
            write_csv(out / CLOSED_LOOP, rows)
        page += "\n" + closed_markdown(rows, by)
    (out / PAGE).write_text(page, encoding="utf-8")


def _replacements(agent: PredictionAware) -> list[tuple[str, str]]:
    """The pairs (input, replacement) available for an agent."""
    return [*replacements(agent.vfn, agent.observation.frames), ORACLE]


def closed(plan: Plan, workers: int = 1, replaced: Sequence[str] = ()) -> Iterator[list[dict[str, Any]]]:
    """Per policy and scenario: a row per replacement (none first; only of `replaced` inputs, if given) and
    episode, with SHARED and FIGURES."""
    keys = ("policy", "scenario", "seed", *SHARED, *FIGURES)
    for cell in plan.cells:
        cases = [case for one, case in plan.cases() if one is cell]
        asked = [
            what
            for what in _replacements(questioned(cell.case.policy))
            if not replaced or what[0] in replaced
        ]
        arms = [(what, case) for what in (NOTHING, *asked) for case in cases]
        tasks = [
            Task(f"{case.key} {' '.join(what)}", " ".join(what), (case, cell.scenario.warnings, what))
            for what, case in arms
        ]
        driven = spread(LocalEngine(Replacing, workers=workers), tasks, f"{cell.case.what}, inputs replaced")
        yield [
            dict(zip(("input", "replacement"), what, strict=True)) | {key: episode[key] for key in keys}
            for (what, _), episode in zip(arms, driven, strict=True)
        ]


def closed_markdown(rows: Sequence[Mapping[str, Any]], by: str = TESTED_FIGURE) -> str:
    """Episodes with replaced inputs against episodes without, paired, as a document."""
    page = ["## Episodes with an input replaced", ""]
    page += [
        "Whole episodes on equal seeds. Values are differences to the episodes without a replacement, with",
        "95 % intervals (Tango's for shares, BCa bootstrap over pairs for means). p is from Wilcoxon's",
        f"signed ranks of `{by}`, corrected over the scenarios by Holm's method.",
        "",
    ]
    policies = dict.fromkeys(row["policy"] for row in rows)
    worlds = dict.fromkeys(row["scenario"] for row in rows)
    for policy in policies:
        drives = {
            world: {
                key: list(part)
                for key, part in groupby(
                    [row for row in rows if (row["policy"], row["scenario"]) == (policy, world)],
                    itemgetter("input", "replacement"),
                )
            }
            for world in worlds
        }
        tested = _tested(drives, by)
        for world, arms in drives.items():
            base = arms[NOTHING]
            page += [f"### {policy}, {world}, {len(base)} episodes", ""]
            page += [f"| input | replacement | {' | '.join((*SHARED, *FIGURES))} | p |"]
            page += ["|---|---|" + "---:|" * (len((*SHARED, *FIGURES)) + 1)]
            own = [f"{sum(bool(r[figure]) for r in base)} of {len(base)}" for figure in SHARED]
            own += [mean(_numbers(base, figure)).text(1) for figure in FIGURES]
            page += [f"| nothing | | {' | '.join(own)} | |"]
            for key, part in arms.items():
                if key == NOTHING:
                    continue
                cells = [
                    paired_share([bool(r[f]) for r in base], [bool(r[f]) for r in part]).text(0, 100.0)
                    + " pp"
                    for f in SHARED
                ]
                cells += [paired_mean(_numbers(base, f), _numbers(part, f)).text(1) for f in FIGURES]
                page += [f"| {' | '.join(key)} | {' | '.join(cells)} | {tested[world][key]:.2g} |"]
            page.append("")
    return "\n".join(page).rstrip() + "\n"


Arm = tuple[str, str]  # input, replacement


def _tested(
    drives: Mapping[str, Mapping[Arm, Sequence[Mapping[str, Any]]]], by: str
) -> dict[str, dict[Arm, float]]:
    """Scenario -> arm -> p of `by` against episodes without replacement, corrected over scenarios by Holm."""
    out: dict[str, dict[Arm, float]] = {world: {} for world in drives}
    for key in dict.fromkeys(key for arms in drives.values() for key in arms if key != NOTHING):
        worlds = [world for world, arms in drives.items() if key in arms]
        p = [signed_rank(*(_numbers(drives[w][arm], by) for arm in (NOTHING, key))) for w in worlds]
        for world, value in zip(worlds, holm(p), strict=True):
            out[world][key] = value
    return out


def _numbers(rows: Sequence[Mapping[str, Any]], figure: str) -> list[float]:
    """One figure of all episodes; nan for NA."""
    return [float("nan") if row[figure] is None else float(row[figure]) for row in rows]


def table(driven: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row per input and replacement: shares of the decisions with Wilson's intervals, and means.

    Args:
        driven: results of `Asking.run` for the episodes of one policy.
    """
    rows = []
    keys = list(dict.fromkeys(key for episode in driven for key in episode["answers"]))
    inputs = list(dict.fromkeys(name for name, _ in keys))  # grouped by input
    for key in sorted(keys, key=lambda key: inputs.index(key[0])):
        found = np.sum([e["answers"][key] for e in driven if key in e["answers"]], 0)
        sums = dict(zip(SUMS, found.tolist(), strict=True))
        n = int(sums["decisions"])
        row: dict[str, Any] = {"input": key[0], "replacement": key[1], "decisions": n}
        for column in SHARES:
            count = int(sums[column])
            value, low, high = astuple(share(count, n))
            row |= {column: value, f"{column}_low": low, f"{column}_high": high, f"{column}_count": count}
        rows.append(row | {column: sums[column] / n for column in ("mean_abs_dq", "spread")})
    return rows


def markdown(
    driven: Sequence[Mapping[str, Any]], tables: Mapping[str, Sequence[Mapping[str, Any]]], command: str
) -> str:
    """The tables as a document; inputs without effect come first."""
    page = ["# Which inputs the value networks use", "", *HEAD_OF_ALL]
    for policy, rows in tables.items():
        largest = {
            name: max(row["choices_changed"] for row in mine)
            for name, mine in groupby(rows, itemgetter("input"))
        }
        never = ", ".join(name for name, x in largest.items() if x == 0.0) or "none"
        some = [f"{name} {100 * x:.2g} %" for name, x in sorted(largest.items(), key=itemgetter(1)) if x]
        page.append(f"| `{policy}` | {never} | {', '.join(some) or '0 %'} |")
    e = driven[0]
    drivers = (
        f"HVs {e['behavior']} ({e['driver_model']}), errors `{e['errors'] or 'none'}`, "
        f"preset `{e['preset']}`,"
        f" phi {e['svo_deg']:g} degrees"
    )
    count = len(driven) // len(tables)
    worlds = ", ".join(f"`{world}`" for world in dict.fromkeys(one["scenario"] for one in driven))
    about = f"Scenarios {worlds}; demand `{e['demand']}`, {drivers}; {count} episodes a policy."
    page += ["", f"`{command}`", "", about, METHOD, "", f"![choices changed]({PICTURE})", ""]
    for policy, rows in tables.items():
        page += [f"## {policy}", "", *HEAD]
        for above, row in zip([None, *rows], rows, strict=False):
            named = "" if above and above["input"] == row["input"] else row["input"]
            cells = [named, row["replacement"], str(row["decisions"])]
            cells += [
                f"{row[f'{c}_count']}: {100 * row[c]:.1f} %"
                f" ({100 * row[f'{c}_low']:.1f} to {100 * row[f'{c}_high']:.1f})"
                for c in SHARES
            ]
            page.append(f"| {' | '.join(cells)} | {row['mean_abs_dq']:.3f} | {row['spread']:.3f} |")
        page.append("")
    return "\n".join(page).rstrip() + "\n"


def draw(path: Path, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Bars: share of changed choices by input and replacement, a panel per policy."""
    longest = max(map(len, tables.values()))
    columns = min(len(tables), PANELS)
    lines = math.ceil(len(tables) / columns)
    figure = Figure(figsize=(1.0 + 3.6 * columns, (1.0 + 0.22 * longest) * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True).flat
    for (policy, rows), axis in zip(tables.items(), panels, strict=False):
        names = [f"{row['input']}: {row['replacement']}" for row in rows]
        value, low, high = (
            100.0 * np.array([row[f"choices_changed{end}"] for row in rows]) for end in ("", "_low", "_high")
        )
        axis.barh(names, value, xerr=np.clip([value - low, high - value], 0.0, None), error_kw={"lw": 0.8})
        axis.tick_params(axis="y", labelsize="x-small")
        axis.invert_yaxis()
        axis.set(title=policy, xlabel="choices changed, %")
    for axis in panels:  # those without a policy
        axis.remove()
    save(figure, path)
