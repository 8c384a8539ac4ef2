"""How a policy is named: one that ships, the weights of a training, or a user's own code.

`[LABEL=]RUN` or `[LABEL=]FILE.safetensors` are weights of `cosim train`, `[LABEL=]FILE.py:NAME` and
`[LABEL=]MODULE:NAME` code; anything else is the name of a policy that ships. The label stands in rows and
tables. Text only: `cosim.policies` checks whether there is such a policy.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

from cosim.errors import BadInput
from cosim.files.code import Code, is_code
from cosim.files.code import read as read_code

WEIGHTS, BEST = ".safetensors", "best.safetensors"  # a training's folder stands for its best
_LABEL = re.compile(r"[\w.+-]+")


class PolicyName(NamedTuple):
    """A policy as it was asked for; `place` is absolute when it is a file."""

    label: str
    place: str = ""  # a file of weights, a file of code or a module; "": it ships
    member: str = ""  # of code: the class, factory or function

    @property
    def ships(self) -> bool:
        return not self.place

    @property
    def code(self) -> Code:
        """Of code: where it stands."""
        return Code(self.place, self.member)

    @property
    def text(self) -> str:
        """Reads back as the same, wherever one stands."""
        if self.ships:
            return self.label
        return f"{self.label}={self.place}" + (f":{self.member}" if self.member else "")


def read(text: str, folder: Path | None = None, field: str = "--policy", file: object = None) -> PolicyName:
    """The policy that `text` names; files are relative to `folder` (default: here).

    A bare word ships; a run's folder has a slash or a label (`./mine`, `new=mine`). `file`, `field`: where
    the text was written.

    Raises:
        BadInput: a label that cannot stand in a table, files that are not there, code without a name in it.
    """

    def wrong(problem: str) -> BadInput:
        return BadInput(problem, file=file, field=field, value=text)

    label, equals, rest = text.partition("=")
    if not equals or "/" in label:  # a path may hold an equals sign
        label, equals, rest = "", "", text
    elif not _LABEL.fullmatch(label):
        raise wrong("a label has letters, digits, dots, dashes, plus signs and underscores")
    if not equals and not any(mark in rest for mark in "/:") and not rest.endswith((WEIGHTS, ".py")):
        return PolicyName(rest)
    if is_code(rest):
        code = read_code(rest, field, folder=folder, file=file, value=text)
        return PolicyName(label or code.member, *code)
    path = Path(os.path.abspath((folder or Path()) / os.path.expanduser(rest)))
    if rest.endswith(WEIGHTS):
        name = path.parent.name if path.name == BEST else path.stem
        found = PolicyName(label or _plain(name), str(path))
    elif path.is_dir():
        path = path / BEST
        found = PolicyName(label or _plain(path.parent.name), str(path))
    elif not path.exists():
        raise wrong(f"no such file: {path}")
    else:
        raise wrong("neither a run of cosim train, nor FILE.safetensors, FILE.py:NAME or MODULE:NAME")
    if not path.is_file():
        raise wrong(f"no such file: {path}")
    return found


def label(text: str) -> str:
    """What stands in rows and tables for a policy whose name was read before."""
    head, equals, _ = text.partition("=")
    return head if equals else text


def _plain(name: str) -> str:
    """A file's name as a label."""
    return re.sub(r"[^\w.+-]", "-", name)
