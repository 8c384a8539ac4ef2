"""Keep a user's additional files from writing: copies of them in which no output is written.

Detectors, edgeData and timed events write wherever their `file` or `dest` says, beside the scenario as a
rule (A10KW: netstate.xml, tlsstate.xml). That fails in a read-only folder, is overwritten by the next run,
races between workers, and `host:port` opens a connection. The elements stay, so that whatever refers to a
detector still finds it; only the name of the file becomes SUMO's own word for no file.
"""

import re
from dataclasses import replace
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

from cosim.files.xml_input import content
from cosim.scenario import Scenario
from cosim.scenario.vet_demand import OUTPUT_PARAMETERS, OUTPUTS

NOWHERE = "NUL"  # SUMO's OutputDevice makes no file of it, on every system
# Attributes by which a file reads another one, relative to itself: absolute in a copy.
_INPUTS = {
    "include": "href",
    "rerouter": "file",
    "variableSpeedSign": "file",
    "poly": "imgFile",
    "poi": "imgFile",
}
_TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")


def disable_outputs(scenario: Scenario, folder: Path) -> Scenario:
    """`scenario` with its writing files replaced by copies in `folder` that write nothing; the others stay.

    Call after `cosim.scenario.vet.vet`: the files are taken to be sound XML.
    """
    return replace(
        scenario,
        additional=tuple(_disabled(path, folder) for path in scenario.additional),
        demand=tuple(_disabled(path, folder) for path in scenario.demand),
    )


def _disabled(path: Path, folder: Path) -> Path:
    """`path` itself when it writes nothing, else its copy in `folder`."""
    whole = content(path)
    edits = _edits(whole, path, folder)
    if not any(writes for *_, writes in edits):
        return path
    for begin, end, value, _ in sorted(edits, reverse=True):  # from the back, so that places stay
        whole = whole[:begin] + value + whole[end:]
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{sum(1 for _ in folder.iterdir())}-{path.name.removesuffix('.gz')}"
    copy.write_bytes(whole)
    return copy


def _edits(whole: bytes, path: Path, folder: Path) -> list[tuple[int, int, bytes, bool]]:
    """(first byte, byte after the last, new value, whether it is about writing), in the file's order."""
    found: list[tuple[int, int, bytes, bool]] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        is_parameter = tag == "param" and attributes.get("key") in OUTPUT_PARAMETERS
        written = "value" if is_parameter else OUTPUTS.get(tag)
        if written is not None and attributes.get(written):
            found.append((*_place(whole, parser.CurrentByteIndex, written), NOWHERE.encode(), True))
        read = _INPUTS.get(tag)
        if read is not None and attributes.get(read):
            source = path.parent / attributes[read]
            target = _disabled(source, folder) if tag == "include" else source
            text = escape(str(target.absolute()), {'"': "&quot;", "'": "&apos;"})
            place = _place(whole, parser.CurrentByteIndex, read)
            found.append((*place, text.encode(), target != source))

    parser.StartElementHandler = start
    parser.Parse(whole, True)
    return found


def _place(whole: bytes, tag_begin: int, attribute: str) -> tuple[int, int]:
    """Where the value of `attribute` lies in the tag that begins at byte `tag_begin`."""
    tag = _TAG.match(whole, tag_begin)
    assert tag is not None, "vetted XML"
    values = re.finditer(rb"([\w:.-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", tag[0])
    match = next(match for match in values if match[1] == attribute.encode())
    begin, end = match.span(2 if match[2] is not None else 3)
    return tag_begin + begin, tag_begin + end
