"""Recordings larger than what is held in memory: their samples lie on disk, and give the same."""

import numpy as np
import pytest
from conftest import REPLAY

from acquisition.files import GrowingBytes, allocate, on_disk, release_pages
from acquisition.recording import read_recording
from identification import identify_iv, load_signals
from identification.methods import Iteration
from identification.regression import Overrides


@pytest.fixture
def everything_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_disk, "MAX_BYTES_IN_MEMORY", 1000)
    monkeypatch.setattr(on_disk, "BLOCK_ROWS", 999)
    monkeypatch.setattr("acquisition.recording.rows._AT_ONCE", 700)


def is_on_disk(x: np.ndarray) -> bool:
    while isinstance(x.base, np.ndarray):
        x = x.base
    return x.base is not None


@pytest.mark.parametrize("held", [0, 5, 10, 10**6])
def test_appended_bytes_read_back(monkeypatch, held):
    monkeypatch.setattr(on_disk, "MAX_BYTES_IN_MEMORY", held)
    grown = GrowingBytes()
    for part in (b"ab", b"", b"cdefgh", b"ij"):
        grown.write(part)
    assert (grown.tell(), bytes(grown.whole())) == (10, b"abcdefghij")


def test_released_samples_read_again(everything_on_disk):
    x = allocate((500, 3))
    x[:] = np.arange(1500.0).reshape(500, 3)
    assert is_on_disk(x)
    release_pages(x)
    release_pages(x[10:20, 1])
    np.testing.assert_array_equal(x, np.arange(1500.0).reshape(500, 3))
    held = allocate((3, 3))
    held[:] = 1.0
    assert not is_on_disk(held)
    release_pages(held)
    assert (held == 1.0).all()


def test_timestamps_on_disk_keep_digits(everything_on_disk):
    rows = np.zeros(3000, [("stamp_ns", "<i8"), ("position", "<f8", (2,))])
    rows["stamp_ns"] = 1_700_000_000_000_000_001 + np.arange(3000)
    rows["position"] = np.arange(6000.0).reshape(3000, 2)
    for name in ("stamp_ns", "position"):
        found = on_disk.field_of(rows, name)
        assert is_on_disk(found)
        assert found.tolist() == rows[name].tolist()


def test_fit_on_disk_matches_memory(request):
    path = REPLAY / "scara" / "session.mcap"
    wanted = load_signals(path)
    fitted = identify_iv(wanted, Overrides(), Iteration())
    request.getfixturevalue("everything_on_disk")
    found = load_signals(path)
    assert is_on_disk(found.q)
    assert is_on_disk(read_recording(path).samples)
    for name in ("t_s", "q", "q_ref", "effort"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    np.testing.assert_array_equal(identify_iv(found, Overrides(), Iteration()).beta, fitted.beta)
