"""Damaged files of all kinds that are read: a few of each, always the same; `fuzz/run.py` has no end."""

import sys
from pathlib import Path

import pytest
from conftest import missing_package
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from mi_ring.errors import InputError
from mi_ring.importers.formats import FORMATS

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))
from damage import damaged
from readers import READERS, beyond

#: Examples of those that take long.
SLOW = {"colmap-binary": 1, "diligent-mv": 2, "ring.pt": 5, "checkpoint.pt": 5, "scene": 8}
CHECKS = settings(max_examples=15, derandomize=True, database=None, deadline=None, phases=[Phase.generate],
                  suppress_health_check=[*HealthCheck])  # fmt: skip


@pytest.mark.filterwarnings("ignore")  # of what is damaged
def test_what_is_damaged_is_read_or_refused(tmp_path):
    """Whole files are read. Whatever is wrong, there is no other error than InputError, of one line and foreseen."""
    assert all(any(name.startswith(form) for name in READERS) for form in FORMATS)
    for name, reader_of in READERS.items():
        (tmp_path / name).mkdir()
        try:
            reader = reader_of(tmp_path / name)
            if name != "merl-table":  # of which a whole one has 35 MB
                reader.read()
        except (InputError, ModuleNotFoundError) as error:
            assert missing_package(error), name
            continue
        check(name, reader)


def check(name, reader):
    """Some damaged files of a reader."""
    whole = [file.read_bytes() for file in reader.files]

    @settings(CHECKS, max_examples=SLOW.get(name, CHECKS.max_examples))
    @given(st.integers(0, len(whole) - 1), st.randoms(use_true_random=False))
    def one(k, random):
        file = reader.files[k]
        file.write_bytes(damaged(whole[k], file.name, random))
        try:
            reader.read()
        except InputError as error:
            assert not beyond(error), name
        finally:
            file.write_bytes(whole[k])

    one()
