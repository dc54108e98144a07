"""Passive recordings: python-can's own adapter classes, over made-up drivers, are set to only
listen; the user is told.
"""

import subprocess
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from can.interfaces import cantact, pcan, slcan
from can.interfaces.kvaser import canlib
from can.interfaces.pcan import basic
from can.interfaces.seeedstudio import seeedstudio
from made_up_buses import bus_text

from acquisition.bus import LISTEN_ONLY, listening_words, open_bus
from acquisition.commands import main
from acquisition.errors import RefusedError, RobotIdimError
from acquisition.robot import BusFile

Asked = list[tuple[object, ...]]


def bus_at(interface: str, channel: str) -> BusFile:
    return BusFile(
        interface=interface, channel=channel, drive=(), sync_period_s=1.0, bitrate=500_000
    )


class Noting:
    def __init__(self, asked: Asked) -> None:
        self.asked = asked

    def __getattr__(self, name: str) -> Callable[..., object]:
        return lambda *given, **named: self.asked.append((name, *given)) or 0


def pcan_driver(
    monkeypatch: pytest.MonkeyPatch, asked: Asked, confirms: tuple[int, int] = (0, 1)
) -> None:
    values = {basic.PCAN_LISTEN_ONLY.value: confirms, basic.PCAN_API_VERSION.value: (0, b"4.9.0")}
    driver = Noting(asked)
    driver.GetValue = lambda handle, parameter: values.get(parameter.value, (0, 0))
    monkeypatch.setattr(pcan.pcan, "PCANBasic", lambda: driver)


KVASER = """
canGetNumberOfChannels canOpenChannel canIoCtlInit canSetBusParams canSetBusOutputControl canBusOn
kvReadTimer canSetAcceptanceFilter canFlushTransmitQueue canWriteSync canBusOff canClose"""


def kvaser_driver(monkeypatch: pytest.MonkeyPatch, asked: Asked) -> None:
    for name in KVASER.split():
        monkeypatch.setattr(canlib, name, getattr(Noting(asked), name), raising=False)


def serial_driver(monkeypatch: pytest.MonkeyPatch, asked: Asked) -> None:
    port = Noting(asked)
    module = SimpleNamespace(serial_for_url=lambda *_, **__: port, Serial=lambda *_, **__: port)
    for user in (slcan, seeedstudio):
        monkeypatch.setattr(user, "serial", module)
    monkeypatch.setattr(slcan.time, "sleep", lambda s: None)


def cantact_driver(monkeypatch: pytest.MonkeyPatch, asked: Asked) -> None:
    monkeypatch.setattr(cantact, "cantact", SimpleNamespace(Interface=lambda: Noting(asked)))


# Interface, channel, driver, and what it is told: to only listen, to take part.
ADAPTERS = {
    "pcan": (
        "PCAN_USBBUS1",
        pcan_driver,
        *(("SetValue", 0x51, basic.PCAN_LISTEN_ONLY, on) for on in (1, 0)),
    ),
    # silent, normal
    "kvaser": ("0", kvaser_driver, *(("canSetBusOutputControl", 0, mode) for mode in (1, 4))),
    "slcan": ("/dev/ttyACM0", serial_driver, ("write", b"L\r"), ("write", b"O\r")),
    "cantact": ("0", cantact_driver, ("set_monitor", 0, True), ("set_monitor", 0, False)),
    # mode in the frame that begins with AA 55 12
    "seeedstudio": ("/dev/ttyUSB0", serial_driver, 0x02, 0x00),
}


def told(asked: Asked) -> Asked:
    values = [
        tuple(getattr(x, "value", x) if x is not basic.PCAN_LISTEN_ONLY else x for x in call)
        for call in asked
    ]
    modes = [
        call[1][13] for call in values if call[0] == "write" and call[1][:3] == b"\xaa\x55\x12"
    ]
    return values + modes


@pytest.mark.parametrize("interface", ADAPTERS)
def test_adapter_is_set_to_listen_only(monkeypatch, interface):
    assert set(ADAPTERS) == set(LISTEN_ONLY)
    channel, driver, listen, take_part = ADAPTERS[interface]
    for passive in (True, False):
        asked: Asked = []
        driver(monkeypatch, asked)
        bus = open_bus(bus_at(interface, channel), passive=passive)
        assert type(bus).__module__.startswith("can.interfaces.")
        assert (listen in told(asked)) == passive
        assert (take_part in told(asked)) != passive
        bus.shutdown()


# off; a parameter that the driver does not have
@pytest.mark.parametrize("confirms", [(0, 0), (0x04000, 1)])
def test_unconfirmed_pcan_is_not_passive(monkeypatch, confirms):
    asked: Asked = []
    pcan_driver(monkeypatch, asked, confirms)
    with pytest.raises(RefusedError) as caught:
        open_bus(bus_at("pcan", "PCAN_USBBUS1"), passive=True)
    assert (caught.value.place, caught.value.what) == ("bus: pcan PCAN_USBBUS1", "recording")
    assert asked[-1][0] == "Uninitialize"
    open_bus(bus_at("pcan", "PCAN_USBBUS1"), passive=False).shutdown()


# As `ip -details link show` of iproute2 6.1 prints them.
HEAD = (
    "3: can0: <NOARP,UP,LOWER_UP> mtu 16 qdisc pfifo_fast state UP\n    link/can  promiscuity "
    "0  allmulti 0\n"
)
ALONE = "only listens: a drive that is alone on the bus gets no acknowledgement"
TAKES_PART = "acknowledges all frames, and destroys frames if its bit rate is wrong; "
WAY_OUT = (
    f"{TAKES_PART}to prevent this, run while it is down: ip link set can0 type can bitrate 500000"
)
NO_WAY = TAKES_PART + "python-can has no listen-only"


@pytest.mark.parametrize(
    ("interface", "shown", "words"),
    [
        (
            "socketcan",
            "    can <LISTEN-ONLY> state ERROR-ACTIVE restart-ms 0 \n\t  bitrate 500000\n",
            ALONE,
        ),
        ("socketcan", "    can <BERR-REPORTING> state ERROR-ACTIVE restart-ms 0 \n", WAY_OUT),
        ("socketcan", "    vcan numtxqueues 1 gso_max_size 65536 \n", None),
        ("socketcan", None, WAY_OUT.replace("acknowledges", "may acknowledge")),
        ("kvaser", None, ALONE),
        ("gs_usb", None, NO_WAY),
        ("virtual", None, None),
    ],
)
def test_effect_of_listening_on_bus(monkeypatch, interface, shown, words):
    def run(command, **_):
        assert command == ["ip", "-details", "link", "show", "dev", "can0"]
        if shown is None:
            raise FileNotFoundError("ip")
        return SimpleNamespace(stdout=HEAD + shown)

    monkeypatch.setattr(subprocess, "run", run)
    found = listening_words(bus_at(interface, "can0"))
    assert found.startswith(f"{interface} can0 {words}") if words else found == ""


def test_effect_is_shown_before_bus_opens(tmp_path, monkeypatch, capsys):
    robot = tmp_path / "robot.toml"
    robot.write_text(bus_text(1, interface="kvaser", channel="0"))

    def opened(*_: object, **__: object) -> None:
        raise RobotIdimError(f"opened; before: {capsys.readouterr().err}")

    monkeypatch.setattr("acquisition.session.running.ProcessLog", opened)
    assert main(["record", str(robot), "-o", str(tmp_path / "a.mcap"), "--passive"]) == 1
    assert f"opened; before: kvaser 0 {ALONE}" in capsys.readouterr().err
