"""A user's own code, named FILE.py:NAME or MODULE:NAME: loaded, called, its mistakes named as its own."""

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
    """Where a class, factory or function stands."""

    place: str  # a file's absolute path, or a module's name
    member: str

    @property
    def text(self) -> str:
        """Reads back as the same, wherever one stands."""
        return f"{self.place}:{self.member}"

    def load(self, field: str) -> Any:
        """The class, factory or function; calling it raises what `guarded` does.

        Raises BadInput: it cannot be imported, or has nothing of that name that can be called.
        """
        module = guarded(self.place, "import", _imported, self.place)
        found = getattr(module, self.member, None)
        if not callable(found):
            known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
            problem = f"nothing to call of this name{hint(self.member, known)}"
            raise BadInput(problem, file=self.place, field=field, value=self.member)
        return found

    def make(self, field: str, *arguments: Any) -> Any:
        """What the class or factory makes of `arguments`, or, without any, the function itself; `Guarded`.

        Raises BadInput as `load`.
        """
        found = self.load(field)
        place = self.file() or self.place
        if arguments or isinstance(found, type):
            found = guarded(place, self.member, found, *arguments)
        return Guarded(found, place)

    def file(self) -> Path | None:
        """The file it is in, once it was loaded."""
        if self.place.endswith(".py"):
            return Path(self.place)
        file = getattr(sys.modules.get(self.place), "__file__", None)
        return Path(file) if file else None


class Guarded:
    """An object of the user's: what its methods raise becomes a BadInput with the file and line."""

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
    """Whether `text` names code rather than an entry of a table."""
    return ":" in text or text.endswith(".py")


def read(
    text: str, field: str, *, folder: Path | None = None, file: object = None, value: str | None = None
) -> Code:
    """The code that FILE.py:NAME or MODULE:NAME names; a file is relative to `folder` (default: here).

    `file`, `field`, `value`: where and as what the text was written.

    Raises:
        BadInput: a file that is not there, no name behind it, a colon that belongs to neither.
    """

    def wrong(problem: str) -> BadInput:
        return BadInput(problem, file=file, field=field, value=value or text)

    place, colon, member = text.rpartition(":") if ":" in text else (text, "", "")
    if not colon:
        raise wrong(f"name the class or function in it: {text}:NAME")
    if not place.endswith(".py") and not _MODULE.fullmatch(place):
        raise wrong("a colon belongs to FILE.py:NAME and MODULE:NAME")
    if not member.isidentifier():
        raise wrong("behind the colon stands a class, a factory or a function")
    if place.endswith(".py"):
        place = os.path.abspath((folder or Path()) / os.path.expanduser(place))
        if not os.path.isfile(place):
            raise wrong(f"no such file: {place}")
    return Code(place, member)


def absolute(text: str, folder: Path, field: str, file: object = None) -> str:
    """Code by its absolute path, found from anywhere; an entry of a table as it is. Raises as `read`."""
    return read(text, field, folder=folder, file=file).text if is_code(text) else text


def files_of(texts: Iterable[object]) -> list[Path]:
    """The files of those that name code, once it is loaded."""
    named = [read(text, "").file() for text in texts if isinstance(text, str) and is_code(text)]
    return [file for file in named if file is not None]


def place_of(thing: object) -> object:
    """The file or module that a user's object is from; None for ours."""
    return vars(thing)["_place"] if isinstance(thing, Guarded) else None


def guarded(place: object, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
    """`call(*arguments)`, code of the user's in `place`.

    Raises BadInput for what it raises, in one line: of a file of his with the deepest line that is in it.
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
    """A file is imported once a process, with its folder on the path, as if it were run."""
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
