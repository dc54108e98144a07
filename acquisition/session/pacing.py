"""Timing of SYNC: when it is sent or awaited, and when it is too late."""

from ..bus import Master
from ..errors import AcquisitionError
from ..robot import BusFile

# In motion SYNC may be late by the larger of the two, unless `[bus] late_sync_s` is stated.
LATE_PERIODS, LATE_S = 3, 0.02
ABSENT_PERIODS = 50  # at rest, without SYNC of the other producer
ANSWER_SHARE = 0.7  # of a period: drives must answer SYNC within it


def largest_delay_s(file: BusFile) -> float:
    """How late SYNC may be in motion, s."""
    return max(LATE_PERIODS * file.sync_period_s, LATE_S) if file.late_sync_s is None else file.late_sync_s


class Pace:
    """Sends or awaits one SYNC after the other, each with the answers to it."""

    def __init__(self, master: Master) -> None:
        file = master.bus.file
        self._master, self._link, self._period_ns = master, master.link, master.bus.period_ns
        self._ours = file.sync_producer == "recorder"
        self._latest_ns = round(largest_delay_s(file) * 1e9)
        self.next_ns = 0

    def start(self) -> None:
        """Set the time of the first SYNC: a period from now."""
        self.next_ns = self._link.now_ns() + self._period_ns

    def sync(self, *, in_motion: bool) -> None:
        """Wait until SYNC is due, send it (or await that of the other producer), and take the answers.

        Raises `AcquisitionError` where SYNC is later than allowed in motion, or absent: drives would stop at their last
        target, and the next target would be a step.
        """
        if self._ours:
            self._master.wait(self.next_ns)
            self._refuse_late(in_motion)
            if self._link.now_ns() > self.next_ns + self._period_ns:
                self.next_ns = self._link.now_ns()  # after a delay the period starts again from here: no burst of SYNCs
            self._master.sync()
        else:
            patience_ns = self._latest_ns if in_motion else ABSENT_PERIODS * self._period_ns
            if not self._master.wait_for_sync(self.next_ns + patience_ns):
                waited = f"{patience_ns / self._period_ns:.3g} periods"
                expected = "the other producer's; or sync_producer = 'recorder'"
                raise AcquisitionError(f"no SYNC in {waited}", place="bus", expected=expected)
            self._refuse_late(in_motion)
            self.next_ns = self._link.now_ns()
        self._master.wait(self.next_ns + round(ANSWER_SHARE * self._period_ns), for_answers=True)
        self.next_ns += self._period_ns

    def _refuse_late(self, in_motion: bool) -> None:
        late_ns = self._link.now_ns() - self.next_ns
        if in_motion and late_ns > self._latest_ns:
            expected = f"{self._latest_ns * 1e-9:.3g} s at most: this computer was busy or stopped"
            raise AcquisitionError(f"SYNC {late_ns * 1e-9:.3g} s late in motion", expected=expected)
