"""Two devices with one node id: `scan`, `check` and `record` say so before anything moves;
late answers are none.
"""

import pytest
from dry_sessions import FaultyDrives, Unasked, connected, dry_session, findings, swing
from virtual_buses import bus_file

from acquisition.bus import Frame, Uploads, scan_nodes
from acquisition.commands.scanning import ARRAYS, OBJECTS
from acquisition.errors import RefusedError
from acquisition.protocol import State, read_request
from acquisition.session import Task


class Twice(FaultyDrives):
    """Node 2 gives each SDO answer twice, the second after `after_ns`."""

    after_ns = 0

    def receive(self, now_ns, can_id, data):
        sent = super().receive(now_ns, can_id, data)
        again = [frame for frame in sent if frame[0] == 0x582]
        self.late += [(now_ns + self.after_ns, *frame) for frame in again if self.after_ns]
        return sent if self.after_ns else sent + again


TRACK = Task(reference=swing(2, seconds=0.4, amplitude=0.02))


@pytest.mark.parametrize(
    ("task", "after_ms"), [(Task(duration_s=0.2), 5), (TRACK, 0), (TRACK, 5), (TRACK, 45)]
)
def test_session_with_duplicate_id_enables_nothing(tmp_path, task, after_ms):
    drives = type("Late", (Twice,), {"after_ns": after_ms * 1_000_000})
    done = dry_session(tmp_path / "log.mcap", task, simulated=drives)
    assert "two devices answer as node 2" in done.outcome.reason
    assert done.outcome.unconfirmed == ()
    assert done.events("phase") == ["configure"]
    assert done.drives.states == [State.SWITCH_ON_DISABLED] * 2


VALUE, LATER = b"\x43\x18\x10\x04\x01\x00\x00\x00", b"\x41\x08\x10\x00\x08\x00\x00\x00"
AT_ONCE, IN_CHECK = 1_100_000_000, 1_500_000_000
CASES = {
    "between our own": ([Frame(IN_CHECK, 0x582, VALUE)], "node 2"),
    "of a device that is not described": ([Frame(IN_CHECK, 0x5FF, VALUE)], "node 127"),
    "asked by another": (
        [Frame(IN_CHECK, 0x605, read_request(0x1018, 4)), Frame(IN_CHECK + 1, 0x585, VALUE)],
        "",
    ),
    "a transfer in segments": ([Frame(AT_ONCE, 0x582, LATER)], ""),
    "no SDO": ([Frame(AT_ONCE, 0x580, VALUE)], ""),
}


@pytest.mark.parametrize("name", CASES)
def test_unrequested_answer(name):
    frames, said = CASES[name]
    run, master = connected()
    link = Unasked(link=run, frames=list(frames))
    rows = findings(link, master.bus, "node ids")
    assert [(row.found, row.ok) for row in rows] == (
        [(f"two devices answer as {said} → Give one of them another node id.", False)]
        if said
        else []
    )
    assert not link.frames


class Slow(FaultyDrives):
    asked = 0

    def receive(self, now_ns, can_id, data):
        sent = super().receive(now_ns, can_id, data)
        answers = [frame for frame in sent if frame[0] == 0x582]
        self.asked += len(answers)
        if answers and self.asked % 5 == 0:
            self.late += [(now_ns + 350_000_000, *frame) for frame in answers]
            return []
        return sent


def test_late_answer_is_no_second_device():
    run, master = connected(kind=Slow)
    assert findings(run, master.bus, "node ids") == []
    assert run.drives.asked > 20
    nodes = scan_nodes(Uploads(connected(kind=Slow)[0], bus_file()), OBJECTS, ARRAYS)
    assert sorted(nodes) == [1, 2]
    with pytest.raises(RefusedError, match="two devices answer as node 2"):
        scan_nodes(Uploads(connected(kind=Twice)[0], bus_file()), OBJECTS, ARRAYS)
