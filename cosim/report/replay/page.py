"""The replay as one self-contained HTML file with a canvas, without libraries or network access."""

import base64
import gzip
import html
import json
from importlib import resources
from string import Template

from cosim.recording.replay_data import ReplayData
from cosim.report.replay.packing import document

ASSETS = resources.files(__package__).joinpath("assets")
# Scripts of the viewer, independent of the data's source.
VIEWER = ("text.js", "data.js", "view.js", "draw.js", "panel.js", "main.js")


def page(replay: ReplayData) -> str:
    """The whole page as text."""
    facts = replay.facts
    text = json.dumps(document(replay), separators=(",", ":"), allow_nan=False)
    title = " / ".join(str(facts.get(name, "")) for name in ("scenario", "demand", "policy"))
    return Template(asset("page.html")).substitute(
        title=html.escape(f"{title}, seed {facts.get('seed', '')}"),
        style=asset("style.css"),
        viewer=viewer(),
        script="\n".join(map(asset, (*VIEWER, "boot.js"))),
        data=base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode(),
    )


def viewer(nav: str = "", stage: str = "", aside: str = "") -> str:
    """The body of the viewer's page. `nav`, `stage`, `aside`: HTML at the head, over the scene, aside."""
    return Template(asset("viewer.html")).substitute(nav=nav, stage=stage, aside=aside)


def asset(name: str) -> str:
    """The text of one of the page's parts."""
    return ASSETS.joinpath(name).read_text("utf-8")
