"""Adapters that only listen: how python-can opens them so, and what a passive
recording does to the bus.
"""

import re
import subprocess
from contextlib import suppress
from typing import Any

from ..errors import RefusedError
from ..robot import BusFile

# What python-can opens an adapter with so that it only listens. Adapters that are not here
# acknowledge all frames.
LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "slcan": {"listen_only": True},
    "pcan": {"state": "PASSIVE"},  # of can.BusState
    "kvaser": {"driver_mode": False},  # silent
    "cantact": {"monitor": True},
    "seeedstudio": {"operation_mode": "silent"},
}


def listening_words(file: BusFile) -> str:
    """Whether a passive recording acknowledges the frames of others, and what follows;
    empty without hardware.
    """
    listens, verb, way_out = (
        file.interface in LISTEN_ONLY,
        "acknowledges",
        "python-can has no listen-only mode for it",
    )
    if file.interface in ("virtual", "udp_multicast"):
        return ""
    if file.interface == "socketcan":
        shown = ""
        with suppress(OSError, subprocess.SubprocessError):
            shown = subprocess.run(
                ["ip", "-details", "link", "show", "dev", file.channel],
                capture_output=True,
                text=True,
                timeout=5,
            ).stdout
        if re.search(r"(?m)^\s+vx?can ", shown):
            return ""
        listens, verb = (
            bool(re.search(r"\bcan <[^>]*LISTEN-ONLY", shown)),
            verb if shown else "may acknowledge",
        )
        way_out = (
            f"to prevent it: ip link set {file.channel} type can bitrate {file.bitrate} "
            "listen-only on, while it is down"
        )
    text = (
        "listens only: a drive that is alone on the bus gets no acknowledge, and repeats its frame"
        if listens
        else f"{verb} all frames, and destroys them at a wrong bit rate; {way_out}"
    )
    return f"{file.interface} {file.channel} {text}"


def refuse_unconfirmed(bus: Any, place: str) -> None:
    """Raise `RefusedError` if a PCAN, the only adapter that can be asked, does not
    confirm that it only listens.
    """
    if (driver := getattr(bus, "m_objPCANBasic", None)) is not None:
        from can.interfaces.pcan.basic import PCAN_ERROR_OK, PCAN_LISTEN_ONLY

        if driver.GetValue(bus.m_PcanHandle, PCAN_LISTEN_ONLY) != (PCAN_ERROR_OK, 1):
            bus.shutdown()
            raise RefusedError(
                "does not confirm listen-only",
                what="recording",
                place=place,
                expected="a driver and an adapter that can; no other program may have it open",
            )
