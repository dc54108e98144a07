"""A session that a busy machine ends is tried again and then skipped; any other failure stays one at once."""

from pathlib import Path

import pytest
from busy_machine import TRIES, tried_again
from dry_sessions import dry_session, swing
from test_guards import stalling

from acquisition.session import Task


@pytest.mark.parametrize(
    ("late", "wrong", "runs", "end"),
    [
        ((), (), 1, None),
        ((1,), (), 2, None),
        ((1, 2, 3), (), TRIES, pytest.skip.Exception),
        ((1,), (2,), 2, AssertionError),  # the second session was ended by nothing
        ((), (1,), 1, AssertionError),
    ],
)
def test_only_a_session_that_sync_was_late_in_is_tried_again(tmp_path, late, wrong, runs, end):
    made: list[Path] = []

    @tried_again
    def test(folder: Path) -> None:
        made.append(folder)
        assert (folder / "robot.toml").exists()
        out, number = folder / "log.mcap", len(made)
        assert not out.exists()
        through = stalling(170, 2.0 if number in late else 0.0)
        assert not dry_session(out, Task(reference=swing(2)), through=through).outcome.fault
        assert number not in wrong

    (tmp_path / "robot.toml").write_text("")
    if end is None:
        test(folder=tmp_path)
    else:
        line = "3 times: SYNC 2 s late in motion: expected 0.02 s at most: this computer was busy or stopped"
        with pytest.raises(end, match=line if end is pytest.skip.Exception else None):
            test(folder=tmp_path)
    assert len(made) == runs
