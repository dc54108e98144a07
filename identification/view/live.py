"""The live page of a recording that is being written (`view --follow`).

It is for engineers, and cannot stop the robot. It reads the file alone, so that it cannot hold the
recorder up.
"""

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from msgspec import UNSET

from acquisition.errors import BadInputError, Location
from acquisition.recording import Block, RecordingFollower
from acquisition.robot import Robot, effort_limits

from ..arrays import Array
from ..model import InverseModel, base_parameters
from ..regression import CUT_PERIODS, Decimation, motion_between, predicted_torque, sampled_at
from ..report import FitFile, read_fit
from ..results import stored_beta, with_stored_gains
from .panels import GREEN, GREY, LIGHT, ORANGE, REFERENCE, RESIDUAL, Color
from .rerun_panels import event_view, shown_text

RED: Color = (200, 30, 30)
PORT, VIEWER_MEMORY = 9876, "1GB"
POLL_S = 0.05
STALLED_S, GIVE_UP_S = 1.0, 15.0  # without growth; the recorder writes every half second
MAX_FINISH_S = 600.0  # without growth after the end of the session: the recorder decodes
SHOWN_S = 20.0  # of the plots
BAND = 4.0  # times the rms residual of the fit
_RATED = {"N m": "rated_torque_nm", "N": "rated_force_n", "A": "rated_current_a"}
_LOSSES = ("late", "missing", "kernel_drops")
Lines = dict[str, tuple[Color, float]]  # level lines of a plot by name


def follow_recording(
    path: Path, fit: Path | None, out: Path | None, warn: Callable[[str], None]
) -> None:
    """Show the recording at `path` until it is complete.

    It is shown in a viewer on this machine, or written to `out`. `fit`: its JSON file, to show the
    residual torque too. `warn` gets warnings, one line each.

    Raises
    ------
    BadInputError : the recording cannot be followed any more: it is gone, replaced, truncated, or
        not written.
    """
    follower = RecordingFollower(path)
    residual = None if fit is None else Residual(read_fit(fit), str(fit), follower.robot)
    recording = rr.RecordingStream(f"live {shown_text(follower.robot.name)}")
    if out is None:
        _open_viewer(recording)
    else:
        recording.save(out)
    page, grown_s = LivePage(recording, follower.robot, residual), time.monotonic()
    try:
        while not follower.ended:
            now_s = time.monotonic()
            grown_s = now_s if follower.read() else grown_s
            page.add(follower, stalled=now_s - grown_s > STALLED_S, warn=warn)
            Location(str(path)).require(
                now_s - grown_s <= (MAX_FINISH_S if page.over else GIVE_UP_S),
                text=f"has not grown for {now_s - grown_s:.0f} s",
                advice="Check the recorder; `robot-acquire import` repairs a recording that "
                "is truncated",
            )
            _wait()
    finally:
        recording.disconnect()


def _wait() -> None:
    time.sleep(POLL_S)


def _open_viewer(recording: Any) -> None:
    """Connect to the viewer on this machine; first open one, with limited memory, if necessary."""
    with socket.socket() as port:
        if port.connect_ex(("127.0.0.1", PORT)):
            options = f"--bind 127.0.0.1 --port {PORT} --memory-limit {VIEWER_MEMORY}"
            subprocess.Popen(
                [sys.executable, "-m", "rerun", *options.split()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
    recording.connect_grpc(f"rerun+http://127.0.0.1:{PORT}/proxy")


class Residual:
    """Measured minus predicted torque of the newest rows.

    Both are filtered as for the errors of a fit.
    """

    def __init__(self, stored: FitFile, place: str, robot: Robot) -> None:
        self._robot, self._gained = robot, with_stored_gains(stored, robot)
        self._model = InverseModel(self._gained)
        self._base = base_parameters(self._model)
        self._beta = stored_beta(stored, self._base, place)
        rms = [joint.residual_rms for joint in stored.joints]
        cutoff_hz, n_d = stored.error_cutoff_hz, stored.error_decimation
        if stored.sample_rate_hz is None or n_d is None or UNSET in rms:
            raise BadInputError(
                "contains no rms residuals", place=place, advice="Repeat the fit with this version"
            )
        self.band = [BAND * float(value) for value in rms if value is not UNSET]
        assert robot.bus is not None
        rate_hz, ratio = (
            1.0 / robot.bus.sync_period_s,
            stored.sample_rate_hz * robot.bus.sync_period_s,
        )
        self._rate_hz, self._lag_s = rate_hz, stored.torque_lag_s or 0.0
        self._decimation = Decimation(factor=max(1, round(n_d / ratio)))
        self._cutoff_hz = cutoff_hz if (cutoff_hz or np.inf) < 0.5 * rate_hz else None
        self._ends = [
            0 if f is None else round(CUT_PERIODS * rate_hz / f)
            for f in (self._cutoff_hz, 0.4 * rate_hz / self._decimation.factor)
        ]
        self._rows: Block | None = None
        self._shown_ns = 0

    def add(self, rows: Block) -> tuple[Array, Array]:
        """Stamps (k,) in ns and residuals (k, n) that the new rows complete."""
        rate_hz, ends = self._rate_hz, self._ends
        rows = rows if self._rows is None else np.concatenate([self._rows, rows])
        gaps = np.flatnonzero(np.diff(rows["stamp_ns"]) * rate_hz > 1.5e9)
        rows = rows[gaps[-1] + 1 :] if len(gaps) else rows
        self._rows = rows[-3 * sum(ends) :]
        if len(rows) <= 2 * sum(ends):
            return np.zeros(0), np.zeros((0, len(self.band)))
        effort = self._gained.joint_effort(self._robot.motor_effort(rows["effort"]))
        tau = sampled_at(np.arange(float(len(effort))) + self._lag_s * rate_hz, effort)
        # The ends of the low-pass are cut off before they disturb the decimation, and those of the
        # decimation after it.
        motion = motion_between(
            rows["position"],
            tau,
            cutoff_hz=self._cutoff_hz,
            sample_rate_hz=rate_hz,
            start=ends[0],
            stop=len(rows) - ends[0],
        )
        rho = motion.tau - predicted_torque(motion, self._model, self._base, self._beta)
        at = self._decimation.instants(len(rho))
        stamps = rows["stamp_ns"][ends[0] + at]
        new = (at >= ends[1]) & (at < len(rho) - ends[1]) & (stamps > self._shown_ns)
        if new.any():
            self._shown_ns = int(stamps[new][-1])
        return stamps[new], self._decimation.filtered(rho.T).T[new]


class LivePage:
    """The live view.

    The state is on top, then come by joint following error, effort, position and residual, and then
    the events.
    """

    def __init__(self, recording: Any, robot: Robot, residual: Residual | None) -> None:
        self._recording, self._robot, self._residual = recording, robot, residual
        self._phase, self._left_from, self._losses = "begins", (0, 0.0), dict.fromkeys(_LOSSES, 0.0)
        self._first_ns = self._last_ns = 0
        self._target: Array | None = None  # of the last row
        self._laid_out: bool | None = None  # with the target
        self._warned, self.over = False, False
        self._levels = {
            "error": [_band("stop", RED, joint.si("following_error")) for joint in robot.joints],
            "effort": _effort_levels(robot),
            "position": [
                {}
                if (ends := joint.si("position")) is None
                else {"from": (RED, ends[0]), "to": (RED, ends[1])}
                for joint in robot.joints
            ],
            **(
                {}
                if residual is None
                else {"residual": [_band("band", ORANGE, half) for half in residual.band]}
            ),
        }

    def add(
        self, follower: RecordingFollower, *, stalled: bool, warn: Callable[[str], None]
    ) -> None:
        """Add what a `read` of the follower has found."""
        for event in follower.events:
            self._first_ns = self._first_ns or event.stamp_ns
            if event.kind == "phase":
                self._phase, self._left_from = event.text, (0, 0.0)
            elif event.kind == "plan":
                self._left_from = event.stamp_ns, float(event.text.split()[-2])
            self.over |= event.kind in ("end", "fault")
            time_s = 1e-9 * (event.stamp_ns - self._first_ns)
            self._recording.set_time("time", duration=time_s)
            self._recording.log(
                "events",
                rr.TextLog(
                    shown_text(f"{time_s:.2f} s {event.kind}: {event.text}"),
                    level="WARN" if event.kind in ("fault", "warning", "not disabled") else "INFO",
                ),
            )
        for health in follower.health:
            self._losses = {name: health.counters.get(name, 0.0) for name in _LOSSES}
            self._last_ns = max(self._last_ns, health.stamp_ns)
            if health.counters.get("sched_fifo") == 0.0 and not self._warned:
                self._warned = True
                warn(
                    "the session runs without SCHED_FIFO, so that a viewer on this machine may "
                    "delay it: use another machine"
                )
        if follower.rows is not None:
            self._add_rows(follower.rows)
        if self._laid_out != (self._target is not None):
            self._lay_out()
        self._show_state(follower.problem, stalled=stalled)

    def _add_rows(self, rows: Block) -> None:
        stamps, q = rows["stamp_ns"], rows["position"]
        self._first_ns, self._last_ns = (
            self._first_ns or int(stamps[0]),
            max(self._last_ns, int(stamps[-1])),
        )
        series: dict[str, tuple[Array, list[Array]]] = {
            "effort": (stamps, [rows["effort"]]),
            "position": (stamps, [q]),
        }
        if "reference" in (rows.dtype.names or ()):
            # As the guard: a drive reaches a target one period after it was sent.
            sent = rows["reference"]
            before = np.concatenate([sent[:1] if self._target is None else self._target, sent[:-1]])
            series |= {
                "error": (stamps, [q - before]),
                "position": (stamps, [sent, q]),
            }
            self._target = sent[-1:]
        if self._residual is not None:
            at, rho = self._residual.add(rows)
            series["residual"] = at, [rho]
        for name, (at, columns) in series.items():
            for j in range(self._robot.n if len(at) else 0):
                levels = [value for _, value in self._levels[name][j].values()]
                self._send(
                    f"{name}/{j + 1}/measured", at, np.stack([x[:, j] for x in columns], axis=1)
                )
                if levels:
                    self._send(f"{name}/{j + 1}/levels", at[[0, -1]], np.tile(levels, (2, 1)))

    def _send(self, path: str, stamps: Array, values: Array) -> None:
        self._recording.send_columns(
            path,
            indexes=[
                rr.TimeColumn("time", duration=(stamps - self._first_ns).astype("timedelta64[ns]"))
            ],
            columns=rr.Scalars.columns(scalars=values),
        )

    def _lay_out(self) -> None:
        rows = [
            rrb.Spatial2DView(
                origin="state",
                visual_bounds=rrb.VisualBounds2D(x_range=[0.0, 1400.0], y_range=[-14.0, 14.0]),
            )
        ]
        window = rrb.VisibleTimeRange(
            "time",
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-SHOWN_S),
            end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
        )
        for name, levels in self._levels.items():
            quantity, sign = ("q", "") if name == "position" else (name, "±")
            views = []
            for j, joint in enumerate(self._robot.joints):
                unit = (
                    self._robot.effort_units[j]
                    if name in ("effort", "residual")
                    else joint.position_unit
                )
                names, colors = (
                    (["target", name], [REFERENCE, LIGHT])
                    if name == "position" and self._target is not None
                    else ([name], [RESIDUAL if name == "residual" else LIGHT])
                )
                self._style(f"{name}/{j + 1}/measured", names, colors)
                self._style(
                    f"{name}/{j + 1}/levels",
                    list(levels[j]),
                    [color for color, _ in levels[j].values()],
                )
                told = [
                    f"{key} {sign}{value:.3g}"
                    for key, (_, value) in levels[j].items()
                    if key[0] != "-"
                ]
                views.append(
                    rrb.TimeSeriesView(
                        origin=f"{name}/{j + 1}",
                        # Of six joints each has 30 letters.
                        name=shown_text(f"{quantity} {joint.name} {', '.join(told)} [{unit}]"),
                        time_ranges=[window],
                        plot_legend=rrb.PlotLegend(visible=False),
                    )
                )
            rows.append(rrb.Horizontal(*views))
        rows.append(event_view("events", "events"))
        self._recording.send_blueprint(
            rrb.Blueprint(
                rrb.Vertical(
                    *rows, row_shares=[1.0, *(3.0 for _ in self._levels), 3.0], name="live"
                ),
                rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
                collapse_panels=True,
                auto_views=False,
            )
        )
        self._laid_out = self._target is not None

    def _style(self, path: str, names: list[str], colors: list[Color]) -> None:
        if names:
            # The band is drawn first, so that it does not hide the position.
            self._recording.log(
                path,
                rr.SeriesLines(
                    names=names,
                    colors=colors,
                    widths=[3.0 if one == "target" else 1.0 for one in names],
                    aggregation_policy="MinMax",
                ),
                static=True,
            )

    def _show_state(self, problem: str, *, stalled: bool) -> None:
        """Show the state, in red if the file has stopped growing in the session."""
        begin_ns, planned_s = self._left_from
        left_s = max(0.0, planned_s - 1e-9 * (self._last_ns - begin_ns))
        words = [
            *(
                ["THE FILE HAS STOPPED GROWING: these data are old"]
                if stalled and not self.over
                else []
            ),
            f"{self._phase}{f', {left_s:.0f} s left' if begin_ns else ''}",
            *(
                f"{name.replace('kernel_drops', 'dropped')} {count:g}"
                for name, count in self._losses.items()
            ),
            *([f"no rows: {problem}"] if problem else []),
        ]
        self._recording.log(
            "state/bar",
            rr.LineStrips2D(
                [[(0.0, -12.0), (1400.0, -12.0)]],
                colors=GREY if self.over else RED if stalled else GREEN,
                radii=rr.Radius.ui_points(4.0),
            ),
            static=True,
        )
        self._recording.log(
            "state/text",
            rr.Points2D(
                [(700.0, -9.0)],
                labels=shown_text("   |   ".join(words)),
                colors=LIGHT,
                radii=rr.Radius.ui_points(0.1),
                show_labels=True,
            ),
            static=True,
        )


def _effort_levels(robot: Robot) -> list[Lines]:
    """Return rated efforts of each joint, with all its motors at theirs, and its effort limit."""
    assert robot.bus is not None
    motors = np.array(
        [
            getattr(d, _RATED.get(m.recorded_unit, ""), None)
            for d, m in zip(robot.bus.drive, robot.motors, strict=True)
        ],
        dtype=float,
    )
    to_joint = np.abs(robot.R.T) * np.abs(robot.gain)
    # A motor without a value leaves the joints that it turns without one.
    unknown = (to_joint != 0) @ np.isnan(motors)
    rated, limits = to_joint @ np.nan_to_num(motors), effort_limits(robot)
    most = dict(zip(limits.names, limits.limits, strict=True))
    return [
        _band("rated", ORANGE, None if lacks else value)
        | _band("limit", RED, most.get(f"joint {joint.name}"))
        for joint, value, lacks in zip(robot.joints, rated, unknown, strict=True)
    ]


def _band(name: str, color: Color, half: float | None) -> Lines:
    return {} if half is None else {name: (color, half), f"-{name}": (color, -half)}
