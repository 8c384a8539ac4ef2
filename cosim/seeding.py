"""One root seed, named sub-seeds: every random draw can be traced to (root seed, purpose)."""

import hashlib

import numpy as np
import numpy.typing as npt

# What a result may rest on (figures.md, Reproducibility). Seeds from FIRST_EXAMPLE_SEED on are examples and
# tests of earlier versions, those from 300,000 on tests (research/schema.py): no parameter rests on them.
TRAINING_SEEDS = range(100_000)
TUNING_SEEDS = range(100_000, 200_000)
FIRST_EXAMPLE_SEED = TUNING_SEEDS.stop


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


def uniforms(streams: npt.NDArray[np.uint64], number: int) -> npt.NDArray[np.float64]:
    """The `number`-th draw in [0, 1) of each stream (a `subseed`), of any shape.

    splitmix64: Steele, Lea and Flood, Fast splittable pseudorandom number generators, OOPSLA 2014.
    """
    with np.errstate(over="ignore"):
        z = streams + np.uint64(0x9E3779B97F4A7C15) * np.uint64(number + 1)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return np.asarray((z >> np.uint64(11)) * 2.0**-53, np.float64)
