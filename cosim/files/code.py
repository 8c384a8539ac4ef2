"""User code named FILE.py:NAME or MODULE:NAME: loading, calling, and attribution of its errors."""

import hashlib
import importlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from cosim.errors import BadInput, CosimError, hint

_MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


class Code(NamedTuple):
    """The location of a class, factory or function."""

    place: str  # a file's absolute path, or a module's name
    member: str

    @property
    def text(self) -> str:
        """The text that `read` parses to the same code in any working directory."""
        return f"{self.place}:{self.member}"

    def load(self, field: str) -> Any:
        """The class, factory or function itself, not guarded.

        Raises BadInput: the module cannot be imported, or has no callable of that name.
        """
        module = guarded(self.place, "import", _imported, self.place)
        found = getattr(module, self.member, None)
        if not callable(found):
            known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
            problem = f"no class or function of this name{hint(self.member, known)}"
            raise BadInput(problem, file=self.place, field=field, value=self.member)
        return found

    def make(self, field: str, *arguments: Any) -> Any:
        """The object that the class or factory makes from `arguments`, `Guarded`.

        A function without `arguments` is not called. Raises BadInput as `load`.
        """
        found = self.load(field)
        place = self.file() or self.place
        if arguments or isinstance(found, type):
            found = guarded(place, self.member, found, *arguments)
        return Guarded(found, place)

    def file(self) -> Path | None:
        """The source file; for a module, None before it is loaded."""
        if self.place.endswith(".py"):
            return Path(self.place)
        file = getattr(sys.modules.get(self.place), "__file__", None)
        return Path(file) if file else None


class Guarded:
    """A user's object; an exception of its methods becomes a BadInput with file and line."""

    def __init__(self, inner: Any, place: object) -> None:
        self._inner, self._place = inner, place

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        value = guarded(self._place, name, getattr, self._inner, name)
        return partial(guarded, self._place, name, value) if callable(value) else value

    def __call__(self, *arguments: Any) -> Any:
        name = getattr(self._inner, "__name__", type(self._inner).__name__)
        return guarded(self._place, name, self._inner, *arguments)


def is_code(text: str) -> bool:
    """Whether `text` names user code rather than a built-in entry."""
    return ":" in text or text.endswith(".py")


def read(
    text: str, field: str, *, folder: Path | None = None, file: object = None, value: str | None = None
) -> Code:
    """Parse FILE.py:NAME or MODULE:NAME; a file is relative to `folder` (default: working directory).

    `file`, `field`, `value`: origin of the text, for errors.

    Raises:
        BadInput: a missing file, a missing name, or a malformed text.
    """

    def wrong(problem: str) -> BadInput:
        return BadInput(problem, file=file, field=field, value=value or text)

    place, colon, member = text.rpartition(":") if ":" in text else (text, "", "")
    if not colon:
        raise wrong(f"name the class or function in it: {text}:NAME")
    if not place.endswith(".py") and not _MODULE.fullmatch(place):
        raise wrong("FILE.py:NAME or MODULE:NAME is needed")
    if not member.isidentifier():
        raise wrong("the name of a class, factory or function is needed after the colon")
    if place.endswith(".py"):
        place = os.path.abspath((folder or Path()) / os.path.expanduser(place))
        if not os.path.isfile(place):
            raise wrong(f"no such file: {place}")
    return Code(place, member)


def absolute(text: str, folder: Path, field: str, file: object = None) -> str:
    """User code by its absolute path; a built-in entry unchanged. Raises as `read`."""
    return read(text, field, folder=folder, file=file).text if is_code(text) else text


def files_of(texts: Iterable[object]) -> list[Path]:
    """The source files of the texts that name loaded code."""
    named = [read(text, "").file() for text in texts if isinstance(text, str) and is_code(text)]
    return [file for file in named if file is not None]


def place_of(thing: object) -> object:
    """The file or module of a user's object; None for built-in objects."""
    return vars(thing)["_place"] if isinstance(thing, Guarded) else None


def guarded(place: object, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
    """`call(*arguments)`, where `call` is user code in `place`.

    Raises BadInput for any exception, in one line, with the deepest line number in the user's file.
    """
    try:
        return call(*arguments)
    except CosimError:
        raise
    except (Exception, SystemExit) as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(place)]
        where = f"{place}:{lines[-1]}" if lines else place
        raise BadInput(f"{type(error).__name__}: {error}", file=where, field=what) from error


def _imported(place: str) -> ModuleType:
    """Import a module or file; a file once per process, with its folder on the path like a script's."""
    if not place.endswith(".py"):
        return importlib.import_module(place)
    path = Path(place)
    known = f"cosim_own_{path.stem}_{hashlib.sha256(place.encode()).hexdigest()[:8]}"
    if known in sys.modules:
        return sys.modules[known]
    spec = importlib.util.spec_from_file_location(known, path)
    assert spec is not None and spec.loader is not None  # noqa: PT018
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    sys.modules[known] = module  # dataclasses and pickle look there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[known]
        raise
    return module
