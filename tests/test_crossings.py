"""Recordings with every optional column x load friction, own parameters, drive gains x two workers, long ones."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from gain_cases import CENTRE, robot_of, with_motors
from gain_cases import with_gains as described_with
from test_friction_terms import described, model_of

import identification
from acquisition.robot import Payload, Robot
from identification import validate
from identification.data import RecordingFile, Recordings, Signals, Work
from identification.methods import Fit, identify
from identification.regression import Overrides
from identification.regression.problem import row_blocks
from identification.study import Noise, closed_loop, random_reference, write_signals

RATE_HZ = 500.0
TRUE = np.array([2.0, 0.7])  # N m/A
WRONG = np.array([2.0, 0.9])  # as described where gains are identified
COLUMNS = ("velocity", "known_torque", "feedforward", "reference", "payload")
CONCERNS = ("load", "own", "gains")
CARRIED = Payload(1.0, CENTRE["scara"])
KNOWN = np.array([1.0, 0.05])  # N m, known torques
LONG_S = 10.0  # two blocks of rows
STATED = {
    "decimation": 5,
    "ramp_rows": 0.5,
    "torque_lag_s": 0.0,
}  # else long recordings take theirs from their beginnings


@cache
def arm(concerns: frozenset[str]) -> Robot:
    """The SCARA with its efforts in A, with load friction and own offsets if asked for; its law is not described."""
    optional = {"own": "offset", "load": "load"}
    terms = ["viscous", "coulomb", *(term for concern, term in optional.items() if concern in concerns)]
    more = ("mu1 = 0.3\nmu2 = 0.3\n" if "load" in concerns else "") + ("Off1 = 0.3\n" if "own" in concerns else "")
    text = described("scara", [terms, terms], more).files["robot.toml"].decode()
    law = ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "velocity_estimate")
    text = "\n".join(line for line in text.splitlines() if not line.startswith(law))
    text = text[: text.index("[bus]")] + text[text.index("[parameters]") :]
    own = '[identification]\nown = ["Off"]\n' if "own" in concerns else ""
    return robot_of(with_motors(f"{text}\n{own}", "N m/A", TRUE))


@cache
def simulated(concerns: frozenset[str], seed: int, payload: Payload | None, duration_s: float = 4.0) -> Signals:
    robot = arm(concerns)
    q = random_reference(robot, duration_s=duration_s, sample_rate_hz=RATE_HZ, seed=seed)
    return closed_loop(
        robot, q, RATE_HZ, noise=Noise(encoder_step=1e-6, effort_percent=2.0), seed=seed, payload=payload
    )


def recorded(concerns: frozenset[str], columns: frozenset[str], seed: int, duration_s: float = 4.0) -> Signals:
    """A recording with these columns; the second one carries the payload."""
    signals = simulated(concerns, seed, CARRIED if "payload" in columns and seed == 2 else None, duration_s)
    t_s = signals.t_s[:, None]
    given = {}
    if "velocity" in columns:
        given["velocity"] = np.gradient(signals.q, signals.t_s, axis=0)
    if "known_torque" in columns:  # a part of what the robot needs is from elsewhere
        given["known_torque"] = KNOWN * np.sin(7 * t_s)
        given["effort"] = signals.effort - given["known_torque"]
    if "feedforward" in columns:
        given["feedforward"] = 0.02 * KNOWN * np.sin(5 * t_s)
    reference = signals.q_ref if "reference" in columns else None
    signals = replace(signals, q_ref=reference, recording=f"r{seed}.mcap", **given)
    return described_with(signals, WRONG, None) if "gains" in concerns else signals


def written(folder: Path, concerns: frozenset[str], columns: frozenset[str], duration_s: float = 4.0) -> list[Path]:
    paths = [folder / f"r{seed}.mcap" for seed in (1, 2)]
    for seed, path in enumerate(paths, 1):
        write_signals(path, recorded(concerns, columns, seed, duration_s), source="test")
    return paths


def fitted(paths: list[Path], concerns: frozenset[str], work: Work, **settings: float) -> Fit:
    overrides = Overrides(gains=("motor_2",) if "gains" in concerns else None, **settings)
    return identify(Recordings(sources=tuple(map(RecordingFile.at, paths)), work=work), overrides)


def as_long(fit: Callable[[], Fit]) -> Fit:
    """`fit` where rows are QR factors of spans, come block by block, and no more than a beginning of the recordings is held."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("identification.regression.equations._MAX_NUMBERS", 100)
        patch.setattr("identification.regression.problem._SERIES_BLOCK", 20_000)
        patch.setattr("identification.methods.equations.SPAN_S", 5.0)
        found = fit()
        assert all(len(row_blocks(one.problem)) > 1 for one in found.recordings)
    return found


def bits(fit: Fit) -> list[bytes]:
    arrays = fit.estimate.beta, fit.intervals.covariance, fit.tau_predicted
    return [x.tobytes() for x in arrays] + [repr(fit.trust.lines).encode()]


def off(fit: Fit) -> np.ndarray:
    """Distances from the truth in half-widths."""
    truth = dict(zip(fit.base.names, model_of(fit.problem.signals.robot)[2], strict=True))
    true = np.array([truth[name.partition("@")[0]] for name in fit.estimate.names])
    return np.abs(fit.estimate.beta - true) / fit.intervals.half


@pytest.mark.parametrize("columns", [*COLUMNS, "all"])
@pytest.mark.parametrize("concerns", ["plain", *CONCERNS, "all"])
def test_two_recordings_are_fitted_with_what_they_have(concerns, columns, tmp_path):
    concerns = frozenset({"all": CONCERNS, "plain": ()}.get(concerns, (concerns,)))
    columns = frozenset(COLUMNS if columns == "all" else (columns,))
    paths = written(tmp_path, concerns, columns)
    fit = fitted(paths, concerns, Work())
    assert bits(fitted(paths, concerns, Work(2))) == bits(fit)
    assert fit.status == ("converged" if "reference" in columns else "solved")
    assert fit.iv is None or (
        fit.iv.controller == "found" and all(one.problem.law.reason is None for one in fit.recordings)
    )
    assert (off(fit) < 1.5).all()
    assert (fit.own is not None) == bool({"own", "gains"} & concerns)
    assert (fit.gains is not None) == ("gains" in concerns)
    if fit.gains:
        assert abs(fit.gains.values[0] - TRUE[1]) < 2 * fit.gains.half[0] < 0.25
    # The mean of own parameters is validated, and load friction where the fit has it linearised.
    tolerance = 0.06 if "gains" in concerns else 0.02 if "own" in concerns else 1e-4 if "load" in concerns else 1e-9
    for one, path in zip(fit.recordings, paths, strict=True):
        again = validate(identification.Fit(**vars(fit)), path)
        assert again.relative_error_percent == pytest.approx(one.errors[-1].relative_error_percent, rel=tolerance)
        assert again.warnings == []


@pytest.mark.parametrize(
    ("concerns", "columns", "workers"),
    [
        ("gains", "reference payload", 1),
        ("own", "payload", 1),
        ("load gains", "reference payload", 2),
    ],
)
def test_long_recordings_are_fitted_as_held_ones(concerns, columns, workers, tmp_path):
    concerns, columns = frozenset(concerns.split()), frozenset(columns.split())
    paths = written(tmp_path, concerns, columns, LONG_S)
    held = fitted(paths, concerns, Work(), **STATED)
    fit = as_long(lambda: fitted(paths, concerns, Work(workers), **STATED))
    assert (fit.estimate.names, fit.status, fit.distrust) == (held.estimate.names, held.status, held.distrust)
    assert (np.abs(fit.estimate.beta - held.estimate.beta) < 0.1 * held.intervals.half).all()
    np.testing.assert_allclose(fit.intervals.half, held.intervals.half, rtol=0.1)
    assert (off(fit) < 1.5).all()
    if fit.gains:
        assert abs(fit.gains.values[0] - TRUE[1]) < 2 * fit.gains.half[0] < 0.1


@pytest.mark.parametrize("method", ["wls", "iv"])
@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_all_of_a_long_recording_is_tested(method, drift):
    """A torque that drifts from the middle on, by a share of its rms: nothing of it is in the beginning."""
    signals = recorded(frozenset(), frozenset({"reference"}), 1, LONG_S)
    ramp = np.maximum(0.0, 2 * signals.t_s / signals.t_s[-1] - 1)[:, None] * [1.0, 0.0]
    signals = replace(signals, effort=signals.effort + drift * np.sqrt(np.mean(signals.effort**2, axis=0)) * ramp)

    def run() -> Fit:
        return identify(signals, Overrides(**STATED), method=method)

    held, fit = run(), as_long(run)
    one, other = (x.trust.line("added columns") for x in (fit, held))
    assert (one.level, one.finding, one.value) == (other.level, other.finding, pytest.approx(other.value, rel=0.02))
    assert fit.trust.line("added columns").finding == ("drift of joint shoulder" if drift else "")
