"""What a study draws and counts: verdicts against the truth, coverage of intervals, runs without unmodelled effects."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import robot_named

from identification.study import FALSE_TRUST, INSIDE, Noise, Run, RunFit, RunSettings, Study, false_trust, summaries
from identification.study import study as study_module
from identification.study.study import draw, one_run, robot_given_to_fit

TRUE = np.array([1.0, 2.0])
NAN = np.full(2, np.nan)
QUIET = Noise()


def fit_of_run(off: tuple[float, float], verdict: str = "trust", **others: object) -> RunFit:
    """Of intervals with half-widths of 0.1, off the truth by so many of them."""
    middle = TRUE + 0.1 * np.array(off)
    known = {"doubts": (), "essential": np.array([True, False]), "positive": True}
    known |= {"beta": TRUE, "sigma": NAN, "error": 0.1, "low": middle - 0.1, "high": middle + 0.1, **others}
    return RunFit(verdict=verdict, **known)


def run(one: RunFit, noise: Noise = QUIET, gain_error: float = 1.0) -> Run:
    drawn = RunSettings(cutoff=5.0, start=1.0, gain_error=gain_error, seed=1, controller="described", noise=noise)
    return Run(number=0, drawn=drawn, status="converged", error_tuned_ls=0.1, iv=one)


@pytest.mark.parametrize(
    ("one", "wrong"),
    [
        (fit_of_run((FALSE_TRUST - 0.1, 9.0)), False),  # the second is not essential
        (fit_of_run((FALSE_TRUST + 0.1, 0.0)), True),
        (fit_of_run((-FALSE_TRUST - 0.1, 0.0)), True),
        (fit_of_run((FALSE_TRUST + 0.1, 0.0), verdict="caution"), False),
        (fit_of_run((FALSE_TRUST + 0.1, 0.0), verdict="do not use"), False),
        (fit_of_run((0.0, 0.0), positive=False), True),
        (fit_of_run((0.0, 0.0), positive=False, verdict="caution"), False),
    ],
)
def test_false_trust_is_trust_in_what_is_far_off_or_no_robot(one, wrong):
    assert false_trust(one, TRUE) == wrong
    other = run(fit_of_run((0.0, 0.0), beta=1.1 * TRUE))
    iv = summaries([run(one), other], TRUE)[1]
    assert (iv.verdicts, iv.false_trust) == (2, int(wrong))
    assert iv.trusted == 1 + (one.verdict == "trust")


def test_false_caution_is_that_of_clean_runs_alone():
    doubted = fit_of_run((INSIDE - 0.1, 9.0), verdict="caution", doubts=("halves",))
    capped = fit_of_run((0.0, 0.0), verdict="caution")  # a test that was not made: no doubt
    for one, clean, false in (
        (run(doubted), 1, 1),
        (run(capped), 1, 0),
        (run(fit_of_run((INSIDE + 0.1, 0.0), verdict="caution", doubts=("halves",))), 0, 0),
        (run(doubted, gain_error=1.3), 0, 0),
        (run(doubted, noise=Noise(encoder_step=1e-5, coloured_percent=2.0)), 1, 1),
        *((run(doubted, noise=Noise(**{name: 1})), 0, 0) for name in
          ("lag_samples", "stribeck_percent", "asymmetry_percent", "integral_hz")),
    ):  # fmt: skip
        iv = summaries([one], TRUE)[1]
        assert (iv.clean, iv.false_caution) == (clean, false)


def test_coverage_counts_all_parameters_of_the_printed_intervals():
    offs = {-1: (0.5, -0.9), 0: (1.1, 0.0), 1: (0.0, -2.0)}
    runs = [run(fit_of_run(off, beta=TRUE + k * np.array([0.1, 0.2]))) for k, off in offs.items()]
    iv = summaries(runs, TRUE)[1]
    assert iv.coverage_percent == pytest.approx(100 * 4 / 6)
    assert iv.half_over_spread == pytest.approx(np.median([0.1 / (1.96 * 0.1), 0.1 / (1.96 * 0.2)]))


def test_a_run_draws_the_same_each_time_and_everything_where_it_is_asked_to():
    study = Study(noise=Noise(encoder_step=1e-5), vary="everything")
    drawn = [draw(study, k, 5.0) for k in range(200)]
    assert drawn == [draw(study, k, 5.0) for k in range(200)]
    assert {one.controller for one in drawn} == {"described", "none"}
    assert {one.noise.recorded for one in drawn} == {"mean", "tick"}
    told = [one.noise.modelled for one in drawn]
    assert 0.4 < np.mean(told) < 0.7
    for name in ("position", "effort_percent", "coloured_percent", "disturbance_percent"):
        assert 0.3 < np.mean([getattr(one.noise, name) > 0 for one in drawn]) < 0.7, name
    for name in ("lag_samples", "stribeck_percent", "asymmetry_percent", "integral_hz"):
        assert 0.1 < np.mean([getattr(one.noise, name) > 0 for one in drawn]) < 0.4, name
    plain = draw(Study(noise=study.noise), 3, 5.0)
    assert (plain.noise, plain.controller) == (study.noise, "described")
    assert (plain.cutoff, plain.start, plain.seed) == (drawn[3].cutoff, drawn[3].start, drawn[3].seed)


def test_what_the_fit_is_told_of_the_controller():
    robot = robot_named("emps")
    drawn = RunSettings(cutoff=5.0, start=1.0, gain_error=0.5, seed=1, controller="described", noise=Noise())
    assert robot_given_to_fit(robot, drawn).controller.velocity_gain == (0.5 * 243.45,)
    assert robot_given_to_fit(robot, drawn).controller.position_gain == (160.18,)  # a rate, of a cascade
    nothing = robot_given_to_fit(robot, replace(drawn, controller="none")).controller
    assert (nothing.structure, nothing.bandwidth_hz) == (None, 10.0)


def test_a_run_has_the_intervals_and_verdicts_of_its_fits():
    study = Study(cutoffs=(5.0,), gain_errors=(1.0,), noise=Noise(effort_percent=1.0), duration_s=4.0)
    found = one_run(robot_named("scara").files, study, 1)
    assert found.drawn.modelled
    for one in (found.ls, found.iv):
        np.testing.assert_allclose(0.5 * (one.low + one.high), one.beta)
        assert (one.high > one.low).all()
        assert one.positive
        assert one.essential.any()
        assert one.verdict in ("trust", "caution", "do not use")
        assert (one.verdict == "trust") <= (one.doubts == ())


def test_the_fits_are_told_the_wrong_gains(monkeypatch):
    told = []

    def spy(kind):
        def fitted(signals, *rest, **options):
            told.append(signals.robot.controller.velocity_gain)
            return kind(signals, *rest, **options)

        return fitted

    for name in ("identify_ls", "identify_iv"):
        monkeypatch.setattr(study_module, name, spy(getattr(study_module, name)))
    one_run(robot_named("scara").files, Study(cutoffs=(5.0,), gain_errors=(2.0,), duration_s=2.0), 0)
    assert told == [(380.0, 6.2), (380.0, 6.2)]
