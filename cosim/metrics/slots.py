"""Tables of vehicles over time: a persistent number for each, and growing arrays."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.types import Ints


class Slots:
    """Assigns every vehicle of an episode a persistent number, in order of appearance (until `keep`)."""

    def __init__(self) -> None:
        self.of: dict[str, int] = {}
        self._ids: tuple[str, ...] = ()
        self._rows: Ints = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.of)

    def rows(self, ids: Sequence[str]) -> Ints:
        """[n] the numbers of these vehicles; new ones get the next free numbers."""
        names = tuple(ids)
        if names != self._ids:
            found = list(map(self.of.get, names))
            if None in found:
                found = [self.of.setdefault(name, len(self.of)) for name in names]
            self._rows = np.array(found, dtype=np.int64)
            self._ids = names
        return self._rows

    def keep(self, numbers: Ints) -> None:
        """Keep only these numbers, which become 0, 1, 2, ... in this order."""
        new = {int(old): k for k, old in enumerate(numbers)}
        self.of = {name: new[old] for name, old in self.of.items() if old in new}
        self._ids, self._rows = (), np.zeros(0, dtype=np.int64)


def grown(table: npt.NDArray[Any], needed: int, fill: float, axis: int = 0) -> npt.NDArray[Any]:
    """The table itself while `needed` entries fit along `axis`, else a copy for twice as many."""
    if table.shape[axis] >= needed:
        return table
    added = [(0, 0)] * table.ndim
    added[axis] = (0, 2 * needed - table.shape[axis])
    return np.pad(table, added, constant_values=fill)
