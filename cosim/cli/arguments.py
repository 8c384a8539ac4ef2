"""Flags and types of values that several commands share: argparse says what is wrong and exits with 2."""

import argparse
import functools
import math
from collections.abc import Mapping
from typing import Any

SubCommands = Any  # what ArgumentParser.add_subparsers returns: argparse keeps its type private

POLICY = (
    "who commands the AVs (default idm): a name; RUN or FILE.safetensors of cosim train; FILE.py:NAME or "
    "MODULE:NAME, your own (docs/guides/extending.md). LABEL= before a file says what tables call it"
)


def add(parser: Any, *flags: str, **changed: Any) -> None:
    """Add these shared flags to a parser or a group of one.

    `changed`: settings of `add_argument` that replace the shared ones, for all of `flags`.
    """
    for flag in flags:
        parser.add_argument(flag, **(_shared()[flag] | changed))


def texts(parser: Any, flags: Mapping[str, tuple[str, str]], **settings: Any) -> None:
    """Add flags that take a text: flag -> its metavar and help. `settings`: further ones for all of them."""
    for flag, (metavar, meaning) in flags.items():
        parser.add_argument(flag, metavar=metavar, help=meaning, **settings)


@functools.cache
def _shared() -> dict[str, dict[str, Any]]:
    """Flag -> its settings. Made on demand: the names of behaviours are read from a file."""
    from cosim.scenario import BEHAVIORS
    from cosim.scenario.behaviors import DRIVER_MODELS
    from cosim.types import OnCollision, Preset, Traffic

    return {
        "--scenario": {"metavar": "NAME|FILE", "help": "a world, its folder, or a .sumocfg"},
        "--demand": {"metavar": "NAME|FILE", "help": "a name, or a route file"},
        "--policy": {"metavar": "POLICY", "help": POLICY},
        "--behavior": {
            "choices": BEHAVIORS,
            "help": "Table II class of the human drivers "
            "(default: mixed; contested: moderate; your files: as-is)",
        },
        "--driver-model": {"choices": DRIVER_MODELS, "help": "of the human drivers"},
        "--penetration": {"type": share, "metavar": "P", "help": "this share of vehicles are AVs, 0..1"},
        "--av-type": {"metavar": "T", "help": "AVs are the vehicles of this vType"},
        "--av-ids": {"metavar": "REGEX", "help": "AVs are the vehicles whose id matches"},
        "--svo": {"type": degrees, "metavar": "DEG", "help": "SVO angle, 0..90 (default 45)"},
        "--preset": {"choices": Preset.ALL, "help": "safety checks on the AVs (default: the scenario's)"},
        "--on-collision": {
            "choices": OnCollision.ALL,
            "help": "of an AV or the mission vehicle (default: worlds end, your own .sumocfg continue)",
        },
        "--traffic": {
            "choices": Traffic.ALL,
            "help": "SUMO options of your own .sumocfg: as-is, or controlled, as AVs need them "
            "(default: as-is where cosim drives nobody; in a batch, in any cell)",
        },
        "--errors": {
            "metavar": "LEVEL|FILE",
            "help": "of human drivers: none (default), field, stress, or a YAML file "
            "(docs/explanation/driver_errors.md)",
        },
        "--seed": {"type": seed, "metavar": "N"},
        "--seeds": {"metavar": "A:B", "help": "seeds A, A+1, ... B-1"},
        "--duration": {
            "type": positive,
            "metavar": "S",
            "help": "counted s per episode (default: the scenario's)",
        },
        "--warmup": {
            "type": seconds,
            "metavar": "S",
            "help": "s driven before the counted time begins (default: the scenario's; your files: 0)",
        },
        "--mission": {
            "metavar": "ID|none|auto",
            "help": "the mission vehicle: its id, a pattern of ids, none, or auto: guessed, and out of gates "
            "(default: the scenario's; your files: auto)",
        },
        "--output": {
            "metavar": "NAME",
            "help": "have SUMO write its NAME output (tripinfo, fcd, ...)",
        },
        "--metric": {
            "metavar": "FILE:NAME",
            "help": "measure this besides (FILE.py:NAME, MODULE:NAME); repeatable",
        },
        "--reward": {
            "metavar": "NAME|FILE:NAME",
            "help": "report what AVs earn by it: p, t, or your own",
        },
        "--workers": {"type": count, "metavar": "N", "help": "processes"},
        "--out": {"metavar": "DIR", "help": "folder to write into"},
        "--resume": {"action": "store_true", "help": "go on with what the folder --out holds"},
        "--json": {"action": "store_true", "help": "print exactly one JSON document on stdout"},
    }


def degrees(text: str) -> float:
    """An angle from 0 to 90 degrees."""
    return _number(text, 0.0, 90.0, "an angle from 0 to 90 degrees")


def share(text: str) -> float:
    """A share from 0 to 1."""
    return _number(text, 0.0, 1.0, "a share from 0 to 1")


def positive(text: str) -> float:
    """A positive number of seconds."""
    return _number(text, 0.1, 1e6, "a number of seconds from 0.1 to 1,000,000")


def seconds(text: str) -> float:
    """A number of seconds, 0 too."""
    return _number(text, 0.0, 1e6, "a number of seconds from 0 to 1,000,000")


def count(text: str) -> int:
    """A whole number of 1 or more."""
    return _whole(text, 1, "a whole number from 1 to 2^62")


def port(text: str) -> int:
    """A number of a TCP port."""
    _number(text, 1, 65535, "a port from 1 to 65535")
    return _whole(text, 1, "a port from 1 to 65535")


def seed(text: str) -> int:
    """A whole number of 0 or more."""
    return _whole(text, 0, "a whole number from 0 to 2^62")


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


def _whole(text: str, low: int, what: str) -> int:
    if _number(text, low, 2**62, what) != int(float(text)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    try:
        return int(text)
    except ValueError:  # 1e3, 5.0
        return int(float(text))


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value
