"""The replay as one self-contained HTML file: no network, no library, a plain canvas."""

from __future__ import annotations

import html
from importlib import resources
from string import Template

from cosim.recording.watched import Watched
from cosim.report.replay.packing import packed

SCRIPTS = ("data.js", "view.js", "draw.js", "panel.js", "main.js")


def page(watched: Watched) -> str:
    """The whole page as text."""
    assets = resources.files(__package__).joinpath("assets")
    facts = watched.facts
    title = " / ".join(str(facts.get(name, "")) for name in ("scenario", "demand", "policy"))
    scripts = [assets.joinpath(name).read_text("utf-8") for name in SCRIPTS]
    return Template(assets.joinpath("page.html").read_text("utf-8")).substitute(
        title=html.escape(f"{title}, seed {facts.get('seed', '')}"),
        style=assets.joinpath("style.css").read_text("utf-8"),
        script="\n".join(scripts),
        data=packed(watched),
    )
