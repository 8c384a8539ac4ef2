"""Flags and value types shared by several commands; argparse reports errors and exits with 2."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from cosim.errors import Range

if TYPE_CHECKING:
    from cosim.scenario.options import Option

SubCommands = Any  # what ArgumentParser.add_subparsers returns: argparse keeps its type private


def add(parser: Any, *flags: str, **changed: Any) -> None:
    """Add these shared flags to a parser or a group.

    `changed`: settings of `add_argument` that replace the shared ones, for all of `flags`.
    """
    for flag in flags:
        parser.add_argument(flag, **(_shared()[flag] | changed))


def options(parser: Any, *, matrix: bool = False, without: Collection[str] = (), **meanings: str) -> None:
    """Add the flags of `cosim.scenario.options`, except `without`; None if not given.

    `matrix`: whether the flags of axes may be repeated. `meanings`: replaced help texts by option name.
    """
    from cosim.scenario.options import OPTIONS

    for name, option in OPTIONS.items():
        if name not in without:
            repeated = {"action": "append"} if option.several or (matrix and option.axis) else {}
            meaning = meanings.get(name, option.help)
            parser.add_argument(option.flag, **_settings(option) | repeated | {"help": meaning})


def texts(parser: Any, flags: Mapping[str, tuple[str, str]], **settings: Any) -> None:
    """Add flags with a text: flag -> its metavar and help. `settings`: shared settings."""
    for flag, (metavar, meaning) in flags.items():
        parser.add_argument(flag, metavar=metavar, help=meaning, **settings)


@functools.cache
def _shared() -> dict[str, dict[str, Any]]:
    """Flag -> its settings. Built on demand, because the names of behaviours are read from a file."""
    from cosim.scenario.options import OPTIONS

    return {option.flag: _settings(option) for option in OPTIONS.values()} | {
        "--seed": {"type": seed, "metavar": "N"},
        "--seeds": {"metavar": "A:B", "help": "seeds A, A+1, ... B-1"},
        "--workers": {"type": count, "metavar": "N", "help": "processes"},
        "--out": {"metavar": "DIR", "help": "folder to write into"},
        "--resume": {"action": "store_true", "help": "go on with what the folder --out holds"},
        "--json": {"action": "store_true", "help": "print exactly one JSON document on stdout"},
    }


def _settings(option: Option) -> dict[str, Any]:
    """The arguments of `add_argument` for an option."""
    typed = {} if option.range is None else {"type": functools.partial(_number, option.range)}
    shown = {"choices": option.choices} if option.choices else {"metavar": option.metavar}
    return {"help": option.help} | shown | typed


def positive(text: str) -> float:
    """A positive number of seconds."""
    return _number(Range(0.1, high=1e6), text)


def count(text: str) -> int:
    """A whole number of 1 or more."""
    return _whole(text, 1)


def port(text: str) -> int:
    """A number of a TCP port."""
    return _whole(text, 1, 65535)


def seed(text: str) -> int:
    """A whole number of 0 or more."""
    return _whole(text, 0)


def seeds(text: str) -> range:
    """`a:b`, b not included; a single number is that one seed."""
    low, colon, high = text.partition(":")
    try:
        found = range(int(low), int(high) if colon else int(low) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no range of seeds A:B") from None
    if found.start < 0 or not found:
        raise argparse.ArgumentTypeError(f"{text!r} holds no seed (A:B with 0 <= A < B)")
    return found


def _whole(text: str, low: int, high: int = 2**62) -> int:
    value = _number(Range(low, high=high), text)
    if value != int(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text) if text.isdecimal() else int(value)  # 1e3, 5.0


def _number(bounds: Range, text: str) -> float:
    try:
        problem = bounds.problem(value := float(text))
    except ValueError:
        problem = "is not a number"
    if problem is not None:
        raise argparse.ArgumentTypeError(f"{text!r} {problem}")
    return value
