"""Prints the requirements of pyproject.toml, without cosim itself: `dependencies.py [EXTRA,EXTRA...]`.

An image installs this list in its own layer, which does not change with cosim's code.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path


def dependencies(project: dict, extras: list[str]) -> list[str]:
    """The requirements of `project` and its `extras`; extras of extras (`NAME[a,b]`) are resolved.

    Raises KeyError for an unknown extra.
    """
    found = list(project["dependencies"])
    waiting = list(extras)
    while waiting:
        for line in project["optional-dependencies"][waiting.pop(0)]:
            own = re.fullmatch(rf"{project['name']}\[(.+)\]", line)
            if own:
                waiting += [name.strip() for name in own[1].split(",")]
            elif line not in found:
                found.append(line)
    return found


def main() -> int:
    """Exit code 2 for an unknown extra."""
    extras = [name.strip() for name in ",".join(sys.argv[1:]).split(",") if name.strip()]
    project = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]
    try:
        print(*dependencies(project, extras), sep="\n")
    except KeyError as error:
        known = ", ".join(project["optional-dependencies"])
        print(f"no extra {error} in pyproject.toml; there are {known}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
