"""The shipped scenarios: names and folders, without a simulator."""

from pathlib import Path

from cosim.errors import BadInput, hint

ROOT = Path(__file__).resolve().parent
BEHAVIORS = ROOT / "behaviors.yaml"  # Table II and its IDM + LC2013 mapping
ERRORS = ROOT / "errors.yaml"  # human driver errors by level
SENSING = ROOT / "sensing.yaml"  # sensing parameters of AVs by level
TILTS = ROOT / "tilts.yaml"  # tilts of these errors in `cosim estimate`, by scenario
TYPES = ROOT / "types.add.xml"  # the IDM + LC2013 vType for vehicles of a user's file


def names() -> tuple[str, ...]:
    """Names of the scenarios, sorted: every folder here with a `scenario.yaml`."""
    return tuple(sorted(p.parent.name for p in ROOT.glob("*/scenario.yaml")))


def practice() -> tuple[str, ...]:
    """Names of the additional training roads, sorted: `practice/NAME`."""
    return tuple(sorted(f"practice/{p.parent.name}" for p in ROOT.glob("practice/*/scenario.yaml")))


def open_roads() -> tuple[str, ...]:
    """Names of the open roads, with a fixed demand of entering vehicles, sorted: `open/NAME`."""
    return tuple(sorted(f"open/{p.parent.name}" for p in ROOT.glob("open/*/scenario.yaml")))


def shipped() -> tuple[str, ...]:
    """Names of all shipped scenarios."""
    return (*names(), *open_roads(), *practice())


def ships(name: str) -> bool:
    """Whether a shipped scenario has this name."""
    return name in shipped()


def folder(name: str) -> Path:
    """The folder of the shipped scenario `name`.

    Raises:
        BadInput: no such scenario; the message names the nearest known one.
    """
    if ships(name):
        return ROOT / name
    raise BadInput(f"no such scenario{hint(name, shipped())}", field="scenario", value=name)
