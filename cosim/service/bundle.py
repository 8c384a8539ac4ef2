"""The main file of an upload, and the check that its files refer only to one another.

The check runs before any reference is followed.
"""

from pathlib import Path
from urllib.parse import urlsplit

from cosim.errors import BadInput
from cosim.files.xml_input import scan
from cosim.scenario.sumocfg import FILE_OPTIONS, INPUTS
from cosim.scenario.vet_demand import OUTPUTS

# Attributes in which SUMO's files name other files. Files of elements that write are never opened
# (`cosim.scenario.disabled_outputs`).
REFERENCES = ("file", "href", "imgFile", "decals", "fontFile")
_SHORT = {"n": "net-file", "net": "net-file", "r": "route-files", "routes": "route-files"}
_SHORT |= {"a": "additional-files", "additional": "additional-files"}
_SHORT |= {"w": "weight-files", "weights": "weight-files"}
MISSING = "no such file in the archive"


def config_of(files: list[Path]) -> Path:
    """The one .sumocfg. Raises BadInput: none, or several."""
    found = [file for file in files if file.suffix == ".sumocfg"]
    if len(found) != 1:
        raise BadInput(f"one .sumocfg is needed, there are {len(found)}", field="archive")
    return found[0]


def weights_of(files: list[Path]) -> Path:
    """The weights. Raises BadInput unless the files are one weights file and its card."""
    found = [file for file in files if file.suffix == ".safetensors"]
    if len(found) != 1 or files != sorted([found[0], found[0].with_suffix(".json")]):
        raise BadInput("one NAME.safetensors and its card NAME.json are needed, no more", field="archive")
    return found[0]


def check_references(files: list[Path], folder: Path) -> None:
    """Raises BadInput: a reference to a missing file or out of the folder; an entity, malformed XML."""
    for file in files:
        config = file.suffix == ".sumocfg"

        def start(tag: str, attributes: dict[str, str], line: int) -> None:
            if config:  # noqa: B023 - scanned within this iteration
                name = _SHORT.get(tag, tag)
                value = attributes.get("value", attributes.get("v", ""))
                if name in INPUTS or name in FILE_OPTIONS:
                    for part in filter(None, map(str.strip, value.split(","))):
                        parts = [part] if _inside(part, file, folder) else part.split()  # noqa: B023
                        for one in parts:
                            _check(one, file, folder, name)  # noqa: B023
                return
            for name in REFERENCES:
                if attributes.get(name) and OUTPUTS.get(tag) != name:
                    _check(attributes[name], file, folder, f"{tag}.{name} (line {line})")  # noqa: B023

        scan(file, (), start)


def _check(value: str, file: Path, folder: Path, field: str) -> None:
    if not _inside(value, file, folder):
        raise BadInput(MISSING, file=file, field=field, value=value)


def _inside(value: str, file: Path, folder: Path) -> bool:
    """Whether `value` names a file of the archive, which contains no links."""
    if "\0" in value or "${" in value or urlsplit(value).scheme:
        return False
    path = (file.parent / value).resolve()
    return path.is_relative_to(folder.resolve()) and path.is_file()
