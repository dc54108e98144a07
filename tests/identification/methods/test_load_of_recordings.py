"""Load friction of several recordings: cut, long, left out, told by the trust block."""

import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest
from described_truth import off
from friction_models import axis, described, moved, simulated

from identification.data import Recordings
from identification.regression import (
    Overrides,
    equation_alone,
    make_problem,
    torque_of_recording,
)
from identification.results import identify, identify_ls, with_consistent
from identification.study import Noise

TERMS = [
    ["viscous", "coulomb", "offset", "root", "load"],
    ["viscous", "coulomb", "offset", "load"],
]
CELL = Noise(encoder_step=1e-6, effort_percent=2.0)
VALUES = "Fr1 = 0.6\nmu1 = 0.3\nmu2 = 0.3\nOff1 = 0.3\n"


@cache
def scara(own: str):
    """The SCARA with load friction of both joints, and two recordings of it; offsets
    are shared or of each.
    """
    robot = described("scara", TERMS, VALUES)
    # The simulated mean has no lag; stated, sums by hand need not look for one.
    robot = dataclasses.replace(
        robot, identification=msgspec.structs.replace(robot.identification, torque_lag_s=0.0)
    )
    if own:
        robot = dataclasses.replace(
            robot, identification=msgspec.structs.replace(robot.identification, own=(own,))
        )
        return robot, Recordings(
            sources=tuple(dataclasses.replace(one, robot=robot) for one in scara("")[1].sources)
        )
    return robot, simulated(robot, 3, 4)


@cache
def fit_of(method: str, own: str):
    return identify(scara(own)[1], Overrides(), method=method)


@pytest.mark.parametrize(("method", "own"), [("wls", ""), ("iv", "Off")])
def test_truth_in_intervals_without_warnings(method, own):
    fit = fit_of(method, own)
    assert fit.status == ("converged" if method == "iv" else "solved")
    assert {"mu1", "mu2"} < set(fit.estimate.names)
    assert ("Off1@r3" in fit.estimate.names) == bool(own)
    found = off(fit)
    assert (found < 1).sum() >= len(found) - 2
    assert found.max() < 2.5
    assert fit.intervals.half[fit.estimate.names.index("mu1")] < 0.05
    levels = {line.test: line.level for line in fit.trust.lines}
    assert set(levels.values()) <= {"ok", "inconclusive", "skipped"}, levels
    assert levels["physical plausibility"] == levels["cross-validation"] == "ok"


def test_consistent_parameters_use_same_terms():
    made = with_consistent(fit_of("wls", ""))
    assert {"mu1", "mu2"} < {p.name for p in made.standard_parameters}
    assert made.consistent_set.relative_error_percent == pytest.approx(
        made.errors[-1].relative_error_percent, rel=0.05
    )


def test_held_out_predicted_by_others():
    """Its load friction is linearised about the fit of all: nearly the error of a fit that
    knows the others alone.
    """
    sources, fit = scara("")[1].sources, fit_of("wls", "")
    same = Overrides(ramp_rows=fit.settings.ramp_rows)
    others = identify_ls(Recordings(sources=sources[1:]), same)
    problem = make_problem(sources[0], Overrides()).for_errors
    ((held_out, _, trained),) = (
        of
        for name, *of in fit.trust.line("cross-validation").figures
        if name == sources[0].recording
    )
    for beta, told, within in (
        (others.beta, held_out, 0.02),
        (fit.beta, trained, 1e-3),
    ):
        tau, (predicted,), of, *_ = torque_of_recording(*equation_alone(problem), [beta])
        error = 100 * np.linalg.norm((tau - predicted)[of]) / np.linalg.norm(tau[of])
        assert told == pytest.approx(error, rel=within)


def test_negative_load_friction_found_in_loaded_rows():
    """Coulomb friction of 20 N against 0.3 of the weight: in the recording of a fast motion,
    whose load is the largest.
    """
    robot = axis(["viscous", "coulomb", "load"], vertical=True, Fv=10.0, Fc=20.0, mu=-0.3)
    fit = identify_ls(moved(robot, 2, 3), Overrides(torque_lag_s="none", edges="smooth"))
    line = fit.trust.line("physical plausibility")
    assert line.level == "do not use"
    assert "friction would drive joint axis at " in line.text
    resists, load = float(line.text.split("/s: ")[1].split(" ")[0]), 0.3 * 95.0 * 9.81
    assert resists < -0.5 * load + 20.0  # with the links' torque there; 20 N and more without
