"""Policy names: a shipped policy, weights of a training, or user code.

`[LABEL=]RUN` and `[LABEL=]FILE.safetensors` are weights of `cosim train`. `[LABEL=]FILE.py:NAME` and
`[LABEL=]MODULE:NAME` are code. Anything else is a shipped policy. The label is used in rows and tables.
This module only parses the text; `cosim.policies` checks that the policy exists.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

from cosim.errors import BadInput
from cosim.files.code import Code, is_code
from cosim.files.code import read as read_code

WEIGHTS, BEST = ".safetensors", "best.safetensors"  # a training's folder means its best weights
_LABEL = re.compile(r"[\w.+-]+")


class PolicyName(NamedTuple):
    """A requested policy; `place` is absolute if it is a file."""

    label: str
    place: str = ""  # a file of weights, a file of code or a module; "": a shipped policy
    member: str = ""  # of code: the class, factory or function

    @property
    def ships(self) -> bool:
        return not self.place

    @property
    def code(self) -> Code:
        """The location of the code."""
        return Code(self.place, self.member)

    @property
    def text(self) -> str:
        """The text that `read` parses to the same policy in any working directory."""
        if self.ships:
            return self.label
        return f"{self.label}={self.place}" + (f":{self.member}" if self.member else "")


def read(text: str, folder: Path | None = None, field: str = "--policy", file: object = None) -> PolicyName:
    """Parse a policy name; files are relative to `folder` (default: working directory).

    A bare word is a shipped policy; a run's folder needs a slash or a label (`./mine`, `new=mine`). `file`,
    `field`: origin of the text, for errors.

    Raises:
        BadInput: an invalid label, a missing file, or code without a name in it.
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
    """The label, for rows and tables, of a policy name that was parsed before."""
    head, equals, _ = text.partition("=")
    return head if equals else text


def _plain(name: str) -> str:
    """A file's name as a label."""
    return re.sub(r"[^\w.+-]", "-", name)
