"""Builds `net.net.xml` of every scenario from plain XML sources: `python -m sumo_scenarios.build`.

netconvert comes with the `eclipse-sumo` package (extra `tools`); the committed nets do not need it.
"""

import argparse
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cosim.errors import BadInput, CosimError
from sumo_scenarios import ROOT, folder

# plain/*.SUFFIX.xml -> netconvert's option
SOURCES = {"nod": "--node-files", "edg": "--edge-files", "con": "--connection-files", "typ": "--type-files"}

# The nets follow their sources exactly: nothing guessed, nothing joined, no U-turns, and coordinates
# without an offset, so that pictures and sources have the same coordinates.
OPTIONS = (
    "--no-turnarounds=true",
    "--offset.disable-normalization=true",
    "--no-internal-links=false",
    "--geometry.remove=false",
    "--junctions.join=false",
    "--precision=2",
)

# Contains machine and time of the build, which must not be committed.
HEADER = re.compile(r"<!-- generated on .*?-->\s*", re.DOTALL)


def netconvert() -> str:
    """Path of netconvert: the wheel's, beside this Python, else the one on PATH.

    Raises:
        BadInput: netconvert is not installed.
    """
    beside = shutil.which("netconvert", path=sysconfig.get_path("scripts"))
    found = beside or shutil.which("netconvert")
    if found is None:
        raise BadInput("netconvert is not installed; `pip install eclipse-sumo` (extra `tools`) brings it")
    return found


def net_text(scenario: Path) -> str:
    """The net of the scenario folder, built from `plain/*.xml`; always the same bytes.

    Raises:
        BadInput: netconvert is missing, there are no sources, or netconvert refuses them.
    """
    command = [netconvert(), *OPTIONS]
    for suffix, option in SOURCES.items():
        files = sorted((scenario / "plain").glob(f"*.{suffix}.xml"))
        if files:
            command += [option, ",".join(map(str, files))]
    if "--node-files" not in command:
        raise BadInput("no node file (*.nod.xml)", file=scenario / "plain")
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "net.xml"
        done = subprocess.run([*command, "-o", str(out)], capture_output=True, text=True, check=False)
        if done.returncode != 0 or not out.is_file():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            reason = lines[0] if lines else f"exit code {done.returncode}"
            raise BadInput(f"netconvert refuses the sources: {reason}", file=scenario / "plain")
        return HEADER.sub("", out.read_text(encoding="utf-8"))


def build(scenario: Path) -> Path:
    """Write `net.net.xml` of the scenario folder and return its path."""
    net = scenario / "net.net.xml"
    net.write_text(net_text(scenario), encoding="utf-8")
    return net


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m sumo_scenarios.build [NAME...]`: build these scenarios, or all with sources."""
    parser = argparse.ArgumentParser(prog="python -m sumo_scenarios.build", description=__doc__)
    parser.add_argument("worlds", nargs="*", metavar="NAME", help="scenarios to build (default: all)")
    chosen: list[str] = parser.parse_args(arguments).worlds
    try:
        # A new scenario has sources before it has a scenario.yaml: take any folder with `plain/`.
        every = sorted(p.parent for p in ROOT.glob("**/plain") if any(p.glob("*.nod.xml")))
        scenarios = [s for s in every if s.name in chosen] if chosen else every
        for name in set(chosen) - {s.name for s in scenarios}:
            folder(name)  # raises, with the nearest name
        for scenario in scenarios:
            print(f"{build(scenario).relative_to(ROOT)}", file=sys.stderr)
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
