"""The configuration file of a training: a shipped one, a user's own, or changes to another one."""

import importlib.resources
from pathlib import Path
from typing import NamedTuple

import policy
from cosim.errors import BadInput, hint
from cosim.files.yaml_input import dataclass_from, document
from policy.training.config import TrainingFile


class Configuration(NamedTuple):
    """A complete configuration, merged from its files."""

    values: object  # YAML data
    file: TrainingFile


def configuration(name: str, beside: Path = Path(), above: tuple[Path, ...] = ()) -> Configuration:
    """A shipped configuration by name, or a file (relative to the folder `beside`).

    `base: NAME` in a file names a configuration to override; `above`: the files that name this one as their
    base.

    Raises BadInput naming file, field and value.
    """
    shipped = Path(str(importlib.resources.files(policy) / "configs"))
    path = shipped / f"{name}.yaml"
    path = path if path.is_file() else beside / name
    if not path.exists():
        problem = "no such file, and no shipped configuration of this name"
        problem += hint(name, sorted(file.stem for file in shipped.glob("*.yaml")))
        where = {"file": above[-1], "field": "base"} if above else {"field": "--config"}
        raise BadInput(problem, **where, value=name)
    if path in above:
        raise BadInput("is its own base", file=above[-1], field="base", value=name)
    values: object = document(path)
    if isinstance(values, dict) and "base" in values:
        base = values.pop("base")
        if not isinstance(base, str):
            raise BadInput("the name of a configuration is needed", file=path, field="base", value=base)
        values = _over(configuration(base, path.parent, (*above, path)).values, values)
    return Configuration(values, dataclass_from(TrainingFile, values, path))


def _over(base: object, values: object) -> object:
    """`base` overridden by `values`, section by section; an empty section changes nothing."""
    if values is None:
        return base
    if not isinstance(base, dict) or not isinstance(values, dict):
        return values
    return {**base, **{name: _over(base.get(name), value) for name, value in values.items()}}
