"""Settings of a fit: samples, cut-off and decimation, by the rules of the method and overrides.

All follow from the bandwidth w of the position loop, which the description gives. Above w the robot
does not follow its reference:

    cut-off of the low-pass     w_fq = 5 w or more, which does not distort accelerations
    band of the decimated rows  w_fp = 2 w; torque and regressor above it are noise
    decimation                  n_d = 0.8 (f_m / 2) / f_p, as the filter passes 0.8 of half the rate
    border                      5 periods of w_fq at an end of the recording are cut, because the
                                low-pass has no samples beyond it

If no bandwidth is given, low-pass, rows and simulated loop end where the motion does, by its
spectrum. Between the borders the samples are those of the recording's tracking phase or, without
one, from the first motion to the last. They are fewer if the torque is recorded late or early, so
that every likely delay has samples.

Slow samples have zero weight; least squares and instrumental variables have a threshold each. A
setting in the description or an option replaces a rule, with a warning if that distorts the
estimates.
"""

from dataclasses import dataclass, replace

import msgspec

from acquisition.errors import Location, NoFitError
from acquisition.robot import (
    Edges,
    LowSpeed,
    check_recorded_efforts,
    check_recorded_positions,
    low_speed_by_method,
)

from ..arrays import Ints
from ..data import Signals
from ..options import Overrides, Span
from .filtering import MAX_PASS, Decimation, decimation_passes
from .motion import (
    CUT_PERIODS,
    MIN_ROWS,
    SPANS,
    FilteredMotion,
    Lag,
    SpanKind,
    border_samples,
    find_span,
    inside_borders,
    known_lag,
    motion_band_hz,
    motion_end_hz,
    with_torque,
)

CUTOFF_PER_BANDWIDTH = 5.0  # w_fq >= 5 w_dyn, section 2.3 of Janot2014
DECIMATED_PER_BANDWIDTH = 2.0  # w_fp >= 2 w_dyn
# Of the peak speed: a slower joint sticks and slips, which sign(dq) does not describe.
LOW_SPEED_PERCENT = 4.0
MIN_RATE_HZ = 1.0  # a lower sample rate cannot follow a robot
MAX_CUTOFF_SHARE = 0.4  # of the sample rate, for the cut-off of the rule
ROWS = -1.0  # in place of a taper L: no weights, but the rows in which the joint moves
RAMPS = (2.0, 0.5, 0.0, ROWS)  # tapers L in rows; short moves need short tapers
# Loop bandwidth over motion bandwidth of a default PD controller. At 1.0 the loop itself is late:
# friction holds a UR5's wrist back by 30 %.
SURROGATE_BANDWIDTH_RATIO = 2.0
# Torque errors have the filters of the rule for a loop of so many times the band of the motion,
# independent of the fit's own filters, so that errors of different fits can be compared.
LOOP_PER_BAND = 5.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The settings of a fit of a recording.

    Attributes:
        cutoff_hz: low-pass of the position (in one direction), Hz; None for none.
        decimator: decimation of torque and regressor.
        used: samples that are used.
        widest: the same with the samples that filters distort at the ends.
        samples: number of samples of the recording.
        span_kind: kind of the time range, a key of `SPANS`.
        filtered: True if the low-pass is that of the rule, or a lower one.
        band_hz: band of the motion, with nearly all power of each joint's speed, Hz.
        low_speed: by method, percentage of the peak speed below which samples have zero weight.
        low_speed_percent: that of the method of this fit; None for the rule.
        ramp_rows: weight taper L, in rows.
        lag: delay of the recorded torque, which is corrected; if a fit estimated it, `prior` is the
            prior knowledge.
        overloads: recorded efforts beyond a limit of the description, each a warning too.
        warnings: rules of the method that are not followed.
    """

    cutoff_hz: float | None
    decimator: Decimation
    used: range
    widest: range
    samples: int
    span_kind: SpanKind
    filtered: bool
    band_hz: float
    low_speed: LowSpeed
    low_speed_percent: float | None
    ramp_rows: float
    lag: Lag
    overloads: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def start(self) -> int:
        """First sample that is used."""
        return self.used.start

    @property
    def stop(self) -> int:
        """Sample after the last one that is used."""
        return self.used.stop

    @property
    def span(self) -> str:
        """Time range that is used, in words."""
        return SPANS[self.span_kind]

    @property
    def span_rule(self) -> Span:
        """The setting of the time range."""
        return "all" if self.span_kind == "all" else "motion"

    @property
    def decimation(self) -> int:
        """Samples per decimated row, n_d."""
        return self.decimator.factor

    @property
    def edges(self) -> Edges:
        """Treatment of the two ends by the decimation."""
        return "smooth" if self.decimator.smooth_ends else "matlab"

    @property
    def torque_lag_s(self) -> float:
        """Delay that is corrected, s, positive if late; 0 for none."""
        return self.lag.value_s

    @property
    def known_lag(self) -> Lag:
        """Delay by prior knowledge, of user and recording."""
        return self.lag.prior or self.lag

    @property
    def instants(self) -> Ints:
        """Samples (rows,) of the decimated rows: the last one used, and every n_d-th before it."""
        return self.start + self.decimator.instants(len(self.used))

    def for_errors(self, signals: Signals) -> "Settings":
        """Return a copy with the filters of torque errors.

        If the recording is too short for them, it has the filters of the fit, with a warning.
        """
        fs = signals.sample_rate_hz
        hz = min(LOOP_PER_BAND * self.band_hz, MAX_CUTOFF_SHARE * fs / CUTOFF_PER_BANDWIDTH)
        cutoff_hz, decimation = CUTOFF_PER_BANDWIDTH * hz, decimation_rule(fs, hz)
        border = border_samples(cutoff_hz, fs)
        used = range(max(self.widest.start, border), min(self.widest.stop, self.samples - border))
        if len(used) < MIN_ROWS * decimation:
            return replace(
                self,
                warnings=(
                    *self.warnings,
                    f"{signals.recording} is too short for the filters of torque errors, so the "
                    "errors include noise that the filters of the fit pass",
                ),
            )
        return replace(
            self,
            cutoff_hz=cutoff_hz,
            decimator=replace(self.decimator, factor=decimation),
            used=used,
            filtered=True,
            # The same for all friction terms, so that their errors can be compared.
            low_speed_percent=LOW_SPEED_PERCENT
            if self.low_speed_percent is None
            else self.low_speed_percent,
            ramp_rows=RAMPS[0],
        )


def with_bandwidth(signals: Signals) -> Signals:
    """Return the signals with a bandwidth of the position loop.

    It is the given one, or one high enough to follow the motion. It cannot be found from the
    tracking of the reference: with speed fed forward the position follows without an error, and a
    reference recorded some milliseconds early shows one without a loop.
    """
    robot, fs = signals.robot, signals.sample_rate_hz
    if robot.controller.bandwidth_hz is not None:
        return signals
    hz = min(motion_end_hz(signals), MAX_CUTOFF_SHARE * fs)
    controller = msgspec.structs.replace(
        robot.controller, bandwidth_hz=SURROGATE_BANDWIDTH_RATIO * hz
    )
    return replace(signals, robot=replace(robot, controller=controller), motion_hz=hz)


def make_settings(
    signals: Signals, overrides: Overrides, motion: FilteredMotion | None = None
) -> Settings:
    """Make settings for a recording: rules by the bandwidth, then robot.toml, then options.

        w_fq = 5 w,     n_d = 0.8 (f_m / 2) / f_p,     f_p = 2 w

    If no bandwidth w is given, w_fq is the end of the motion. The time range is the recording's
    tracking phase, or that between first and last motion; 5 periods of the cut-off are cut where it
    reaches an end of the recording.

    Parameters
    ----------
    signals : the recording.
    overrides : settings that replace those of the description.
    motion : low-passed motion of the recording, if there is one already.
    """
    _refuse_low_rate(signals)
    stored, given = signals.robot.identification, overrides.low_speed_percent
    low_speed = low_speed_by_method(stored.low_speed if given is None else given)
    # A fit of drive gains starts with gains of one if none are given: its efforts are not yet
    # torques.
    overloads = (
        check_recorded_efforts(signals.robot, signals.effort)
        if signals.robot.identified_gain is None
        else ()
    )
    # Wrong positions are refused first, because they also make filters and time range fail.
    positions = check_recorded_positions(signals.robot, signals.t_s, signals.q, signals.recording)
    # 0 means no low-pass, None the one of the rule.
    stated_hz = stored.cutoff_hz if overrides.cutoff_hz is None else overrides.cutoff_hz
    cutoff_hz = _cutoff_hz(signals, stated_hz)
    decimator = Decimation(
        factor=overrides.decimation or stored.decimation or _row_rule(signals),
        smooth_ends=(overrides.edges or stored.edges) == "smooth",
    )
    kind, span, standing = find_span(
        signals,
        motion or FilteredMotion(signals),
        cutoff_hz or rule_cutoff_hz(signals),
        overrides.span or stored.span,
    )
    lag = known_lag(signals, overrides)
    widest = with_torque(signals, span, lag)
    by_instruments = (
        signals.q_ref is not None if overrides.method is None else overrides.method == "iv"
    )
    return Settings(
        cutoff_hz=cutoff_hz,
        decimator=decimator,
        used=inside_borders(signals, widest, cutoff_hz, decimator.factor, SPANS[kind]),
        widest=widest,
        samples=len(signals.q),
        span_kind=kind,
        filtered=cutoff_hz is not None and cutoff_hz <= _highest_hz(signals) * (1 + 1e-9),
        band_hz=motion_band_hz(signals),
        low_speed=low_speed,
        low_speed_percent=low_speed.iv if by_instruments else low_speed.ls,
        ramp_rows=RAMPS[0] if overrides.ramp_rows is None else overrides.ramp_rows,
        lag=lag,
        overloads=overloads,
        warnings=(
            *signals.assumed,
            *positions,
            *overloads,
            *_warnings_of_filters(signals, stated_hz, cutoff_hz, decimator.factor),
            *(f"joint {name} does not move" for name in standing),
        ),
    )


def _refuse_low_rate(signals: Signals) -> None:
    fs, bandwidth_hz = signals.sample_rate_hz, signals.robot.bandwidth_hz
    least_hz = MIN_RATE_HZ if signals.motion_hz else max(MIN_RATE_HZ, 2 * bandwidth_hz)
    if not fs > least_hz:
        Location(signals.recording).refuse(
            "sample_rate_hz",
            fs,
            f"more than {least_hz:g} Hz, twice the bandwidth of the position loop",
            advice="Give a rate in Hz, not a period in s",
        )


def _cutoff_hz(signals: Signals, stated_hz: float | None) -> float | None:
    """Return the cut-off of the low-pass, Hz; None for no low-pass.

    `stated_hz` is the given one, None for the rule. The rule has no low-pass if its cut-off is
    above half the sample rate.

    Raises
    ------
    BadInputError : a given cut-off is above half the sample rate.
    NoFitError : the recording is shorter than the border of the low-pass, or than a period of the
        loop.
    """
    fs, N, stored = signals.sample_rate_hz, len(signals.q), signals.robot.identification
    asked_hz = _highest_hz(signals) if stated_hz is None else stated_hz
    if stated_hz is not None and not asked_hz < fs / 2:
        Location(signals.recording).refuse(
            "cut-off",
            asked_hz,
            f"less than {fs / 2:g} Hz, half the sample rate",
            shown=f"{asked_hz:g} Hz",
        )
    cutoff_hz = asked_hz if 0 < asked_hz < fs / 2 else None
    cuts_given = stored.cut_start_samples is not None and stored.cut_end_samples is not None
    if cutoff_hz is not None and not cuts_given and CUT_PERIODS * fs / cutoff_hz > N:
        raise NoFitError(
            f"{CUT_PERIODS:g} periods are longer than the {N / fs:.3g} s of the recording",
            place=signals.recording,
            key="cut-off",
            value=cutoff_hz,
            shown=f"{cutoff_hz:g} Hz",
            expected=f"more than {CUT_PERIODS * fs / N:.2g} Hz",
        )
    bandwidth_hz = signals.robot.bandwidth_hz
    if fs / bandwidth_hz > N:
        raise NoFitError(
            place=f"robot {signals.robot.name}",
            key="controller.bandwidth_hz",
            value=bandwidth_hz,
            shown=f"{bandwidth_hz:g}",
            expected=f"at least {fs / N:.3g}, one period in the {N / fs:.3g} s of "
            f"{signals.recording}",
        )
    return cutoff_hz


def _warnings_of_filters(
    signals: Signals, stated_hz: float | None, cutoff_hz: float | None, decimation: int
) -> list[str]:
    """Return warnings on rules that low-pass and decimation do not follow."""
    fs, bandwidth_hz = signals.sample_rate_hz, signals.robot.bandwidth_hz
    highest_hz, passband_hz = _highest_hz(signals), 0.8 * fs / (2 * decimation)
    lowpass = "no low-pass" if cutoff_hz is None else f"a low-pass at {cutoff_hz:.3g} Hz"
    stated = signals.motion_hz is None
    warnings = (
        (
            cutoff_hz is None and stated_hz is None,
            f"positions have no low-pass, since 5 times the bandwidth, {highest_hz:g} Hz, is more "
            f"than half the sample rate, {fs / 2:g} Hz",
        ),
        (
            not stated,
            f"controller.bandwidth_hz is not given: the fit uses {lowpass}, and a default PD "
            f"controller of {bandwidth_hz:.3g} Hz if the control law is unknown; "
            f"{signals.recording} has only noise above {highest_hz:.3g} Hz",
        ),
        (
            stated and cutoff_hz is not None and cutoff_hz < highest_hz * (1 - 1e-9),
            f"the cut-off of {cutoff_hz or 0.0:g} Hz is less than 5 times the bandwidth of "
            f"{bandwidth_hz:g} Hz, which distorts the accelerations and the estimates",
        ),
        (
            stated
            and decimation > _row_rule(signals)
            and passband_hz < DECIMATED_PER_BANDWIDTH * bandwidth_hz,
            f"decimation by {decimation} keeps {passband_hz:g} Hz, less than twice the bandwidth "
            f"of {bandwidth_hz:g} Hz, so the rows lack a part of the motion",
        ),
    )
    return [text for holds, text in warnings if holds]


def _highest_hz(signals: Signals) -> float:
    """Return the cut-off of the rule, Hz."""
    return signals.motion_hz or CUTOFF_PER_BANDWIDTH * signals.robot.bandwidth_hz


def _row_rule(signals: Signals) -> int:
    """Return the decimation of the rule."""
    rows_hz = signals.motion_hz or DECIMATED_PER_BANDWIDTH * signals.robot.bandwidth_hz
    return decimation_rule(signals.sample_rate_hz, rows_hz / DECIMATED_PER_BANDWIDTH)


def rule_cutoff_hz(signals: Signals) -> float:
    """Return the cut-off of the rule, at most 0.4 times the sample rate, Hz."""
    return min(_highest_hz(signals), MAX_CUTOFF_SHARE * signals.sample_rate_hz)


def decimation_rule(sample_rate_hz: float, bandwidth_hz: float) -> int:
    """Return n_d = round(0.8 (f_m/2) / f_p), with f_p twice the bandwidth.

    If that has a large prime factor, the next lower number without one is returned.
    """
    n_d = max(1, round(0.8 * (sample_rate_hz / 2) / (DECIMATED_PER_BANDWIDTH * bandwidth_hz)))
    while any(r > MAX_PASS for r in decimation_passes(n_d)):
        n_d -= 1
    return n_d
