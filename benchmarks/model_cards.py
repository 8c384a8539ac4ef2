"""A card for each network that ships: what it is, learned from, measured at, and what it is not good for.

    python -m benchmarks.model_cards [--out docs/reference/models.md]

Made of the JSON cards beside the weights (`policy.checkpoint`), the logs of their trainings and the figures
of docs/results/data; nothing is driven.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import HEADS, markdown_row, write_page
from cosim.errors import CosimError
from policy.agents.approaches import APPROACHES
from policy.checkpoint import SHIPPED, read_card

Card = Mapping[str, Any]
RESULTS = Path("docs/results")
HEAD = 2  # lines of a table before its rows
FIGURES = ("collision_rate", "mission_success_rate", "dt_mean_m")
MAPS_UNUSED = (
    "It does not use its maps, past or predicted: what a map shows changes none of its choices in the "
    "contested merge, or hardly one (docs/results/attribution.md). A difference between `vfn-p-demonstrated` "
    "and `vfn-demonstrated` says nothing about prediction."
)
MAPS_ONLY = "It sees nothing but maps, brakes for whatever is near, and has been trained for minutes only."
LAWLESS = (
    "It knows no traffic light, no speed limit of a junction's lane, no pedestrian and no bicycle; in "
    "`unguarded` it drives through red lights."
)
DEMONSTRATED = (
    "It learned from a scripted demonstrator (`altruist-rule` and a cruise rule, training.md) as well "
    "as from rewards, and chooses as that does in most states: what rewards added is not measured apart.",
    f"The human drivers of its training never err. {LAWLESS}",
)
LAWFUL_ONLY = "It learned from rewards alone, in preset `lawful`: what it does in `unguarded` it never tried."
ASSISTED = "What keeps its distance in `unguarded` are layers that this training left alone (training.md)."
EARLIER = "**Of an earlier agent**"  # on pages that are not driven anew
# the folder of its training's log, where that is not NAME-0
TRAINED = {"vfn-p": "assisted-0", "vfn": "assisted-0"}
PREDICTING_LIMITS = (
    "It learned from the five worlds alone, with drivers who follow IDM and LC2013 or MOBIL and never err; "
    "nothing is known of its error on recorded traffic or on other roads.",
)


def names() -> list[str]:
    """Every network that ships, value networks first."""
    found = sorted(path.stem for path in SHIPPED.glob("*.safetensors"))
    return sorted(found, key=lambda name: (name not in APPROACHES, not name.startswith("hpn"), name))


def page() -> list[str]:
    """The Markdown page. Raises BadInput and WeightsMismatch where weights and card do not agree."""
    cards = {name: read_card(SHIPPED / f"{name}.safetensors") for name in names()}
    lines = ["# The networks that ship", "", "Made by `python -m benchmarks.model_cards`.", ""]
    lines += ["Licence: MIT, as the code. Rates and means with 95 % intervals.", ""]
    for name, card in cards.items():
        about = (driving if name in APPROACHES else seeing if name == "encoder" else predicting)(name, card)
        lines += [f"## {name}", "", *about, f"- SHA-256 of `{name}.safetensors`: `{card['sha256']}`", ""]
    return lines


def driving(name: str, card: Card) -> Iterator[str]:
    """The lines about a value network or a baseline of Table III."""
    data, approach = card["data"], APPROACHES[name]
    folder = RESULTS / "trainings" / TRAINED.get(name, f"{name}-0")
    log = [json.loads(line) for line in (folder / "log.jsonl").read_text("utf-8").splitlines()]
    shipped = card["measured"].get("iteration")  # none: it was taught after the last one
    log = log if shipped is None else [row for row in log if row["iteration"] <= shipped]
    training, last = data["training"], log[-1]
    layout, rewards = card["configs"]["vfn"], name in TRAINED
    sees = "kinematics, situation and maps" if approach.kinematics else "maps"
    sees = sees if layout.get("others", True) else "its own speed and command, and maps"
    if layout.get("meets", False):
        sees = f"whether its way meets a mission vehicle's (layers of their own), {sees}"
    if layout.get("assisted", False):
        own = "whether its car keeps the law and its distance itself (`lawful`; layers of their own)"
        sees = f"{own}, {sees}"
    predicted = ", predicted maps among them" if approach.predicted_maps else ""
    mask = "no safety prioritizer" if approach.mask == "none" else f"prioritizer on `{data['predictor']}`"
    yield f"- Chooses an AV's meta-action from {sees}{predicted}; {layout['extractor']}, {mask}."
    phis = ", ".join(f"{phi:g}" for phi in training["svo"])
    yield (
        f"- Data: {len(log) * training['episodes']} episodes of {', '.join(data['scenarios'])} up to the "
        f"shipped iteration, seeds below 100,000, drives with phi {phis} degrees"
        + (
            f"; predicted maps of `hpn` (SHA-256 `{data['hpn_sha256'][:12]}`)."
            if "hpn_sha256" in data
            else "."
        )
    )
    note = data.get("note", f"at commit f591cb8, with `{folder.as_posix()}/config.yaml`")
    yield f"- Training: {note}."
    hours = sum(row["iteration_s"] for row in log) / 3600
    took = f"{hours:.1f} h" if hours >= 0.1 else f"{60 * hours:.0f} min"
    own = last["updates"]  # none: its drives are all that the pupil learned from
    made = f"after {own:,} updates and {took} by its log" if own else f"after {took} of drives"
    if shipped is None:
        yield (
            f"- Shipped: what was taught, {made}; it chooses as its teachers do in "
            f"{card['measured']['agrees']:.0%} of the states."
        )
    elif "validation" in card["measured"]:
        yield (
            f"- Shipped: iteration {shipped}, {made}; highest mean reward in {training['validation']} "
            "validation drives a case, tuning seeds."
        )
    else:
        yield f"- Shipped: iteration {shipped}, {made}, its last."
    table = list(measured(name))
    if len(table) > HEAD:
        yield from ("- Measured (test seeds, preset `unguarded`):", "", *table, "")
    else:
        told = {"learned.md": f"| {name} at ", "alone.md": f"| {name}-alone |", "foresight.md": f"| {name} |"}
        told |= {"turn.md": f"--policy {name} ", "humans.md": f"| {name} | idm |", "law.md": f"% | {name} |"}
        texts = {page: (RESULTS / page).read_text(encoding="utf-8") for page in told}
        there = [page for page, arm in told.items() if arm in texts[page] and EARLIER not in texts[page]]
        where = "on test seeds: " + ", ".join(f"docs/results/{page}" for page in there)
        yield f"- Measured {where if there else 'in no table yet'}."
    if rewards and not any(lesson.get("preset") for lesson in training["lessons"]):
        yield f"- Limit: {ASSISTED if layout.get('assisted') else LAWFUL_ONLY}"
    limits = (LAWLESS,) if rewards else (MAPS_UNUSED if approach.kinematics else MAPS_ONLY, *DEMONSTRATED)
    yield from (f"- Limit: {text}" for text in limits)


def measured(name: str) -> Iterator[str]:
    """A table of one arm's figures: docs/results' decisions and Table III."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for file in ("table3", "decisions"):
        with (RESULTS / "data" / f"{file}.csv").open(encoding="utf-8", newline="") as lines:
            for row in csv.DictReader(lines):
                if row["arm"] == name and not row["against"] and row["figure"] in FIGURES:
                    rows.setdefault((row["demand"], row["scenario"]), {})[row["figure"]] = interval(row)
    yield markdown_row(["demand", "world", *(HEADS[figure] for figure in FIGURES)])
    yield markdown_row(["---"] * (2 + len(FIGURES)))
    for (demand, world), found in sorted(rows.items()):
        yield markdown_row([demand, world, *(found.get(figure, "-") for figure in FIGURES)])


def interval(row: Mapping[str, str]) -> str:
    """One figure with its interval and its episodes, shares in percent."""
    if not row["value"]:
        return "-"
    scale, unit = (100.0, " %") if row["unit"] == "share" else (1.0, f" {row['unit']}")
    value, low, high = (f"{scale * float(row[key]):.4g}" for key in ("value", "low", "high"))
    return f"{value}{unit} ({low} to {high}), n {row['n']}"


def predicting(name: str, card: Card) -> Iterator[str]:
    """The lines about a network that predicts: HPN's variants and the trajectory predictors."""
    data = card["data"]
    if name.startswith("hpn"):
        train, check, commands = data["train"], data["validation"], data["commands"]
        recorded, training = commands["train recordings"], f"`{commands['train']}`"
        with (SHIPPED / f"{name}.csv").open(encoding="utf-8", newline="") as lines:
            steps = [row["update"] for row in csv.DictReader(lines)][-1]
        yield "- Predicts the next velocity maps and kinematics of one AV's surroundings (hpn.md)."
        page, unit = "docs/results/prediction_maps.md", "loss"
    else:
        train, check, steps = data["training"], data["validation"], data["fit"]["steps"]
        recorded, training = (
            train["commands"],
            "`cosim fit-predictors --training DIR --validation DIR --out DIR`",
        )
        yield "- Predicts each vehicle's trajectory for 4 s (docs/explanation/prediction.md)."
        page, unit = "docs/results/prediction.md", "m"
    count = len(recorded)
    then = " (`vfn` was the network of a demonstrator then)" if "--policy vfn" in recorded[0] else ""
    yield f"- Data: {train['episodes']} episodes, recorded by {count} commands such as `{recorded[0]}`{then}."
    yield f"- Training: {training}, {steps} updates." + (
        f" {data['note'].capitalize()}." if "note" in data else ""
    )
    figures = {k: v for k, v in card["measured"].items() if isinstance(v, float)}
    text = ", ".join(f"{worded(key)} {value:g} {unit}" for key, value in figures.items())
    yield f"- Measured on {check['episodes']} validation episodes: {text}. On test seeds: {page}."
    yield from (f"- Limit: {text}" for text in PREDICTING_LIMITS)


def seeing(_: str, card: Card) -> Iterator[str]:
    """The lines about the frame encoder."""
    data, r2 = card["data"], card["measured"]["R2 on tuning seeds"]
    frames, sight = data["frames"], data["sight"]
    yield "- Turns one velocity map into 128 numbers that tell what stands on it (training.md, Seeing)."
    yield (
        f"- Data: {frames['training']:,} frames, {sight['drives']} drives of every demand of "
        f"{', '.join(data['scenarios'])}, seeds below 100,000; labels from the simulation."
    )
    yield f"- Training: `cosim train encoder --scenario all`, {sight['loop']['updates']} updates."
    shown = ("gap ahead, own lane", "speed ahead, own lane", "mission vehicle, presence")
    text = ", ".join(f"{key} {r2[key]:.2f}" for key in shown)
    yield f"- Measured on {frames['validation']:,} frames of tuning seeds, R2: {text}."
    yield "- Limit: it learned from the five worlds alone; nothing is known of its sight on other roads."


def worded(figure: str) -> str:
    """A figure of a JSON card in words: `position_error_0.2` is the one 0.2 s ahead."""
    horizon = figure.removeprefix("position_error_")
    return f"position error {horizon} s ahead" if horizon[0].isdigit() else figure.replace("_", " ")


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description="Write the cards of the networks that ship.")
    parser.add_argument("--out", type=Path, default=Path("docs/reference/models.md"), metavar="FILE")
    args = parser.parse_args(arguments)
    try:
        write_page(args.out, page())
    except CosimError as error:
        print(f"model_cards: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
