"""What a session tells while it goes on."""

from made_up_buses import bus_text, robot_of

from acquisition.commands.record import live_line
from acquisition.recorder.recorder import Status


def test_everything_that_matters_is_on_the_line():
    status = Status(frames=9000, rate_hz=6501.2, drops=3, late=2, lowest=(-0.5, 0.0), highest=(0.25, 1.0))
    line = live_line(robot_of(bus_text(2)), status, 12.4)
    assert line.plain == (
        "6501 frames/s, 3 dropped, 0 missing, 2 late, joint_1 -0.500..0.250 rad, joint_2 0.000..1.000 rad, 12 s left"
    )
    assert [line.plain[span.start : span.end] for span in line.spans if "red" in str(span.style)] == [
        ", 3 dropped",
        ", 2 late",
    ]


def test_before_the_first_sample_and_without_an_end():
    assert live_line(robot_of(bus_text(1)), Status(), None).plain == "0 frames/s, 0 dropped, 0 missing, 0 late"
