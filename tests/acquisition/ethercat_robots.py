"""Descriptions of robots whose drives are on EtherCAT."""

from made_up_buses import JOINT

DRIVE = """
[[bus.drive]]
node = {node}
actual = "6077"
rated_torque_nm = 1
counts_per_turn = 524288
"""


def robot_text(
    n: int = 2, *, drive: str = "", bandwidth_hz: float = 5, period_s: float = 0.001
) -> str:
    joints = "".join(JOINT.format(i=i + 1, ratio=1) for i in range(n)).replace(
        "[-150, 150]", "[-36000, 36000]"
    )
    joints = joints.replace("speed_deg_s = 200", "speed_deg_s = 3000")
    bus = f'[bus]\ninterface = "none"\nchannel = "none"\nsync_period_s = {period_s}\n'
    drives = "".join(DRIVE.format(node=i + 1) + drive for i in range(n))
    return f'name = "made up"\n[controller]\nbandwidth_hz = {bandwidth_hz}\n{joints}{bus}{drives}'
