"""One root seed, named sub-seeds: every random draw can be traced to (root seed, purpose)."""

import hashlib

import numpy as np

# What a result may rest on (docs/definitions.md, Seeds); tests begin where tuning and validation end, and a
# result on a test seed never changes a parameter.
TRAINING_SEEDS = range(100_000)
TUNING_SEEDS = range(100_000, 200_000)
FIRST_TEST_SEED = TUNING_SEEDS.stop


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
