"""One episode's result: the titles of its figures, and its run folder."""

import json
from collections.abc import Sequence
from pathlib import Path

from cosim.files import cannot, whole
from cosim.types import EpisodeResult, Metric

NOISE = 1e-9  # in a figure's own unit: less is the rounding of a sum
# Figures of all vehicles that were due to depart (figures.md, Everybody), in words.
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
# Violations by AVs (figures.md, The law), in words; shown in red when not 0.
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
# Measures of near-misses (figures.md), by the suffix of their columns.
NEAR_MISSES = {"ttc": "TTC < 1.5 s", "drac": "DRAC > 3.35 m/s2", "pet": "PET < 1 s"}


def write_folder(folder: Path, result: EpisodeResult, text: str, outputs: Sequence[str] = ()) -> None:
    """Write `result.json`, `manifest.json` and `metrics.txt` (`text`), each atomically.

    Films, pages and SUMO outputs of an earlier run in the folder are deleted, except `outputs`, those of this
    run. Raises BadInput when the folder cannot be written.
    """
    document = result.document()
    texts = {
        "manifest.json": json.dumps(document["manifest"], indent=2),
        "metrics.txt": text,
        "result.json": json.dumps(document, indent=2),
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
    """One figure with its unit, for people: `12.5 m`, `yes`, `NA`."""
    value = metric.value
    if value is None:
        return "NA"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if abs(value) < NOISE:
        value = 0
    shown = f"{value:.3g}" if isinstance(value, float) and abs(value) < 100 else f"{value:.0f}"
    return f"{shown} {metric.unit}".rstrip()
