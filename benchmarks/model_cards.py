"""Model cards of the shipped networks in two tables: inputs, training, results and limits.

    python -m benchmarks.model_cards [--out docs/reference/models.md]

Sources: the JSON cards beside the weights (`policy.checkpoint`), the training logs and docs/results. No
episode is driven.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown_row, write_page
from cosim.errors import CosimError
from policy.agents.approaches import APPROACHES
from policy.checkpoint import SHIPPED, read_card

Card = Mapping[str, Any]
RESULTS = Path("docs/results")
LINK = "../results"  # from the page
HEAD = (
    "# The shipped networks",
    "",
    "Made by `python -m benchmarks.model_cards`.",
    "",
    "Each network has a card beside its weights, `policy/weights/NAME.json`. It holds data, complete",
    "configuration, commands, validation figures and SHA-256. The licence is MIT, like the code's. All",
    "training seeds are below 100,000.",
)
AGENTS = (
    "network",
    "chooses from",
    "safety mask",
    "episodes",
    "phi, degrees",
    "training",
    "in validation",
    "results",
    "limits",
)
PREDICTORS = ("network", "predicts", "data", "training", "in validation", "results", "limits")
LIMITS = {
    "law": "Has no input for signals, speed limits inside junctions, pedestrians or bicycles. In preset "
    "`unguarded` it drives through red lights.",
    "maps only": "Has no other inputs than maps.",
    "one seed": "Was trained once, from one seed, in preset `unguarded`, with human drivers without errors. "
    "The difference to another seed is not measured.",
    "two seeds": "Was trained twice, from two seeds, in preset `unguarded`, with human drivers without "
    "errors. The better one in validation ships; the [learning curves](../results/learning.md) show both.",
    "scenarios": "Was trained on the shipped scenarios only, with drivers that follow IDM and LC2013 or "
    "MOBIL, without errors. Its error on recorded traffic or on other roads is unknown.",
}
# Results page -> form of a network's name in its table.
MEASURED = {
    "table3": "| {} |",
    "decisions": "| {} |",
}


def names() -> list[str]:
    """The shipped networks, agents first."""
    found = sorted(path.stem for path in SHIPPED.glob("*.safetensors"))
    return sorted(found, key=lambda name: (name not in APPROACHES, not name.startswith("hpn"), name))


def page() -> list[str]:
    """The Markdown page. Raises BadInput and WeightsMismatch if weights and card disagree."""
    cards = {name: read_card(SHIPPED / f"{name}.safetensors") for name in names()}
    agents = [agent(name, card) for name, card in cards.items() if name in APPROACHES]
    others = [
        (encoder if name == "encoder" else predictor)(name, card)
        for name, card in cards.items()
        if name not in APPROACHES
    ]
    used = {limit for row in (*agents, *others) for limit in row[-1].split("; ")}
    return [
        *HEAD,
        *("", "## Agents", "", *table(AGENTS, agents)),
        *("", "## Predictors and encoder", "", *table(PREDICTORS, others)),
        *(
            "",
            "## Limits",
            "",
            *table(("limit", "the network"), (row for row in LIMITS.items() if row[0] in used)),
        ),
        "",
    ]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]] | Iterator[Sequence[str]]) -> Iterator[str]:
    """The lines of a Markdown table."""
    yield markdown_row(heads)
    yield markdown_row(["---"] * len(heads))
    yield from map(markdown_row, rows)


def agent(name: str, card: Card) -> tuple[str, ...]:
    """The row of a value network or a baseline of P's Table III, with columns `AGENTS`."""
    data, folder = card["data"], RESULTS / "trainings" / f"{name}-0"
    training = data["training"]
    log = [json.loads(line) for line in (folder / "log.jsonl").read_text("utf-8").splitlines()]
    return (
        f"`{name}`",
        sees(name, card),
        "none" if APPROACHES[name].mask == "none" else f"on `{data['predictor']}`",
        str(len(log) * training["episodes"]),
        ", ".join(f"{phi:g}" for phi in training["svo"]),
        trained(card, folder, log),
        validated(card),
        ", ".join(pages(name)) or "none yet",
        "; ".join(limits(name)),
    )


def sees(name: str, card: Card) -> str:
    """The inputs of an agent, and its map extractor."""
    approach, extractor = APPROACHES[name], card["configs"]["vfn"]["extractor"]
    parts = {"maps": True, "predicted maps": approach.predicted_maps, "kinematics": approach.kinematics}
    return f"{', '.join(part for part, there in parts.items() if there)}; `{extractor}`"


def trained(card: Card, folder: Path, log: Sequence[Mapping[str, Any]]) -> str:
    """The training of the weights: command, iteration, updates, and duration of the whole training."""
    chosen = card["measured"]["iteration"]
    command = f"`{card['data']['commands']['train']}` (commit {card['data']['commit']})"
    config = f"[configuration]({LINK}/trainings/{folder.name}/config.yaml)"
    updates = next(row["updates"] for row in log if row["iteration"] == chosen)
    hours = sum(row["iteration_s"] for row in log) / 3600
    return f"{command}, {config}, iteration {chosen} of {len(log)}, {updates:,} updates; {hours:.1f} h in all"


def validated(card: Card) -> str:
    """The validation results of the chosen weights."""
    measured, training = card["measured"]["validation"], card["data"]["training"]
    drives = training["validation"] * len(training["lessons"])
    crashed, admitted = measured["valid/crashed"], measured["valid/mission_success"]
    return f"{drives} drives: {crashed:.0%} crashed, {admitted:.0%} of missions fulfilled"


def limits(name: str) -> Iterator[str]:
    """Names of the `LIMITS` of an agent."""
    yield "law"
    if not APPROACHES[name].kinematics:
        yield "maps only"
    yield "two seeds" if (RESULTS / "trainings" / f"{name}-1").is_dir() else "one seed"


def pages(name: str) -> Iterator[str]:
    """Links to the results pages with figures of an agent."""
    for title, form in MEASURED.items():
        page = RESULTS / f"{title}.md"  # missing for a claim without results yet
        if page.is_file() and form.format(name) in page.read_text(encoding="utf-8"):
            yield f"[{title}]({LINK}/{title}.md)"


def predictor(name: str, card: Card) -> tuple[str, ...]:
    """The row of an HPN variant or a trajectory predictor, with columns `PREDICTORS`."""
    data, measured = card["data"], card["measured"]
    if name.startswith("hpn"):
        episodes, command = data["train"]["episodes"], data["commands"]["train"]
        loss = "plain loss" if "validation_maps" in measured else "loss"  # another sum, not comparable
        what, error = "maps and kinematics", f"{loss} {measured['validation_loss']:.3g}"
        result = f"[prediction_maps]({LINK}/prediction_maps.md)"
    else:
        episodes, command = data["training"]["episodes"], "cosim fit-predictors"
        what, error = "trajectories", f"mean error {measured['position_error_mean']:.2f} m"
        result = f"[prediction]({LINK}/prediction.md)"
    return f"`{name}`", f"{what}, 4 s", f"{episodes} episodes", f"`{command}`", error, result, "scenarios"


def encoder(name: str, card: Card) -> tuple[str, ...]:
    """The row of the frame encoder, with columns `PREDICTORS`."""
    frames, r2 = card["data"]["frames"]["training"], card["measured"]["R2 on tuning seeds"]
    shown = {"gap": "gap ahead, own lane", "speed": "speed ahead, own lane"}
    error = "R² ahead in its lane: " + ", ".join(f"{what} {r2[key]:.2f}" for what, key in shown.items())
    what = "the vehicles on a velocity map, as 128 numbers"
    return f"`{name}`", what, f"{frames:,} maps", "`cosim train encoder`", error, "none", "scenarios"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description="Write the page of the shipped networks.")
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
