"""Pixels of many files, read on demand and cached."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

#: Largest cache of a `Pixels` [bytes]. Other files are read each time.
KEPT = 2**28

Reader = Callable[[], np.ndarray]


class Pixels(Sequence):
    """A sequence of arrays. Each is read by its reader when it is used; None where there is no reader.

    Equal readers share one array. Parts of a sequence share the cache, which keeps the arrays read first: a fit draws
    photographs at random, so no other rule is better.
    """

    def __init__(self, readers: Iterable[Reader | None] = (), kept: dict[Reader, np.ndarray] | None = None) -> None:
        """Take a reader for each array. `kept`: the cache of arrays by their readers; default: an empty one."""
        self.readers = tuple(readers)
        self.kept: dict[Reader, np.ndarray] = {} if kept is None else kept

    @classmethod
    def of(cls, arrays: Iterable[np.ndarray | None]) -> "Pixels":
        """Make a sequence from arrays in memory."""
        return cls(None if array is None else partial(np.asarray, array) for array in arrays)

    def __len__(self) -> int:
        return len(self.readers)

    def __getitem__(self, k):  # type: ignore[no-untyped-def]  # int or slice, as lists have it
        if isinstance(k, slice):
            return self.part(range(len(self))[k])
        reader = self.readers[k]
        if reader is None or reader in self.kept:
            return None if reader is None else self.kept[reader]
        array = reader()
        if sum(other.nbytes for other in self.kept.values()) + array.nbytes <= KEPT:
            self.kept[reader] = array
        return array

    @property
    def given(self) -> list[bool]:
        """For each index: is there a reader?"""
        return [reader is not None for reader in self.readers]

    def part(self, index: Iterable[int]) -> "Pixels":
        """Return the subsequence with these indices."""
        return Pixels([self.readers[k] for k in index], self.kept)

    def replaced(self, readers: Mapping[int, Reader | None]) -> "Pixels":
        """Return a copy of the sequence with other readers at the indices in `readers`."""
        several = [readers.get(k, reader) for k, reader in enumerate(self.readers)]
        left = {*several}
        return Pixels(several, {reader: array for reader, array in self.kept.items() if reader in left})
