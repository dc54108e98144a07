"""Uneven times after `resample_hz`: the estimates of 100 runs inside their 95 % intervals."""

from jittered_time import covered


def test_uneven_times_keep_interval_coverage(tmp_path):
    found = covered(tmp_path, 100)
    by_parameter = 100 * found.inside.mean(axis=0)
    print(
        f"\n{100 * found.inside.mean():.1f} % of 100 runs x {found.inside.shape[1]} parameters "
        f"inside; {by_parameter}"
    )
    assert found.inside.mean() >= 0.93
    assert by_parameter.min() >= 88
