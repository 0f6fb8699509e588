"""Pixels of many files: read when they are asked for, and kept as long as there is room."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

#: Bytes of decoded files that one `Pixels` keeps. What does not fit is read again each time.
KEPT = 2**28

Reader = Callable[[], np.ndarray]


class Pixels(Sequence):
    """Arrays by index, each as its reader gives it; None where there is no reader.

    The same reader at several places gives one array to all of them. Its parts share what has been read so far. What
    was read first is kept: a fit draws photographs at random, so that no other order is better.
    """

    def __init__(self, readers: Iterable[Reader | None] = (), kept: dict[Reader, np.ndarray] | None = None) -> None:
        """`kept`: what has been read by these readers so far."""
        self.readers = tuple(readers)
        self.kept: dict[Reader, np.ndarray] = {} if kept is None else kept

    @classmethod
    def of(cls, arrays: Iterable[np.ndarray | None]) -> "Pixels":
        """These arrays, which are in memory."""
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
        """Which indices have an array; nothing is read."""
        return [reader is not None for reader in self.readers]

    def part(self, index: Iterable[int]) -> "Pixels":
        """The arrays of these indices."""
        return Pixels([self.readers[k] for k in index], self.kept)

    def replaced(self, readers: Mapping[int, Reader | None]) -> "Pixels":
        """The same with other readers at some indices."""
        several = [readers.get(k, reader) for k, reader in enumerate(self.readers)]
        left = {*several}
        return Pixels(several, {reader: array for reader, array in self.kept.items() if reader in left})
