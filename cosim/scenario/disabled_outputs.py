"""Copies of a user's files for SUMO, with outputs disabled and lists of vTypes completed.

Detectors, edgeData and timed events write to their `file` or `dest`, usually beside the scenario (A10KW:
netstate.xml, tlsstate.xml). That fails in a read-only folder, overwrites earlier runs, and races between
workers; `host:port` opens a connection. The elements stay, so that references to detectors remain valid.
Only the file name becomes SUMO's name for no file.

Rerouters, detectors, calibrators and signals may apply to some vTypes only. AVs drive with a derived vType
(`cosim.scenario.vehicle_types`), so it is added to such lists.
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

NOWHERE = "NUL"  # SUMO's OutputDevice writes no file for this name, on every system
# Attributes that name an input file, relative to the present file: made absolute in a copy.
_INPUTS = {
    "include": "href",
    "rerouter": "file",
    "variableSpeedSign": "file",
    "poly": "imgFile",
    "poi": "imgFile",
}
Also = Callable[[str], Iterable[str]]  # vType -> derived vTypes
_TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")


def disable_outputs(scenario: Scenario, folder: Path, also: Also = lambda _: ()) -> Scenario:
    """`scenario` with copies, in `folder`, of those files that would write outputs; other files stay.

    Lists of vTypes are extended by `also`. Call after `cosim.scenario.vet.vet`, which checks that the files
    are valid XML.
    """
    return replace(
        scenario,
        net=_disabled(scenario.net, folder, also, only=b"vTypes"),  # signals may apply to some vTypes only
        additional=tuple(_disabled(path, folder, also) for path in scenario.additional),
        demand=tuple(_disabled(path, folder, also) for path in scenario.demand),
    )


def _disabled(path: Path, folder: Path, also: Also, only: bytes = b"") -> Path:
    """A copy of `path` in `folder`; `path` itself if nothing has to change or it lacks `only`."""
    whole = content(path)
    edits = _edits(whole, path, folder, also) if only in whole else []
    if not any(writes for *_, writes in edits):
        return path
    for begin, end, value, _ in sorted(edits, reverse=True):  # from the end: earlier positions stay
        whole = whole[:begin] + value + whole[end:]
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{sum(1 for _ in folder.iterdir())}-{path.name.removesuffix('.gz')}"
    copy.write_bytes(whole)
    return copy


def _edits(whole: bytes, path: Path, folder: Path, also: Also) -> list[tuple[int, int, bytes, bool]]:
    """(first byte, byte after the last, new value, whether the file must change), in the file's order."""
    found: list[tuple[int, int, bytes, bool]] = []
    parser = expat.ParserCreate()
    owner = ""  # the element of the present <param>

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
    """Byte span of the value of `attribute` in the tag at byte `tag_begin`."""
    tag = _TAG.match(whole, tag_begin)
    assert tag is not None, "vetted XML"
    values = re.finditer(rb"([\w:.-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", tag[0])
    match = next(match for match in values if match[1] == attribute.encode())
    begin, end = match.span(2 if match[2] is not None else 3)
    return tag_begin + begin, tag_begin + end
