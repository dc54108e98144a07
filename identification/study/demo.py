"""The demo's session: simulated drives move a simulated robot, and a recording is made.

Simulated CiA 402 drives on an in-process CAN bus move the rigid robot in simulated
time. This is the only place where `identification` gives an object to `acquisition`:
the plant that the drives move.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acquisition.bus import Master
from acquisition.errors import Location
from acquisition.files import atomic_write
from acquisition.robot import Payload, Robot, resolve, robot_from_files
from acquisition.session import InlineLog, Recorder, Stop, Task, run_active
from acquisition.simulated import (
    SUBSTEPS,
    DrivenPlant,
    LockStepLink,
    SimulatedDrives,
    describe_loops,
)

from ..arrays import Array
from ..model import inertias
from ..report import Document, Number, Row, Section, Table, columns, value_form
from ..results import Evidence
from ..simulation import RigidBodyPlant, drive_loops
from .simulated_cell import periodic_reference, true_model

DURATION_S, SEED = 12.0, 1  # of the session; of reference and noise
CATALOGUE = (0.32, 0.32, 0.40, 0.33, 0.30, 0.32)  # gains by motor, N m/A
TRUE_FACTORS = (1.25, 0.88, 1.40, 0.70, 1.15, 0.80)  # of the simulated drives
RATED_NM_PER_A = 0.3  # of all motors, to make rated currents
PAYLOAD = Payload(2.0, (0.03, 0.02, 0.08))


def record_simulated_session(
    robot: Robot,
    place: str,
    out: Path,
    *,
    noise_percent: float = 3.0,
    payload: Payload | None = None,
    described: Robot | None = None,
) -> None:
    """Record a session: simulated drives track a random exciting reference with the
    robot of `[parameters]`.

    `noise_percent` is the noise of the torque, of each joint's rms. The drives are those of
    `robot`; the recording has `described`, by default the same. Raises `BadInputError`: a
    description without `[bus]` or values, a failed session.
    """
    period_s = (
        Location(place).given(robot.bus, "[bus]", None, "the drives to simulate").sync_period_s
    )
    model, described = true_model(robot), described or robot
    t_s: Array = np.arange(round(DURATION_S / period_s) + 1, dtype=np.float64) * period_s
    q_ref, dq_ref, ddq_ref = periodic_reference(robot, duration_s=DURATION_S, seed=SEED).at(t_s)
    rms = np.sqrt(np.mean(model.torque(q_ref, dq_ref, ddq_ref) ** 2, axis=0))
    mechanism = DrivenPlant(
        plant=RigidBodyPlant(
            true_model(robot, payload),
            q_ref[0],
            speed_scale=np.abs(dq_ref).max(axis=0),
            step_s=period_s / SUBSTEPS,
            disturbance=0.01 * noise_percent * rms,
            seed=SEED if payload is None else SEED + 1,
        ),
        loops=drive_loops(robot, inertias(model.inertia(q_ref[::50]))),
    )
    bus = resolve(robot, place)
    log = InlineLog(
        Recorder(
            out,
            describe_loops(described, mechanism.loops),
            source="simulated drives with the rigid robot of [parameters]",
            place=place,
            payload=payload,
        )
    )
    simulated = LockStepLink(SimulatedDrives(robot, bus, mechanism), tap=log.tap)
    try:
        outcome = run_active(
            described, Master(simulated, bus), log, Task(reference=q_ref, place="reference"), Stop()
        )
        log.finish(simulated.now_ns())
    finally:
        log.close()
    Location(str(out)).require(
        not outcome.fault, text=f"the simulated session failed: {outcome.reason}"
    )


def description(name: str) -> Path:
    """The description of a robot of this project: `scara` or `tx40`."""
    installed = Path(__file__).parents[1] / "robots" / name / "robot.toml"
    return (
        installed
        if installed.exists()
        else Path(__file__).parents[2] / "replay_data" / name / "robot.toml"
    )


def record_gain_pair(robot: Robot, place: str, paths: tuple[Path, Path]) -> list[float]:
    """Record sessions without and with the payload, of drives whose gains are not those described;
    returns the true ones.
    """
    described = CATALOGUE[: robot.n]
    true = [gain * factor for gain, factor in zip(described, TRUE_FACTORS, strict=False)]
    drives, stated = in_amperes(robot, true), in_amperes(robot, described)
    for path, payload in zip(paths, (None, PAYLOAD), strict=True):
        with atomic_write(path) as recording:
            record_simulated_session(drives, place, recording, payload=payload, described=stated)
    return true


def in_amperes(robot: Robot, gains: Sequence[float]) -> Robot:
    """A robot of this project whose drives report their current, with these gains in N m/A."""
    each = iter(gains)
    text = re.sub(
        "effort_unit = .*",
        lambda _: f'drive_gain = {next(each):.4g}\ndrive_gain_unit = "N m/A"',
        robot.files["robot.toml"].decode(),
    )
    text = re.sub('reference = "6074"|actual = "6077"', 'actual = "6078"', text)
    text = re.sub(
        r"rated_torque_nm = ([\d.]+)",
        lambda found: f"rated_current_a = {float(found[1]) / RATED_NM_PER_A:.4g}",
        text,
    )
    return robot_from_files({**robot.files, "robot.toml": text.encode()}, f"{robot.name} in A")


def truth_document(robot: str, fits: Sequence[Evidence], true: Array) -> Document:
    """Estimates, half-widths of their 95 % intervals, and errors in these, next to the true values
    of a simulated recording.
    """
    halves = [fit.intervals.half for fit in fits]
    rows: list[Row] = []
    for i, name in enumerate(fits[0].base.names):
        form = value_form(float(min(half[i] for half in halves)) / 2)
        cells = (
            cell
            for fit, half in zip(fits, halves, strict=True)
            for cell in (
                Number(float(fit.beta[i]), form),
                Number(float(half[i]), form),
                Number(float((fit.beta[i] - true[i]) / half[i]) if half[i] > 0 else None, "+.2f"),
            )
        )
        rows.append((name, Number(float(true[i]), form), *cells))
    headings = (heading for fit in fits for heading in (fit.method, "±95%", "error /\n±95%"))
    section = Section(
        title="compared with the simulated values",
        table=Table(columns=columns("parameter", numbers=("true", *headings)), rows=tuple(rows)),
        lines=tuple(
            f"{fit.method}: {(np.abs(fit.beta - true) <= half).sum()} of {len(true)} true values "
            f"inside ({0.95 * len(true):.0f} expected); total error "
            f"{100 * np.linalg.norm(fit.beta - true) / np.linalg.norm(true):.2f} %"
            for fit, half in zip(fits, halves, strict=True)
        ),
    )
    largest = np.lexsort(
        (-np.abs(true), ~np.isin(fits[-1].base.names, fits[-1].essential_names))
    ).tolist()
    return Document(
        title=f"{robot}: {len(true)} estimated parameters and their true values",
        sections=(section.with_short_table(largest),),
    )


def gains_document(fit: Evidence, true: Sequence[float]) -> Document:
    """Identified drive gains beside those described and the true ones, each with
    its error in half-widths.
    """
    rows, off = list[Row](), [x.value - y for x, y in zip(fit.gains, true, strict=True)]
    within = sum(abs(x) <= one.half_width for x, one in zip(off, fit.gains, strict=True))
    for one, of_drive, x in zip(fit.gains, true, off, strict=True):
        form, numbers = value_form(one.half_width / 2), (one.described, of_drive, one.value)
        values = (Number(number, form) for number in (*numbers, one.half_width))
        rows.append((one.motor, *values, Number(x / one.half_width, "+.2f"), one.unit))
    lines = (
        f"{within} of {len(true)} true values inside; verdict of the fit: {fit.trust.verdict}",
        f"loaded: {fit.recordings[-1].signals.payload}",
    )
    table = Table(
        columns=columns(
            "motor", numbers=("catalogue", "true", "identified", "±95%", "error /\n±95%")
        )
        + columns("unit"),
        rows=tuple(rows),
    )
    return Document(
        title=f"drive gains of {', '.join(one.signals.recording for one in fit.recordings)}",
        sections=(Section(table=table, lines=lines),),
    )
