"""Pixels of many files. They are read when they are used, and cached."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

#: Largest cache of a `Pixels` [bytes]. Other files are read each time.
KEPT = 2**27

Reader = Callable[[], np.ndarray]


class Pixels(Sequence):
    """A sequence of arrays. An array is read when it is used, and then cached.

    Each item has a reader, a function without arguments that returns the array. An item without an array is None, and
    so is its reader. Items with equal readers share one array. The cache keeps the arrays that were read first, up to
    `KEPT` bytes; a fit draws photographs at random, so no other rule is better. Slices of a sequence share its cache.
    """

    def __init__(self, readers: Iterable[Reader | None] = (), kept: dict[Reader, np.ndarray] | None = None) -> None:
        """Make a sequence with one reader for each item. `kept`: its cache, from readers to arrays; default: empty."""
        self.readers = tuple(readers)
        self.kept: dict[Reader, np.ndarray] = {} if kept is None else kept

    @classmethod
    def of(cls, arrays: Iterable[np.ndarray | None]) -> "Pixels":
        """Make a sequence of `arrays` that are in memory. They are not copied. An item may be None."""
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

    def clear(self) -> None:
        """Remove all arrays from the cache. They are read again when they are used."""
        self.kept.clear()

    @property
    def given(self) -> list[bool]:
        """One bool for each item: True if there is an array, False if the item is None. Nothing is read."""
        return [reader is not None for reader in self.readers]

    def part(self, index: Iterable[int]) -> "Pixels":
        """Return a sequence of the items with the indices `index`, in this order. It shares the cache."""
        return Pixels([self.readers[k] for k in index], self.kept)

    def replaced(self, readers: Mapping[int, Reader | None]) -> "Pixels":
        """Return a copy of the sequence in which some items have other readers. All other items are unchanged.

        `readers`: a dict from the index of an item to its new reader, a function that returns the array. With None
        instead of a reader, the item has no array.
        """
        several = [readers.get(k, reader) for k, reader in enumerate(self.readers)]
        left = {*several}
        return Pixels(several, {reader: array for reader, array in self.kept.items() if reader in left})
