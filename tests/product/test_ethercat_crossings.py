"""A capture of EtherCAT in two parts: with its mapping and with a stated one, with a
payload, fitted together.
"""

import struct

import pytest
from conftest import needs_data
from ethercat_robots import robot_text
from made_up_buses import robot_of

from acquisition.errors import BadInputError
from acquisition.importing import import_log
from acquisition.robot import Payload
from identification import load_signals
from identification.data import Recordings
from identification.regression import Overrides
from identification.results import identify

INPUTS = "0x6041:16,0x6061:8,0:8,0x6064:32,0x606C:32,0x6077:16,0x603F:16"
HEADER, PACKET = 24, 16  # bytes


def test_two_real_captures_are_fitted_together(tmp_path):
    content = needs_data("ethercat", "two_drives.pcap").read_bytes()
    half = HEADER
    while half < len(content) // 2:
        half += PACKET + struct.unpack_from("<I", content, half + 8)[0]
    first, second = (tmp_path / name for name in ("first.pcap", "second.pcap"))
    first.write_bytes(content[:half])
    second.write_bytes(content[:HEADER] + content[half:])
    robot, stated = robot_of(robot_text(1)), {"mapping": [INPUTS] * 2}
    import_log(first, first.with_suffix(".mcap"), robot, "robot.toml")
    import_log(second, second.with_suffix(".mcap"), robot, "robot.toml", Payload(0.5), **stated)
    signals = tuple(load_signals(path.with_suffix(".mcap")) for path in (first, second))
    fit = identify(Recordings(sources=signals), Overrides(), method="iv")
    values = dict(zip(fit.base.names, fit.beta, strict=True))
    assert fit.status == "converged"
    assert values["ZZ1R"] == pytest.approx(0.016689, rel=0.01)
    assert values["Fv1"] == pytest.approx(0.083443, rel=0.02)
    [payload] = fit.payloads  # nothing was carried: its inertia about the axis is none
    assert abs(payload.parameters[5].value) < 1.5 * payload.parameters[5].half_width < 1e-4
    with pytest.raises(BadInputError) as told:
        import_log(
            second,
            tmp_path / "none.mcap",
            robot_of(robot_text(1, drive="station = 1002\n")),
            "r",
            **stated,
        )
    assert "station 1002" in told.value.args[0]
