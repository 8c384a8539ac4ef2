"""Build every world's `net.net.xml` from its plain XML sources: `python -m sumo_scenarios.build`.

netconvert comes with the `eclipse-sumo` package (extra `tools`); the committed nets run without it.
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

# The worlds mean exactly what their sources say: nothing guessed, nothing joined, no u-turns, and
# coordinates as written (no offset), so that a picture's metres are the sources' metres.
OPTIONS = (
    "--no-turnarounds=true",
    "--offset.disable-normalization=true",
    "--no-internal-links=false",
    "--geometry.remove=false",
    "--junctions.join=false",
    "--precision=2",
)

# Names the machine and the moment: must not be in a committed file.
HEADER = re.compile(r"<!-- generated on .*?-->\s*", re.DOTALL)


def netconvert() -> str:
    """Path of netconvert: beside this Python first (the wheel's), else on the path.

    Raises:
        BadInput: it is not installed.
    """
    beside = shutil.which("netconvert", path=sysconfig.get_path("scripts"))
    found = beside or shutil.which("netconvert")
    if found is None:
        raise BadInput("netconvert is not installed; `pip install eclipse-sumo` (extra `tools`) brings it")
    return found


def net_text(world: Path) -> str:
    """The net of the world in folder `world`, built now from `plain/*.xml`; the same bytes every time.

    Raises:
        BadInput: netconvert is missing, there are no sources, or netconvert refuses them.
    """
    command = [netconvert(), *OPTIONS]
    for suffix, option in SOURCES.items():
        files = sorted((world / "plain").glob(f"*.{suffix}.xml"))
        if files:
            command += [option, ",".join(map(str, files))]
    if "--node-files" not in command:
        raise BadInput("no node file (*.nod.xml)", file=world / "plain")
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "net.xml"
        done = subprocess.run([*command, "-o", str(out)], capture_output=True, text=True, check=False)
        if done.returncode != 0 or not out.is_file():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            reason = lines[0] if lines else f"exit code {done.returncode}"
            raise BadInput(f"netconvert refuses the sources: {reason}", file=world / "plain")
        return HEADER.sub("", out.read_text(encoding="utf-8"))


def build(world: Path) -> Path:
    """Write the world's `net.net.xml` and return its path."""
    net = world / "net.net.xml"
    net.write_text(net_text(world), encoding="utf-8")
    return net


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m sumo_scenarios.build [NAME...]`: build these worlds, or all that have sources."""
    parser = argparse.ArgumentParser(prog="python -m sumo_scenarios.build", description=__doc__)
    parser.add_argument("worlds", nargs="*", metavar="NAME", help="worlds to build (default: all)")
    chosen: list[str] = parser.parse_args(arguments).worlds
    try:
        # A new world has sources before it has a scenario.yaml: take any folder with `plain/`.
        all_worlds = sorted(p.parent for p in ROOT.glob("**/plain") if any(p.glob("*.nod.xml")))
        worlds = [w for w in all_worlds if w.name in chosen] if chosen else all_worlds
        for name in set(chosen) - {w.name for w in worlds}:
            folder(name)  # raises, with the nearest name
        for world in worlds:
            print(f"{build(world).relative_to(ROOT)}", file=sys.stderr)
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
