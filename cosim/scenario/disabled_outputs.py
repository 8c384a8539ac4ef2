"""A user's files as SUMO is given them: copies in which no output is written and lists of types are whole.

Detectors, edgeData and timed events write wherever their `file` or `dest` says, beside the scenario as a
rule (A10KW: netstate.xml, tlsstate.xml). That fails in a read-only folder, is overwritten by the next run,
races between workers, and `host:port` opens a connection. The elements stay, so that whatever refers to a
detector still finds it; only the name of the file becomes SUMO's own word for no file.

Rerouters, detectors, calibrators and signals can be for some vehicle types alone. An AV drives as another
type than its own (`cosim.scenario.vehicle_types`), which such lists then name too.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

from cosim.files.xml_input import content
from cosim.scenario import Scenario
from cosim.scenario.vehicle_types import TYPE_LISTS
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
Also = Callable[[str], Iterable[str]]  # a type's name -> what vehicles of it may be called besides
_TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")


def disable_outputs(scenario: Scenario, folder: Path, also: Also = lambda _: ()) -> Scenario:
    """`scenario` with its writing files replaced by copies in `folder` that write nothing; the others stay.

    Lists of types get the names that `also` gives to those they hold. Call after `cosim.scenario.vet.vet`:
    the files are taken to be sound XML.
    """
    return replace(
        scenario,
        net=_disabled(scenario.net, folder, also, only=b"vTypes"),  # its signals may be for some types
        additional=tuple(_disabled(path, folder, also) for path in scenario.additional),
        demand=tuple(_disabled(path, folder, also) for path in scenario.demand),
    )


def _disabled(path: Path, folder: Path, also: Also, only: bytes = b"") -> Path:
    """`path` itself when nothing in it has to change, or `only` is not in it, else its copy in `folder`."""
    whole = content(path)
    edits = _edits(whole, path, folder, also) if only in whole else []
    if not any(writes for *_, writes in edits):
        return path
    for begin, end, value, _ in sorted(edits, reverse=True):  # from the back, so that places stay
        whole = whole[:begin] + value + whole[end:]
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{sum(1 for _ in folder.iterdir())}-{path.name.removesuffix('.gz')}"
    copy.write_bytes(whole)
    return copy


def _edits(whole: bytes, path: Path, folder: Path, also: Also) -> list[tuple[int, int, bytes, bool]]:
    """(first byte, byte after the last, new value, whether the file must change), in the file's order."""
    found: list[tuple[int, int, bytes, bool]] = []
    parser = expat.ParserCreate()
    owner = ""  # the tag that parameters belong to

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal owner
        owner = owner if tag in ("param", "phase") else tag
        is_parameter = tag == "param" and attributes.get("key") in OUTPUT_PARAMETERS
        written = "value" if is_parameter else OUTPUTS.get(tag)
        if written is not None and attributes.get(written):
            found.append((*_place(whole, parser.CurrentByteIndex, written), NOWHERE.encode(), True))
        of_signal = tag == "param" and owner == "tlLogic" and attributes.get("key") == "vTypes"
        listed = "value" if of_signal else TYPE_LISTS.get(tag)
        names = attributes.get(listed, "").split() if listed is not None else []
        if listed is not None and (more := [other for name in names for other in also(name)]):
            text = _quoted(" ".join((*names, *more)))
            found.append((*_place(whole, parser.CurrentByteIndex, listed), text, True))
        read = _INPUTS.get(tag)
        if read is not None and attributes.get(read):
            source = path.parent / attributes[read]
            target = _disabled(source, folder, also) if tag == "include" else source
            place = _place(whole, parser.CurrentByteIndex, read)
            found.append((*place, _quoted(str(target.absolute())), target != source))

    parser.StartElementHandler = start
    parser.Parse(whole, True)
    return found


def _quoted(value: str) -> bytes:
    return escape(value, {'"': "&quot;", "'": "&apos;"}).encode("ascii", "xmlcharrefreplace")


def _place(whole: bytes, tag_begin: int, attribute: str) -> tuple[int, int]:
    """Where the value of `attribute` lies in the tag that begins at byte `tag_begin`."""
    tag = _TAG.match(whole, tag_begin)
    assert tag is not None, "vetted XML"
    values = re.finditer(rb"([\w:.-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", tag[0])
    match = next(match for match in values if match[1] == attribute.encode())
    begin, end = match.span(2 if match[2] is not None else 3)
    return tag_begin + begin, tag_begin + end
