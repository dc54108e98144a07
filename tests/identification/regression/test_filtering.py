"""The filters against mathematics: gains at stated frequencies, derivatives of sines, no delay."""

import numpy as np
import pytest
from scipy import interpolate, signal

from identification.errors import BadInputError, NoFitError
from identification.regression import (
    Decimation,
    Motion,
    forward_backward_3db_hz,
    sampled_at,
    smooth,
)
from identification.regression.filtering import (
    decimation_passes,
    decimation_reach,
    lowpass,
    lowpass_reach,
)
from identification.regression.motion import motion_between

FS = 1000.0
T = np.arange(8000) / FS


@pytest.mark.parametrize("cutoff_hz", [10.0, 400.0])
def test_zero_phase_cutoff_at_minus_3_db(cutoff_hz):
    f_hz = forward_backward_3db_hz(cutoff_hz, FS)
    y = lowpass(np.sin(2 * np.pi * f_hz * T)[:, None], cutoff_hz, FS)[2000:6000, 0]
    assert 10 * np.log10(2 * np.mean(y**2)) == pytest.approx(-3.01, abs=0.02)


def test_derivatives_of_sines_for_every_joint():
    w = 2 * np.pi * np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0])
    q = np.sin(np.outer(T, w))
    motion = motion_between(q, q, cutoff_hz=200.0, sample_rate_hz=FS, start=100, stop=7900)
    t = T[100:7900, None]
    np.testing.assert_allclose(motion.dq, w * np.cos(t * w), atol=2e-4 * w.max())
    np.testing.assert_allclose(motion.ddq, -(w**2) * np.sin(t * w), atol=5e-4 * w.max() ** 2)


@pytest.mark.parametrize(
    ("factor", "passes"), [(1, ()), (13, (13,)), (20, (4, 5)), (17, (17,)), (1000, (10, 10, 10))]
)
def test_large_decimations_in_stages(factor, passes):
    assert sorted(decimation_passes(factor)) == list(passes)


def test_partial_motion_matches_whole():
    rng = np.random.default_rng(0)
    q = np.cumsum(rng.normal(size=(6000, 2)), axis=0)
    tau = rng.normal(size=(6000, 2))
    whole = motion_between(q, tau, cutoff_hz=20.0, sample_rate_hz=FS, start=0, stop=6000)
    part = motion_between(q, tau, cutoff_hz=20.0, sample_rate_hz=FS, start=2500, stop=3100)
    for name in ("q", "dq", "ddq", "tau"):
        expected = getattr(whole, name)[2500:3100]
        np.testing.assert_allclose(
            getattr(part, name), expected, atol=1e-9 * np.abs(expected).max()
        )


def test_bad_cutoffs_and_few_samples_refused():
    with pytest.raises(BadInputError) as told:
        lowpass(np.zeros((100, 1)), 600.0, FS)
    assert (told.value.key, told.value.value) == ("cut-off", 600.0)
    for filtered in (
        lambda: lowpass(np.zeros((12, 1)), 20.0, FS),
        lambda: Decimation(factor=10).filtered(np.zeros(24)),
    ):
        with pytest.raises(NoFitError):
            filtered()


@pytest.mark.parametrize(("samples", "factor"), [(7366, 2), (9001, 10), (9009, 7), (5003, 17)])
def test_decimation_matches_scipy_both_ways(samples, factor):
    """By scipy's filters, over the ends extended here as far as their ringing reaches."""
    x = np.random.default_rng(0).standard_normal((3, samples)).cumsum(axis=1)
    near = 6 * factor
    found = Decimation(factor=factor).filtered(x)
    # The value of the line at the end sample.
    first, last = (
        np.polyfit(np.arange(near), y.T, 1)[1][:, None]
        for y in (x[:, :near], x[:, : -near - 1 : -1])
    )
    extended = np.concatenate([2 * first - x[:, :0:-1], x, 2 * last - x[:, -2::-1]], axis=1)
    sos = signal.cheby1(8, 0.05, 0.8 / factor, output="sos")
    expected = signal.sosfiltfilt(sos, extended, axis=-1)[:, samples - 1 : 2 * samples - 1]
    np.testing.assert_allclose(
        found, expected[:, (samples - 1) % factor :: factor], atol=1e-10 * np.abs(x).max()
    )


@pytest.mark.parametrize("cutoff_hz", [10.0, 400.0])
def test_low_pass_matches_scipy_both_ways(cutoff_hz):
    x = np.random.default_rng(0).standard_normal((9000, 3)).cumsum(axis=0)
    expected = signal.sosfiltfilt(
        signal.butter(4, cutoff_hz, fs=FS, output="sos"), x, axis=0, padlen=12
    )
    np.testing.assert_allclose(lowpass(x, cutoff_hz, FS), expected, atol=1e-11 * np.abs(x).max())


@pytest.mark.parametrize(("samples", "factor"), [(400, 2), (1003, 10), (2000, 13)])
def test_matlab_edge_decimation_is_filtfilt(samples, factor):
    x = np.random.default_rng(0).standard_normal((3, samples)).cumsum(axis=1)
    expected = signal.sosfiltfilt(signal.cheby1(8, 0.05, 0.8 / factor, output="sos"), x, padlen=24)
    found = Decimation(factor=factor, smooth_ends=False).filtered(x)
    np.testing.assert_allclose(
        found, expected[:, (samples - 1) % factor :: factor], atol=1e-11 * np.abs(x).max()
    )


def test_filter_support_follows_slowest_pole():
    for found, zpk in (
        (lowpass_reach(50.0, FS), signal.butter(4, 50.0, fs=FS, output="zpk")),
        (decimation_reach(10), signal.cheby1(8, 0.05, 0.08, output="zpk")),
    ):
        assert np.abs(zpk[1]).max() ** found <= 1e-14 < np.abs(zpk[1]).max() ** (found - 2)


@pytest.mark.parametrize("samples", [40000, 40007])
def test_tenth_samples_decimate_alike(samples):
    decimation, rate_hz = Decimation(factor=100), 5000.0
    x = lowpass(np.random.default_rng(1).normal(size=(samples, 3)), 50.0, rate_hz).T
    stride = decimation.stride_behind(50.0, rate_hz)
    assert stride == 10
    at, end = (samples - 1) % stride, decimation.end_samples
    strided = decimation.filtered_strided(x[:, at::stride], x[:, : at + end + 1], x[:, -end - 1 :])
    # the ends too
    np.testing.assert_allclose(strided, decimation.filtered(x), atol=1e-6 * np.abs(x).max())


def test_no_skipping_where_noise_would_alias():
    for decimation, cutoff_hz in (
        (Decimation(factor=100), None),
        (Decimation(factor=100), 400.0),
        (Decimation(factor=8), 5.0),  # one pass
        (Decimation(factor=100, smooth_ends=False), 50.0),
    ):
        assert decimation.stride_behind(cutoff_hz, 5000.0) == 1


@pytest.mark.parametrize("by", [0.25, -0.7, 1.5])
def test_upsampling_matches_cubic_spline(by):
    x, at = np.random.default_rng(2).normal(size=(300, 2)).cumsum(axis=0), np.arange(300) + by
    np.testing.assert_allclose(
        sampled_at(at, x)[40:-40],
        interpolate.CubicSpline(np.arange(300), x)(at)[40:-40],
        atol=1e-12,
    )
    sine = np.sin(2 * np.pi * T[:, None] / 0.05)  # at the ends too: 50 samples a period
    off = sampled_at(np.arange(len(T)) + by, sine)[:, 0] - np.sin(2 * np.pi * (T + by / FS) / 0.05)
    of_few = sampled_at(np.arange(3) + 1e-5, x[:3]) - x[:3]  # through each of them
    assert max(np.abs(off)[2:-2].max(), np.abs(of_few).max()) < 1e-3


@pytest.mark.parametrize("samples", [3, 1000, 1007])
def test_smooth_motion_computed_at_strides(samples):
    t_s, asked = np.arange(samples) / 1000, []
    q = np.sin(2 * np.pi * 5 * t_s)[:, None] * [1.0, 2.0]
    motion = Motion(t_s=t_s, q=q, dq=q, ddq=q, tau=q)

    def twice(q, dq, ddq):
        asked.append(len(q))
        return np.stack([q + dq, ddq], axis=2)

    found, exact = smooth(twice, motion, 5), twice(q, q, q)
    assert asked[0] <= samples / 5 + 5
    np.testing.assert_allclose(found, exact, atol=1e-3)  # at an end the spline is straight
    np.testing.assert_allclose(found[20:-20], exact[20:-20], atol=2e-5)
