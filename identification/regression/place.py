"""Where a task finds a recording: each is read and filtered once per process."""

from collections import OrderedDict
from dataclasses import dataclass, replace

from ..data import RecordingFile, Signals
from .problem import Problem, make_problem
from .settings import Overrides

NUMBERS_KEPT = 8_000_000  # of positions that a process has at hand: 64 MB, a few times as much in all


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where a task finds a recording: its problem `at_hand`, or its file, read by the process that runs the task.

    `lag_s` is the lag of its torque that is corrected, None for the one that is known without a fit; `left_out` are friction
    terms that the fit leaves out of the description.
    """

    source: Signals | RecordingFile
    overrides: Overrides
    at_hand: Problem | None = None
    lag_s: float | None = None
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, problem: Problem) -> "Place":
        """Of a recording whose problem is in this process."""
        return cls(source=problem.signals, overrides=Overrides(), at_hand=problem)

    def problem(self) -> Problem:
        """The problem, as it is at hand in this process."""
        if self.at_hand is not None:
            return self.at_hand
        problem = self._made(self.source) if isinstance(self.source, Signals) else self._of_process(self.source)
        return replace(problem, base=problem.base.without(self.left_out)) if self.left_out else problem

    def _of_process(self, file: RecordingFile) -> Problem:
        key = f"{file.key} {self.overrides} {self.lag_s}"
        if key not in _problems:
            _problems[key] = self._made(file.load())
            while len(_problems) > 1 and sum(p.signals.q.size for p in _problems.values()) > NUMBERS_KEPT:
                _problems.popitem(last=False)
        _problems.move_to_end(key)
        return _problems[key]

    def _made(self, signals: Signals) -> Problem:
        problem = make_problem(signals, self.overrides)
        return problem if self.lag_s in (None, problem.settings.torque_lag_s) else problem.corrected(self.lag_s)


_problems: OrderedDict[str, Problem] = OrderedDict()  # of this process, those used last at the end
