"""SUMO's own output files on request, by SUMO's names, complete or not at all.

SUMO writes the files. cosim sets the paths, so that a run writes into its own folder only, and the options
below. Options typed after `--` override these.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.errors import BadInput, SimulationError, one_of
from cosim.files import cannot
from cosim.scenario import Scenario

DRAFT = ".part"  # folder of unfinished files
FIELD = "--output"


@dataclass(frozen=True, slots=True)
class Output:
    """One kind of output: the option for its file name, and accompanying settings."""

    option: str
    settings: tuple[tuple[str, str], ...] = ()


def _plain(name: str, *settings: tuple[str, str]) -> tuple[str, Output]:
    return name, Output(f"{name}-output", settings)


# Omitted: `vtk` (one file per step), and outputs only for trains, buses or battery vehicles.
OUTPUTS: dict[str, Output] = dict(
    (
        # includes vehicles still on the road at the end of the episode
        _plain("tripinfo", ("tripinfo-output.write-unfinished", "true"),
                           ("tripinfo-output.write-undeparted", "true")),
        _plain("vehroute", ("vehroute-output.write-unfinished", "true")),
        _plain("stop", ("stop-output.write-unfinished", "true")),
        _plain("fcd"),
        # for every vehicle; of SUMO's measures the three that cosim reports too
        ("ssm", Output("device.ssm.file", (("device.ssm.probability", "1"),
                                            ("device.ssm.measures", "TTC DRAC PET")))),
        _plain("summary"),
        _plain("statistic"),
        _plain("emission", ("device.emissions.probability", "1")),
        _plain("lanechange"),
        _plain("queue"),
        _plain("collision"),
        ("netstate", Output("netstate-dump")),
        _plain("full"),
        _plain("link"),
        _plain("edgedata"),
        _plain("lanedata"),
        _plain("amitran"),
        _plain("deadlock"),
        _plain("personinfo"),
        _plain("person-summary"),
    )
)  # fmt: skip


def check(names: Sequence[str], options: Mapping[str, str] | Sequence[tuple[str, str]] = ()) -> None:
    """Raises BadInput for an unknown name (with the nearest known one), or an output requested twice.

    `options`: SUMO options of the scenario, which may request the same output.
    """
    given = dict(options)
    for name in names:
        option = OUTPUTS[one_of(name, OUTPUTS, FIELD)].option
        if option in given:
            problem = f"its file is named by {FIELD} {name} already"
            raise BadInput(problem, field=f"--{option}", value=given[option])


def sumo_options(files: Mapping[str, Path], scenario: Scenario) -> tuple[dict[str, str], dict[str, str]]:
    """The SUMO options for these files (name -> path): (settings a user may override, file names).

    Floating-car data begin with the counted time and contain the frames of the figures, so that `cosim
    metrics` reproduces the figures. SUMO stamps a step with its begin. All files have six digits: with SUMO's
    two, a jerk from speeds 0.2 s apart would be off by 0.5 m/s3.
    """
    if not files:
        return {}, {}
    timing = scenario.timing
    settings = {"precision": "6"}
    for name in files:
        settings |= dict(OUTPUTS[name].settings)
    if "fcd" in files:
        first = scenario.begin + (scenario.warmup or timing.frame) - timing.step
        settings |= {"device.fcd.begin": f"{first:.3f}", "device.fcd.period": f"{timing.frame:g}"}
    return settings, {OUTPUTS[name].option: str(path) for name, path in files.items()}


@contextlib.contextmanager
def drafts(names: Sequence[str], folder: Path | None) -> Iterator[dict[str, Path]]:
    """Draft paths for SUMO; moved to `folder`/NAME.xml if the block succeeds, else deleted.

    Close SUMO inside the block, since it writes the last lines at its end. Raises SimulationError for an
    incomplete file (a full disk), BadInput for a folder that cannot be written.
    """
    if not names or folder is None:
        yield {}
        return
    draft = folder / DRAFT
    shutil.rmtree(draft, ignore_errors=True)  # left by a killed run
    with cannot("make this folder", file=draft, field=FIELD):
        draft.mkdir(parents=True)
    try:
        files = {name: draft / f"{name}.xml" for name in dict.fromkeys(names)}
        yield files
        for name, path in files.items():
            if not _whole(path):
                raise SimulationError(f"{folder / path.name}: SUMO did not write the whole {name} file")
        for path in files.values():
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _whole(path: Path) -> bool:
    """Whether an XML file ends with the closing tag of its root."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(-min(file.tell(), 200), os.SEEK_END)
            tail = file.read().rstrip()
    except OSError:
        return False
    last = tail.rpartition(b"<")[2]
    return last.endswith(b">") and (last.startswith(b"/") or last.endswith(b"/>"))
