"""What a caller reads from an error: the file or the place in it, the key, the value,
and what was expected.
"""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import REPLAY
from made_up_buses import bus_text, robot_of

from acquisition.errors import BadInputError, RobotIdimError
from acquisition.robot import load_robot
from identification import fit
from identification.data import load_signals


def data_of(caught):
    error = caught.value
    return error.place, error.key, error.value, error.expected


@pytest.mark.parametrize(
    ("key", "most"),
    [
        ("bus.heartbeat_s", 1.0),
        ("bus.late_sync_s", 1.0),
        ("bus.enable_motion_deg", 10.0),
        ("joint[0].following_error_deg", 30.0),
        ("joint[0].speed_deg_s", 3000.0),
    ],
)
def test_ineffective_guard_is_refused(tmp_path: Path, key, most):
    """Refused where robot.toml is read; a recording made with it still opens."""
    table, name = key.split(".")
    lines = [line for line in bus_text(1).splitlines() if not line.startswith(f"{name} =")]
    at = lines.index("[bus]" if table == "bus" else "[[joint]]") + 1

    def with_value(value: float) -> str:
        return "\n".join([*lines[:at], f"{name} = {value}", *lines[at:]])

    path = tmp_path / "robot.toml"
    path.write_text(with_value(most))
    load_robot(path)
    path.write_text(with_value(1.001 * most))
    with pytest.raises(BadInputError) as caught:
        load_robot(path)
    assert data_of(caught) == (str(path), key, pytest.approx(1.001 * most), f"at most {most:g}")
    robot_of(with_value(1e9 if name != "heartbeat_s" else 10.0))


@pytest.mark.parametrize(
    ("change", "key", "value"),
    [
        ({"low_speed_percent": 99.0}, "decimated rows", 4),
        ({"q": [1.0, 0.0]}, "parameters", ["Fv2", "Fc2"]),
        ({"q": [100.0, 1.0]}, "", None),  # beyond the limits of position
    ],
)
def test_default_method_gives_same_error_data(change, key, value):
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    scale, caught = change.pop("q", 1.0), []
    signals = replace(signals, q=signals.q * scale, q_ref=signals.q_ref * scale)
    for method in (None, "iv"):
        with pytest.raises(RobotIdimError) as refused:
            fit(
                signals.q,
                signals.effort,
                1000.0,
                signals.robot,
                signals.q_ref,
                method=method,
                **change,
            )
        caught.append(refused)
    assert data_of(caught[0]) == data_of(caught[1])
    assert data_of(caught[0])[1:3] == (key, value)
    assert caught[0].value.expected or caught[0].value.advice
    assert caught[0].value.place or key
