"""Passes this machine's pip settings to an image's build: `host_pip.py FOLDER`.

The build uses the same sources of packages: folders of wheels, indexes, a certificate bundle. FOLDER gets a
pip.conf and the bundle. The folders in the settings are printed for mounting, a line `SOURCE TARGET` each.
The pip.conf has only mounted paths, so that no path of this machine gets into the image.
"""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

INSIDE = "/run/host-pip"  # where FOLDER and the folders of packages are mounted
PLACES = ("index-url", "extra-index-url", "find-links")
PLAIN = ("no-index", "trusted-host", "timeout", "default-timeout", "proxy")


def settings(listing: str) -> dict[str, str]:
    """The output of `pip config list` as option -> value; the more specific or later line wins."""
    found: dict[str, str] = {}
    rank = {"global": 0, "user": 1, "site": 2, "install": 3, ":env:": 4}
    lines = [line.partition("=") for line in listing.splitlines() if "=" in line]
    for key, _, value in sorted(lines, key=lambda line: rank.get(line[0].partition(".")[0], -1)):
        section, _, option = key.partition(".")
        if section in rank:
            found[option] = str(ast.literal_eval(value))
    return found


def lend(found: dict[str, str]) -> tuple[str, dict[str, str], str | None]:
    """(the text of the pip.conf, {folder here: folder inside}, certificate bundle here or None)."""
    mounts: dict[str, str] = {}
    lines = ["[global]"]
    for option in PLACES:
        places = [_moved(place, mounts) for place in found.get(option, "").split()]
        if places:
            lines.append(f"{option} = {' '.join(places)}")
    lines += [f"{option} = {found[option]}" for option in PLAIN if option in found]
    bundle = found.get("cert")
    if bundle:
        lines.append(f"cert = {INSIDE}/ca.pem")
    return "\n".join(lines) + "\n", mounts, bundle


def _moved(place: str, mounts: dict[str, str]) -> str:
    """`place` as seen inside the build: a folder is added to `mounts`, a URL is unchanged."""
    url = urlsplit(place)
    if url.scheme not in ("", "file"):
        return place
    folder = Path(unquote(url.path) if url.scheme else place)
    tail = ""
    if folder.name == "simple":  # an index as in PEP 503, whose links may point beside it
        folder, tail = folder.parent, "/simple"
    inside = mounts.setdefault(str(folder), f"{INSIDE}-{len(mounts)}")
    return f"{'file://' if url.scheme else ''}{inside}{tail}"


def main() -> int:
    """Write FOLDER/pip.conf (and ca.pem), print the mounts."""
    folder = Path(sys.argv[1])
    listing = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    text, mounts, bundle = lend(settings(listing))
    (folder / "pip.conf").write_text(text, "utf-8")
    if bundle:
        shutil.copy(bundle, folder / "ca.pem")
    for source, inside in mounts.items():
        print(source, inside)
    return 0


if __name__ == "__main__":
    sys.exit(main())
