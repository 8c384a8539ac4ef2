"""The worlds that ship, as data: find a world's folder by its name (no simulator is touched here)."""

from pathlib import Path

from cosim.errors import BadInput, hint

ROOT = Path(__file__).resolve().parent
BEHAVIORS = ROOT / "behaviors.yaml"  # Table II and its IDM + LC2013 mapping
ERRORS = ROOT / "errors.yaml"  # the errors of human drivers, level by level
SENSING = ROOT / "sensing.yaml"  # what AVs measure of others, level by level
TILTS = ROOT / "tilts.yaml"  # how much more often `cosim estimate` draws them, world by world
TYPES = ROOT / "types.add.xml"  # the IDM + LC2013 type that vehicles of a user's file may get


def names() -> tuple[str, ...]:
    """Names of the worlds, sorted: every folder here that holds a `scenario.yaml`."""
    return tuple(sorted(p.parent.name for p in ROOT.glob("*/scenario.yaml")))


def practice() -> tuple[str, ...]:
    """Names of the roads that networks practise on beside the worlds, sorted: `practice/NAME`."""
    return tuple(sorted(f"practice/{p.parent.name}" for p in ROOT.glob("practice/*/scenario.yaml")))


def open_roads() -> tuple[str, ...]:
    """Names of the roads that vehicles enter and leave at a fixed demand, sorted: `open/NAME`."""
    return tuple(sorted(f"open/{p.parent.name}" for p in ROOT.glob("open/*/scenario.yaml")))


def shipped() -> tuple[str, ...]:
    """Names of all scenarios that ship."""
    return (*names(), *open_roads(), *practice())


def ships(name: str) -> bool:
    """Whether a scenario that ships is called so."""
    return name in shipped()


def folder(name: str) -> Path:
    """The folder of the scenario that ships as `name`.

    Raises:
        BadInput: there is no such scenario; the sentence names the nearest one there is.
    """
    if ships(name):
        return ROOT / name
    raise BadInput(f"no such scenario{hint(name, shipped())}", field="scenario", value=name)
