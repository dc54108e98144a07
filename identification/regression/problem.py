"""The input of a fit: a recording, the settings, the model of the robot and its base parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from acquisition.errors import Location
from acquisition.files import release_pages
from acquisition.robot import Robot

from ..arrays import Array, Bools
from ..data import RecordingFile, Signals
from ..model import (
    BaseParameters,
    InverseModel,
    JointTerm,
    base_parameters,
    poses_of,
)
from .filtering import decimation_reach, nearby
from .motion import BLOCK_SAMPLES, LAG_REACH, SPLINE_REACH, FilteredMotion, sampled_at
from .settings import (
    Overrides,
    Settings,
    make_settings,
    rule_cutoff_hz,
    with_bandwidth,
)

FIRST_MINUTES_S, MARGIN_S = 180.0, 5.0  # of a long recording; and after them, for the filters
# Numbers of the regressor of a block, 64 MB; shorter blocks spend more time on margins.
_SERIES_BLOCK = 8_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """The input of a fit: a recording with its settings and its model, made once.

    Attributes:
        signals: recording, as recorded.
        settings: samples, filters and weights.
        model: inverse dynamic model of the robot.
        base: base parameters, which regroup those of the model.
        motion: low-passed motion of the recording.
        poses: (P, n) positions in the time range used, at which the inertia matrix is checked.
        source: where the recording is read again, if the samples are left out.
        gains: (n,) factors on the given drive gains that a fit estimated; None before.
    """

    signals: Signals
    settings: Settings
    model: InverseModel
    base: BaseParameters
    motion: FilteredMotion
    poses: Array
    source: Signals | RecordingFile | None = None
    gains: Array | None = None

    @property
    def robot(self) -> Robot:
        """Robot with its drive gains."""
        robot = self.signals.robot
        return (
            robot if self.gains is None else replace(robot, identified_gain=robot.gain * self.gains)
        )

    def drives(self, start: int, stop: int, lag_s: float, kappa: Array | None = None) -> Array:
        """Return the torque (N, n) of the drives at the samples `start` to `stop`, N m or N.

            sum_m kappa_m E_m(t + L),     equation (I)

        Parameters
        ----------
        start, stop : first sample, and the one after the last.
        lag_s : delay L of the recorded torque, s.
        kappa : (n,) factors on the given drive gains; by default those that were estimated.
        """
        kappa = self.gains if kappa is None else kappa
        s, by = self.signals, lag_s * self.signals.sample_rate_hz
        low = max(0, math.floor(start + by) - SPLINE_REACH)
        high = min(len(s.effort), math.ceil(stop + by) + SPLINE_REACH)
        tau, R = s.torque[low:high], s.robot.R
        if s.known_torque is not None:
            tau = tau - s.known_torque[low:high]
        tau = sampled_at(np.arange(start - low, stop - low, dtype=np.float64) + by, tau)
        if len(s.effort) > BLOCK_SAMPLES:
            release_pages(s.effort)
        return tau if kappa is None else np.linalg.solve(R.T, tau.T).T * kappa @ R

    @property
    def kinds(self) -> list[str]:
        """Kinds (b,) of the base parameters that belong to joints; empty for those of links."""
        return [getattr(self.model.sources[c], "kind", "") for c in self.base.columns]

    def term_of(self, name: str) -> JointTerm:
        """Return the term of a joint that a base parameter represents alone."""
        return self.model.terms[int(self.base.columns[self.base.names.index(name)])]

    def joint_of(self, name: str) -> str:
        """Return the joint of a base parameter; the last one if it acts at several."""
        return self.signals.robot.joints[int(self.term_of(name).rows[-1])].name

    @cached_property
    def exact(self) -> bool:
        """True if columns are computed at every sample.

        Beside the columns of drives and of load-dependent friction, others would not be exact
        enough.
        """
        robot = self.signals.robot
        return (
            robot.identified_gain is not None
            or any(motor.drive_gain_half_width for motor in robot.motors)
            or "load" in self.kinds
        )

    @property
    def slip_cutoff_hz(self) -> float:
        """Cut-off of the speeds that select rows, Hz.

        It is that of the fit, or of the rule if the fit has none or a higher one.
        """
        own_hz = self.settings.cutoff_hz if self.settings.filtered else None
        return rule_cutoff_hz(self.signals) if own_hz is None else own_hz

    def measured_samples(self, beside: int = 0) -> Bools:
        """Return a mask (N,) of samples far from all that were not measured.

        The distance is half a period of the low-pass, which smears their positions, or the largest
        likely delay, which shifts their torques; and `beside` samples more.
        """
        fs, lag = self.signals.sample_rate_hz, self.settings.known_lag
        if self.signals.measured is None:
            return np.broadcast_to(True, len(self.signals.t_s) or self.settings.stop)
        # To 1e-5, a shifted torque depends on samples within a quarter of the reach of its spline.
        moved = fs * (abs(lag.value_s) + LAG_REACH * lag.sd_s) + SPLINE_REACH // 4
        return ~nearby(
            ~self.signals.measured, beside + round(max(0.5 * fs / self.slip_cutoff_hz, moved))
        )

    def measured_rows(self) -> Bools:
        """Return a mask (rows,) of decimated rows whose filter reaches only measured samples.

        The reach ends where the filter rings by less than a thousandth. If no row remains, the mask
        has all rows.
        """
        far = self.measured_samples(8 * self.settings.decimation)[self.settings.instants]
        return far | ~far.any()

    @cached_property
    def without_samples(self) -> "Problem":
        """Copy without samples: settings, model, mask of measured samples, and `source`."""
        signals = replace(self.signals.first(0), measured=self.signals.measured, health={})
        return replace(self, signals=signals, motion=FilteredMotion(signals))

    def with_samples(self) -> "Problem":
        """Return the problem with its samples, which are read again if they were left out."""
        if len(self.signals.q) or self.source is None:
            return self
        of = self.signals  # its robot has a bandwidth, that of the recording may not
        signals = replace(self.source.load(), robot=of.robot, motion_hz=of.motion_hz)
        return replace(self, signals=signals, motion=FilteredMotion(signals))

    @cached_property
    def for_errors(self) -> "Problem":
        """Copy with the filters of torque errors."""
        s = self.signals
        return replace(
            self,
            signals=s if s.motion_hz is None else replace(s, motion_hz=None),
            settings=self.settings.for_errors(s),
        )

    def first_minutes(self) -> "Problem":
        """Return the first minutes of the time range used, and some seconds more for the filters.

        A shorter problem returns itself.
        """
        s, fs = self.settings, self.signals.sample_rate_hz
        if (stop := s.start + round(FIRST_MINUTES_S * fs)) >= s.stop:
            return self
        signals = self.signals.first(stop + round(MARGIN_S * fs))
        return replace(
            self,
            signals=signals,
            source=None,
            motion=FilteredMotion(signals),
            settings=replace(s, used=range(s.start, stop)),
        )

    def without_terms(self, left_out: dict[str, str]) -> "Problem":
        """Return a copy without the given friction terms; the reasons become warnings.

        The terms must not belong to a regrouped parameter.
        """
        return replace(
            self,
            base=self.base.without(left_out),
            settings=replace(self.settings, warnings=(*self.settings.warnings, *left_out.values())),
        )


def _refuse_unknown_motors(signals: Signals, gains: Sequence[str]) -> None:
    """Refuse names in `gains` that are not motors, and other motors whose gain is unknown."""
    names, place = (
        {motor.name: motor.gain for motor in signals.robot.motors},
        Location(f"robot {signals.robot.name}"),
    )
    for name in gains:
        place.require(name in names, "gains", name, f"one of {', '.join(names)}")
    for name, gain in names.items():
        place.require(
            gain is not None or name in gains,
            f"motor {name}: drive_gain",
            None,
            advice="Give it in robot.toml, or identify it",
            arguments=("gains",),
        )


def make_problem(signals: Signals, overrides: Overrides) -> Problem:
    """Make the input of a fit.

    Parameters
    ----------
    signals : the recording.
    overrides : settings that replace those of the description.

    Raises
    ------
    BadInputError : the settings do not suit the recording, or the robot cannot be modelled.
    """
    if overrides.gains:
        if "all" not in overrides.gains:
            _refuse_unknown_motors(signals, overrides.gains)
        signals = replace(signals, robot=replace(signals.robot, identified_gain=signals.robot.gain))
    signals = with_bandwidth(signals)
    motion = FilteredMotion(signals)
    settings = make_settings(signals, overrides, motion)
    return Problem(
        signals=signals,
        settings=settings,
        model=(model := InverseModel(signals.robot)),
        base=base_parameters(model),
        motion=motion,
        poses=poses_of(signals.q[settings.start : settings.stop]),
    )


def with_common_band(problems: Sequence[Problem]) -> list[Problem]:
    """Return the problems with torque errors in a common band of motion, the widest."""
    band_hz = max(one.settings.band_hz for one in problems)
    return [replace(one, settings=replace(one.settings, band_hz=band_hz)) for one in problems]


def row_blocks(problem: Problem) -> list[tuple[slice, slice]]:
    """Return the rows of the time range used, in blocks.

    Each block is the slice of rows that its filters need samples of, and in it the slice of its own
    rows. The borders depend only on the recording. Margins are as long as the reach of the filters
    and no block is shorter, so that blocks give the same result as the whole.
    """
    n_d, rows = problem.settings.decimation, len(problem.settings.instants)
    margin = -(-decimation_reach(n_d) // n_d)
    series = int(problem.model.nonzero[:, problem.base.columns].sum())
    size = max(4 * margin, _SERIES_BLOCK // (series * n_d), 1)
    return [
        (slice(low, min(rows, last + margin)), slice(first - low, last - low))
        for first, last in pairwise([*range(0, max(1, rows - max(1, margin)), size), rows])
        for low in [max(0, first - margin)]
    ]
