"""Build the worlds of this folder with netconvert and netgenerate of the `eclipse-sumo` package.

    python tests/worlds/build.py FOLDER [NAME ...]

writes FOLDER/NAME/NAME.sumocfg with its net and routes, for each world or the named ones, and prints the
configuration files. The same sources give the same files on every call.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

SOURCES = Path(__file__).parent
NAMES = tuple(sorted(path.parent.name for path in SOURCES.glob("*/demand.rou.xml")))
DURATION = 120.0  # s
CONFIGURATION = """<configuration>
    <net-file value="net.net.xml"/>
    <route-files value="demand.rou.xml"/>
    <begin value="0"/>
    <end value="{end:g}"/>
    <step-length value="0.1"/>
    <time-to-teleport value="-1"/>
    <collision.check-junctions value="true"/>
</configuration>
"""


def build(folder: Path, names: Sequence[str] = NAMES) -> dict[str, Path]:
    """World -> its .sumocfg below `folder`. Raises CalledProcessError where SUMO's tools refuse a source."""
    import sumo

    tools = Path(sumo.__file__).parent / "bin"
    built = {}
    for name in names:
        source, place = SOURCES / name, folder / name
        place.mkdir(parents=True, exist_ok=True)
        generated = source / "net.netgcfg"
        tool, settings = (
            ("netgenerate", generated) if generated.is_file() else ("netconvert", source / "net.netccfg")
        )
        command = [str(tools / tool), "-c", str(settings), "-o", str(place.absolute() / "net.net.xml")]
        subprocess.run(command, check=True, cwd=source, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        shutil.copyfile(source / "demand.rou.xml", place / "demand.rou.xml")
        built[name] = place / f"{name}.sumocfg"
        built[name].write_text(CONFIGURATION.format(end=DURATION), encoding="utf-8")
    return built


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    for configuration in build(Path(sys.argv[1]), sys.argv[2:] or NAMES).values():
        print(configuration)
