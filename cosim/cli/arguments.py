"""Types of command-line values that several verbs share: argparse says what is wrong and exits with 2."""

from __future__ import annotations

import argparse
import math
from typing import Any

Verbs = Any  # what ArgumentParser.add_subparsers returns: argparse keeps its type private

POLICY = (
    "who commands the AVs (default idm): a name; RUN or FILE.safetensors of cosim train; FILE.py:NAME or "
    "MODULE:NAME, your own (docs/own_policy.md). LABEL= before a file says what tables call it"
)


def degrees(text: str) -> float:
    """An angle from 0 to 90 degrees."""
    return _number(text, 0.0, 90.0, "an angle from 0 to 90 degrees")


def share(text: str) -> float:
    """A share from 0 to 1."""
    return _number(text, 0.0, 1.0, "a share from 0 to 1")


def positive(text: str) -> float:
    """A positive number of seconds."""
    return _number(text, 0.1, 1e6, "a number of seconds from 0.1 to 1,000,000")


def count(text: str) -> int:
    """A whole number of 1 or more."""
    return _whole(text, 1, "a whole number from 1 to 2^62")


def seed(text: str) -> int:
    """A whole number of 0 or more."""
    return _whole(text, 0, "a whole number from 0 to 2^62")


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
