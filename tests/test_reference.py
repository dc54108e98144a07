"""References that are refused: what is not finite, and tables that no smooth path leads through."""

import re

import numpy as np
import pytest
from made_up_buses import bus_text, robot_of

from acquisition.errors import AcquisitionError
from acquisition.robot import check_limits, table_reference

ROBOT = robot_of(bus_text(2))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
def test_positions_that_are_not_within_a_limit_because_they_are_no_number(value):
    q = np.zeros((5, 2))
    q[2, 1] = value
    with pytest.raises(AcquisitionError, match=r"x: at 0.004 s: position of joint_2 = .*: expected -2.618 to 2.618"):
        check_limits(q, ROBOT, 0.002, "x")


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("0,0,0\n1e-310,0,1\n1,0,0", "rows 1e-310 s apart or more, positions up to 1: expected positions in rad or m"),
        ("0,0,0\n1,0,1e308\n2,0,-1e308", "rows 1 s apart or more, positions up to 1e+308: expected positions"),
        ("0,0,0\n1e12,1,1", "time_s: 1e+12 s from first to last: expected 86400 s at most, with SYNC every 0.002 s"),
        ("0,0,0\n1e300,1,1", "time_s: 1e+300 s from first to last: expected 86400 s at most"),
        ("-1e308,0,0\n1e308,1,1", "time_s: inf s from first to last: expected 86400 s at most"),
    ],
)
def test_tables_that_no_path_leads_through(tmp_path, rows, expected):
    path = tmp_path / "ref.csv"
    path.write_text(f"time_s,joint_1,joint_2\n{rows}\n")
    with pytest.raises(AcquisitionError, match=re.escape(f"{path}: {expected}")) as caught:
        table_reference(path, ROBOT, 0.002)
    assert "\n" not in str(caught.value)


def test_a_table_longer_than_memory_may_hold(tmp_path):
    path = tmp_path / "ref.csv"
    path.write_text("time_s,joint_1,joint_2\n0,0,0\n6000,1,1\n")
    with pytest.raises(
        AcquisitionError, match=r"6000 s from first to last: expected 5000 s at most, with SYNC every 0\.0001"
    ):
        table_reference(path, ROBOT, 1e-4)
