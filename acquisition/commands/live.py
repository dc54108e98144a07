"""What a session tells while it goes on, on one line."""

from rich.text import Text

from ..recorder import Status
from ..robot import Robot


def live_line(robot: Robot, status: Status, left_s: float | None) -> Text:
    """Rate, losses, each joint's range so far, time left. Losses stand out."""
    line = Text(f"{status.rate_hz:.0f} frames/s")
    for count, name in ((status.drops, "dropped"), (status.missing, "missing"), (status.late, "late")):
        line.append(f", {count} {name}", style="bold red" if count else "")
    for joint, low, high in zip(robot.joints, status.lowest, status.highest, strict=False):
        line.append(f", {joint.name} {low:.3f}..{high:.3f} {joint.position_unit}")
    if left_s is not None:
        line.append(f", {left_s:.0f} s left")
    return line
