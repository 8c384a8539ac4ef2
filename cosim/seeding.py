"""One root seed, named sub-seeds: every random draw can be traced to (root seed, purpose)."""

from __future__ import annotations

import hashlib

import numpy as np


def subseed(seed: int, *purpose: str) -> int:
    """A 63-bit seed for one purpose; draws for other purposes or vehicles never shift it."""
    text = "\x1f".join((str(seed), *purpose)).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1


def uniform(seed: int, *purpose: str) -> float:
    """One number in [0, 1) for one purpose."""
    return subseed(seed, *purpose) / 2.0**63


def generator(seed: int, *purpose: str) -> np.random.Generator:
    """A numpy generator for one purpose."""
    return np.random.default_rng(subseed(seed, *purpose))
