"""SUMO's own output files on request: which there are, by SUMO's names, and whole files or none.

SUMO writes them itself; where to and with which settings is ours to say, so that a run writes into its own
folder only. What a setting does is written beside it; all of them yield to options typed after `--`.
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

DRAFT = ".part"  # folder of files that SUMO is still writing
FIELD = "--output"


@dataclass(frozen=True, slots=True)
class Output:
    """One kind of output: the option that names its file, and the settings that go with it."""

    option: str
    settings: tuple[tuple[str, str], ...] = ()


def _plain(name: str, *settings: tuple[str, str]) -> tuple[str, Output]:
    return name, Output(f"{name}-output", settings)


# Left out: `vtk` (a file for every step) and what writes for trains, buses and battery cars only.
OUTPUTS: dict[str, Output] = dict(
    (
        # vehicles are still on the road when an episode ends: without this the file would be empty
        _plain("tripinfo", ("tripinfo-output.write-unfinished", "true"),
                           ("tripinfo-output.write-undeparted", "true")),
        _plain("vehroute", ("vehroute-output.write-unfinished", "true")),
        _plain("stop", ("stop-output.write-unfinished", "true")),
        _plain("fcd"),
        # on every vehicle; SUMO has more measures than these three, which are the ones that cosim reports too
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
    """Raises BadInput for a name that SUMO does not have (with the nearest one), or a file named twice.

    `options`: SUMO options of the scenario, which may name the same file.
    """
    given = dict(options)
    for name in names:
        option = OUTPUTS[one_of(name, OUTPUTS, FIELD)].option
        if option in given:
            problem = f"its file is named by {FIELD} {name} already"
            raise BadInput(problem, field=f"--{option}", value=given[option])


def sumo_options(files: Mapping[str, Path], scenario: Scenario) -> tuple[dict[str, str], dict[str, str]]:
    """The SUMO options for these files (name -> path): (settings a user may override, the files' names).

    Floating-car data begin with the counted time and hold the frames that the figures are made of, so
    that `cosim metrics` finds the same figures again; SUMO stamps a step with the time it began. All files
    get six digits: with SUMO's two, a jerk from speeds 0.2 s apart would be off by 0.5 m/s3.
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
    """Paths for SUMO to write to; they become `folder`/NAME.xml when the block ends well, else they vanish.

    Close SUMO inside the block: it writes the last lines then. Raises SimulationError when a file is not
    whole (a full disk), BadInput when the folder cannot be written.
    """
    if not names or folder is None:
        yield {}
        return
    draft = folder / DRAFT
    shutil.rmtree(draft, ignore_errors=True)  # of a run that was killed
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
