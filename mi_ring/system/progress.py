"""How far something is."""

import shutil
from collections.abc import Callable, Iterable

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: what `progress` is; another shows nothing


def progress(things: Iterable | None, what: str, total: int | None = None) -> tqdm:
    """Iterates over things and shows how far it is, while it is at work, in a terminal."""
    columns, rows = shutil.get_terminal_size()  # 80 x 24 where a terminal says 0 x 0: tqdm would show nothing
    return tqdm(things, what, total, leave=False, disable=None, ncols=columns, nrows=rows)
