"""Which file of an upload is the one meant, and whether its files refer to one another only: checked before
anybody follows a name."""

from pathlib import Path
from urllib.parse import urlsplit

from cosim.errors import BadInput
from cosim.files.xml_input import scan
from cosim.scenario.sumocfg import FILE_OPTIONS, INPUTS
from cosim.scenario.vet_demand import OUTPUTS

# Attributes by which SUMO's files name others. Where an element writes, its file is never opened
# (`cosim.scenario.disabled_outputs`), and the process may write nowhere.
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
    """The weights, their card beside them. Raises BadInput."""
    found = [file for file in files if file.suffix == ".safetensors"]
    if len(found) != 1 or files != sorted([found[0], found[0].with_suffix(".json")]):
        raise BadInput("one NAME.safetensors and its card NAME.json are needed, no more", field="archive")
    return found[0]


def check_references(files: list[Path], folder: Path) -> None:
    """Raises BadInput: a named file lies elsewhere or is not there; an entity, malformed XML."""
    for file in files:
        config = file.suffix == ".sumocfg"

        def start(tag: str, attributes: dict[str, str], line: int) -> None:
            if config:  # noqa: B023 - scanned within this turn
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
    """Whether the file that `value` names is one of the archive's; links there are none."""
    if "\0" in value or "${" in value or urlsplit(value).scheme:
        return False
    path = (file.parent / value).resolve()
    return path.is_relative_to(folder.resolve()) and path.is_file()
