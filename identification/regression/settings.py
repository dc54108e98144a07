"""Settings of a fit: samples, cut-off and decimation, by the rules of the method and overrides.

Where the description states no bandwidth of the position loop, low-pass and simulated loop end
where the motion does.
"""

import math
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from acquisition import robot
from acquisition.errors import BadInputError, NoFitError
from acquisition.robot import Edges, LowSpeed

from ..arrays import Array, Ints
from ..data import Signals
from ..estimation import MOVING
from ..options import Overrides, Span
from .filtering import MAX_PASS, Decimation, decimation_passes
from .motion import BLOCK_SAMPLES, FilteredMotion, standing_joints
from .spectrum import motion_band_hz, motion_end_hz

CUTOFF_PER_BANDWIDTH = 5.0  # w_fq >= 5 w_dyn, section 2.3 of Janot2014
DECIMATED_PER_BANDWIDTH = 2.0  # w_fp >= 2 w_dyn
CUT_PERIODS = 5.0  # border of 5 periods of the cut-off: 50 samples at 1 kHz and 100 Hz
# of the peak: slower joints stick and slip, which sign(dq) does not describe
LOW_SPEED_PERCENT = 4.0
MIN_ROWS = 30  # decimated, of a fit
MIN_RATE_HZ = 1.0  # of samples that follow a robot
MAX_CUTOFF_SHARE = 0.4  # of the sample rate, of the rule's cut-off
ROWS = -1.0  # in place of L: no weights, but the rows in which the joint moves
RAMPS = (2.0, 0.5, 0.0, ROWS)  # L in rows; short moves need short ramps
LAG_REACH = 3.0  # deviations that the lag may differ from the known one
NOTHING, UNKNOWN_LAG_S = "nothing", 0.002  # deviation of an unknown lag
# of a simulated loop; one at its end itself lags: friction holds a UR5's wrist back by 30 %
LOOP_PER_MOTION = 2.0
# torque errors are told behind the filters of the rule for a loop of so many times the band of the
# motion, whatever the fit's own are
LOOP_PER_BAND = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of a recording, or of several of equal timing, s, positive: late.

    Attributes:
        value_s, sd_s: the lag and its deviation, which the intervals include; half a 95 % interval
            is `reach` deviations. A value stated by the user has no deviation.
        source: where the value comes from.
        period_s: of the samples.
        prior: the lag as known without a fit, if data have been combined with it.
        found: value, deviation and its degrees of freedom by the instruments alone; None where
            they do not determine it.
        by_law_s: the lag where the described control law gives the effort, else None.
        moved: (b,) shift of each parameter by one deviation of the lag.
        recordings: their names.
        order: of the filter that whitens the rows of the lag; 0 without such rows.
    """

    value_s: float
    sd_s: float
    source: str
    period_s: float
    reach: float = 2.0
    prior: "Lag | None" = None
    found: tuple[float, float, int] | None = None
    by_law_s: float | None = None
    moved: Array = field(default_factory=lambda: np.zeros(0))
    recordings: tuple[str, ...] = ()
    order: int = 0

    @property
    def stated(self) -> bool:
        """Whether the user stated it."""
        return self.sd_s == 0.0

    @property
    def half_width_s(self) -> float:
        """Half its 95 % interval."""
        return self.reach * self.sd_s

    @property
    def delay_s(self) -> tuple[float, float] | None:
        """Time from command to torque and half its interval; None without a described law."""
        if self.by_law_s is None or self.found is None:
            return None
        return self.by_law_s - self.found[0], self.reach * self.found[1]

    def with_other(self, other: "Lag") -> "Lag":
        """Both combined, weighted by their variances."""
        own, others = self.sd_s**-2, other.sd_s**-2
        value = (own * self.value_s + others * other.value_s) / (own + others)
        sd, source = (own + others) ** -0.5, f"{self.source} and {other.source}"
        return replace(self, value_s=value, sd_s=sd, source=source)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A fit's settings, resolved.

    Attributes:
        cutoff_hz: low-pass of the position (one direction), None without.
        decimation: samples per decimated row, n_d.
        widest: the span with what filters distort at the ends; `samples`: of the recording.
        filtered: whether the low-pass is that of the rule, or a lower one.
        band_hz: of the motion: below it lies nearly all power of each joint's speed.
        edges: how the decimation treats the two ends (`filtering.Decimation`).
        low_speed: slower samples weigh nothing, by method; `low_speed_percent`: of the method
            of this fit (`weights`).
        ramp_rows: L of the weights, in rows.
        torque_lag_s: lag of the recorded torque in s, positive if late, that is
            corrected; 0 for none.
        known_lag: the lag as known without a fit, by user and recording.
        span: the samples `start` to `stop` in words; `span_rule`: the setting.
        overloads: recorded efforts beyond a limit of the description, each a warning too.
        warnings: rules of the method that are not followed.
    """

    cutoff_hz: float | None
    decimation: int
    start: int
    stop: int
    widest: tuple[int, int]
    samples: int
    filtered: bool
    band_hz: float
    edges: Edges
    low_speed: LowSpeed
    low_speed_percent: float | None
    ramp_rows: float
    torque_lag_s: float
    known_lag: Lag
    span: str
    span_rule: Span
    overloads: tuple[str, ...]
    warnings: tuple[str, ...]

    def for_errors(self, fs: float) -> "Settings":
        """The same with the filters behind which torque errors are told; itself where the recording
        is too short for them.
        """
        hz = min(LOOP_PER_BAND * self.band_hz, MAX_CUTOFF_SHARE * fs / CUTOFF_PER_BANDWIDTH)
        cutoff_hz, decimation = CUTOFF_PER_BANDWIDTH * hz, decimation_rule(fs, hz)
        border, (start, stop) = _border(cutoff_hz, fs), self.widest
        start, stop = max(start, border), min(stop, self.samples - border)
        if stop - start < MIN_ROWS * decimation:
            return self
        return replace(
            self,
            cutoff_hz=cutoff_hz,
            decimation=decimation,
            start=start,
            stop=stop,
            filtered=True,
            # whatever the terms of friction are
            low_speed_percent=LOW_SPEED_PERCENT
            if self.low_speed_percent is None
            else self.low_speed_percent,
            ramp_rows=RAMPS[0],
        )

    @property
    def decimator(self) -> Decimation:
        """The decimation of torque and regressor."""
        return Decimation(factor=self.decimation, smooth_ends=self.edges == "smooth")

    @property
    def instants(self) -> Ints:
        """The samples (rows,) of the decimated rows: the last of the span, every n_d-th before."""
        return self.start + self.decimator.instants(self.stop - self.start)


def with_bandwidth(signals: Signals) -> Signals:
    """The signals with a bandwidth of the position loop: that of the description, or one that
    follows the recorded motion.

    The tracking of the reference does not show it: with speed fed forward the position follows
    without an error, and a reference recorded some milliseconds early has one without a loop.
    """
    robot, fs = signals.robot, signals.sample_rate_hz
    if robot.controller.bandwidth_hz is not None:
        return signals
    hz = min(motion_end_hz(signals), MAX_CUTOFF_SHARE * fs)
    controller = msgspec.structs.replace(robot.controller, bandwidth_hz=LOOP_PER_MOTION * hz)
    return replace(signals, robot=replace(robot, controller=controller), motion_hz=hz)


def _border(cutoff_hz: float | None, fs: float) -> int:
    """Samples at an end of a recording that the low-pass distorts."""
    return 2 if cutoff_hz is None else math.ceil(CUT_PERIODS * fs / cutoff_hz)


def make_settings(
    signals: Signals, overrides: Overrides, motion: FilteredMotion | None = None
) -> Settings:
    """Settings for a recording: rules from the position loop's bandwidth, then
    robot.toml, then options.

    Cut-off 5 times the bandwidth, or the end of the motion if no bandwidth is stated; decimation
    n_d = 0.8 (f_m / 2) / f_p with f_p twice the bandwidth; the span between first and last motion,
    or the recording's tracking phase; 5 periods of the cut-off cut where that span reaches an end
    of the recording. `motion` is that of the recording, if there is one.
    """
    fs, stored, bandwidth_hz = (
        signals.sample_rate_hz,
        signals.robot.identification,
        signals.robot.bandwidth_hz,
    )
    given = overrides.low_speed_percent
    low_speed = robot.low_speed_by_method(stored.low_speed if given is None else given)
    # A fit with --gains starts with gains of one where none is described: its
    # efforts are no torques yet.
    overloads = (
        robot.check_recorded_efforts(signals.robot, signals.effort)
        if signals.robot.identified_gain is None
        else ()
    )
    warnings = [
        *signals.assumed,
        *robot.check_recorded_positions(signals.robot, signals.t_s, signals.q, signals.recording),
        *overloads,
    ]
    least_hz = MIN_RATE_HZ if signals.motion_hz else max(MIN_RATE_HZ, 2 * bandwidth_hz)
    if fs <= least_hz:
        raise BadInputError(
            place=signals.recording,
            key="sample_rate_hz",
            value=fs,
            expected=f"above {least_hz:g} Hz, twice the bandwidth of the position loop: a rate in "
            "Hz, not a period",
        )
    highest_hz = signals.motion_hz or CUTOFF_PER_BANDWIDTH * bandwidth_hz
    stated_hz = stored.cutoff_hz if overrides.cutoff_hz is None else overrides.cutoff_hz
    cutoff_hz = (highest_hz if stated_hz is None else stated_hz) or None
    if cutoff_hz is not None and cutoff_hz >= fs / 2:
        if stated_hz is not None:
            raise BadInputError(
                place=signals.recording,
                key="cut-off",
                value=cutoff_hz,
                shown=f"{cutoff_hz:g} Hz",
                expected=f"below {fs / 2:g} Hz, half the rate",
            )
        warnings.append(
            f"no low-pass: 5 times the bandwidth is {cutoff_hz:g} Hz, above half the rate, "
            f"{fs / 2:g} Hz"
        )
        cutoff_hz = None
    if signals.motion_hz is not None:
        lowpass = "no low-pass" if cutoff_hz is None else f"low-pass at {cutoff_hz:.3g} Hz"
        warnings.append(
            f"controller.bandwidth_hz is not stated: {lowpass}, a PD of {bandwidth_hz:.3g} Hz "
            "simulated if no loop is "
            f"described; {signals.recording} has only noise above {signals.motion_hz:.3g} Hz"
        )
    elif cutoff_hz is not None and cutoff_hz < highest_hz * (1 - 1e-9):
        warnings.append(
            f"the cut-off of {cutoff_hz:g} Hz is below 5 times the bandwidth of {bandwidth_hz:g} "
            "Hz: it distorts the "
            "accelerations and the estimates"
        )
    N = len(signals.q)
    cuts_given = stored.cut_start_samples is not None and stored.cut_end_samples is not None
    if cutoff_hz is not None and not cuts_given and CUT_PERIODS * fs / cutoff_hz > N:
        raise NoFitError(
            f"{CUT_PERIODS:g} periods are longer than the recording's {N / fs:.3g} s",
            place=signals.recording,
            key="cut-off",
            value=cutoff_hz,
            shown=f"{cutoff_hz:g} Hz",
            expected=f"more than {CUT_PERIODS * fs / N:.2g} Hz",
        )
    if fs / bandwidth_hz > N:
        raise NoFitError(
            place=f"robot {signals.robot.name}",
            key="controller.bandwidth_hz",
            value=bandwidth_hz,
            shown=f"{bandwidth_hz:g}",
            expected=f"a period shorter than the {N / fs:.3g} s of {signals.recording}",
        )
    rows_hz = signals.motion_hz or DECIMATED_PER_BANDWIDTH * bandwidth_hz
    rule = decimation_rule(fs, rows_hz / DECIMATED_PER_BANDWIDTH)
    decimation = overrides.decimation or stored.decimation or rule
    passband_hz = 0.8 * fs / (2 * decimation)
    if decimation > rule and signals.motion_hz is None and passband_hz < rows_hz:
        warnings.append(
            f"decimation by {decimation} keeps {passband_hz:g} Hz, less than twice the bandwidth "
            f"of {bandwidth_hz:g} Hz"
        )
    span_rule = overrides.span or stored.span
    start, stop, span, standing = _span(
        signals, motion or FilteredMotion(signals), cutoff_hz, span_rule
    )
    warnings += [f"joint {name} does not move" for name in standing]
    lag = known_lag(signals, overrides)
    early, late = (fs * (lag.value_s + way * LAG_REACH * lag.sd_s) for way in (-1, 1))
    # others may have no torque
    widest = (
        max(start, stored.cut_start_samples or 0, math.ceil(-early)),
        min(stop, N - (stored.cut_end_samples or 0), N - math.ceil(late)),
    )
    border = _border(cutoff_hz, fs)
    start = max(widest[0], border if stored.cut_start_samples is None else 0)
    stop = min(widest[1], N - (border if stored.cut_end_samples is None else 0))
    filtered = cutoff_hz is not None and cutoff_hz <= highest_hz * (1 + 1e-9)
    by_instruments = (
        signals.q_ref is not None if overrides.method is None else overrides.method == "iv"
    )
    if stop - start < MIN_ROWS * decimation:
        raise NoFitError(
            place=signals.recording,
            key=f"samples left after cutting the borders ({span})",
            value=max(0, stop - start),
            expected=f"at least {MIN_ROWS * decimation}, {MIN_ROWS} decimated rows",
        )
    return Settings(
        cutoff_hz=cutoff_hz,
        decimation=decimation,
        start=start,
        stop=stop,
        widest=widest,
        samples=N,
        filtered=filtered,
        band_hz=motion_band_hz(signals),
        edges=overrides.edges or stored.edges,
        low_speed=low_speed,
        low_speed_percent=low_speed.iv if by_instruments else low_speed.ls,
        ramp_rows=RAMPS[0] if overrides.ramp_rows is None else overrides.ramp_rows,
        torque_lag_s=lag.value_s,
        known_lag=lag,
        span=span,
        overloads=overloads,
        span_rule=span_rule,
        warnings=tuple(warnings),
    )


def known_lag(signals: Signals, overrides: Overrides) -> Lag:
    """Return the lag of a recording's torque as known without a fit: the value at which the lag
    among the unknowns starts, and its deviation.

    A command held for a control period is half that period early: it is recorded at the tick and
    acts, on average, half a period later. Without a described period it is that of the samples.
    `"none"` states a lag of 0.
    """
    own, period_s = signals.robot.identification.torque_lag_s, 1 / signals.sample_rate_hz
    given = own if overrides.torque_lag_s is None else overrides.torque_lag_s
    if given is not None:
        value_s, sd_s, source = 0.0 if given == "none" else given, 0.0, "torque_lag_s"
    elif signals.effort_timing == "unknown":
        value_s, sd_s, source = 0.0, UNKNOWN_LAG_S, NOTHING
    else:
        held_s = 1 / (signals.robot.controller.sample_rate_hz or signals.sample_rate_hz)
        value_s = -0.5 * held_s if signals.effort_timing == "command" else 0.0
        sd_s, source = 0.25 * held_s, f"effort_timing {signals.effort_timing}"
    return Lag(value_s=value_s, sd_s=sd_s, source=source, period_s=period_s)


def rule_cutoff_hz(signals: Signals) -> float:
    """Cut-off by the rule, at most 0.4 times the rate."""
    highest_hz = signals.motion_hz or CUTOFF_PER_BANDWIDTH * signals.robot.bandwidth_hz
    return min(highest_hz, MAX_CUTOFF_SHARE * signals.sample_rate_hz)


def decimation_rule(sample_rate_hz: float, bandwidth_hz: float) -> int:
    """n_d = round(0.8 (f_m/2) / f_p), f_p twice the bandwidth; or the next lower
    number with small factors.
    """
    n_d = max(1, round(0.8 * (sample_rate_hz / 2) / (DECIMATED_PER_BANDWIDTH * bandwidth_hz)))
    while any(r > MAX_PASS for r in decimation_passes(n_d)):
        n_d -= 1
    return n_d


def _span(
    signals: Signals, filtered: FilteredMotion, cutoff_hz: float | None, wanted: Span
) -> tuple[int, int, str, tuple[str, ...]]:
    """First and last sample, the span in words, and standing joints, if these are determined."""
    N = len(signals.q)
    if wanted == "all":
        return 0, N, "all samples", ()
    if signals.track is not None:
        return *signals.track, "the recording's tracking phase", ()
    speed = np.empty(signals.q.shape, dtype=np.float32)
    for a in range(0, N, BLOCK_SAMPLES):
        b = min(N, a + BLOCK_SAMPLES)
        # the filter of the rule separates motion from noise, also if the fit has none
        speed[a:b] = np.abs(filtered.between(a, b, cutoff_hz or rule_cutoff_hz(signals)).dq)
    peak = speed.max(axis=0)
    if not peak.any():
        raise NoFitError(
            "no joint moves", place=signals.recording, expected="an exciting trajectory"
        )
    standing = standing_joints(peak, signals.robot.joints)
    moves = [joint.name not in standing for joint in signals.robot.joints]
    moving = np.flatnonzero((speed > MOVING * peak)[:, moves].any(axis=1))
    return int(moving[0]), int(moving[-1]) + 1, "the span between first and last motion", standing
