"""Drives up to operation enabled and down again, all together, one transition of CiA 402 after the other.

While a drive is not enabled its target follows the measured position. It is held at the last position that came before the
drive reported operation enabled: a target that followed further would let the arm sink when the brake opens, and the drive's
own supervision of the following error would see nothing.
"""

from collections.abc import Iterator

from ..errors import AcquisitionError
from ..master import Master, Orders, status_words
from ..protocol import Command, State, toward

ENABLE_S = 5.0  # for all drives to be enabled, or disabled
# Down in order, so that a drive may brake and hold before it lets go.
_DOWN = {
    State.OPERATION_ENABLED: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.DISABLE_VOLTAGE,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


def all_enabled(master: Master) -> bool:
    """Whether every drive is in operation enabled."""
    return all(watch.state is State.OPERATION_ENABLED for watch in master.nodes)


def enable(master: Master, targets: list[int]) -> Iterator[Orders | None]:
    """Orders until every drive is enabled; `targets` (n counts, empty at first) are left where drives were held.

    Raises `AcquisitionError` when a drive is not enabled in 5 s.
    """
    for k in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        watches = master.nodes
        if all(watch.counts is not None for watch in watches):
            fresh = [watch.counts or 0 for watch in watches]
            targets[:] = [
                at if watch.state is State.OPERATION_ENABLED else now
                for watch, at, now in zip(watches, targets or fresh, fresh, strict=True)
            ]
        if all_enabled(master):
            return
        if not targets or any(watch.state is None for watch in watches):
            yield None
            continue
        controls = []
        for watch in watches:
            command = toward(watch.state, State.OPERATION_ENABLED) if watch.state is not None else None
            if watch.state is State.OPERATION_ENABLED:
                command = Command.ENABLE_OPERATION
            if command is Command.FAULT_RESET and k % 2:
                command = None  # it acts on the rising edge
            controls.append(command.controlword if command else 0)
        yield list(zip(controls, targets, strict=True))
    states = ", ".join(
        f"node {w.drive.node} {'silent' if w.statusword is None else status_words(w.statusword)}"
        for w in master.nodes
        if w.state is not State.OPERATION_ENABLED
    )
    raise AcquisitionError(f"not enabled after {ENABLE_S:g} s: {states}: expected operation enabled")


def disable(master: Master, targets: list[int]) -> Iterator[Orders]:
    """Orders until every drive is in switch on disabled or in fault; targets stay. Raises `AcquisitionError` after 5 s."""
    for _ in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        states = [watch.state for watch in master.nodes]
        if all(state in (State.SWITCH_ON_DISABLED, State.FAULT) for state in states):
            return
        downs = [
            Command.DISABLE_VOLTAGE if state is None else _DOWN.get(state, Command.DISABLE_VOLTAGE) for state in states
        ]
        yield [(command.controlword, target) for command, target in zip(downs, targets, strict=True)]
    raise AcquisitionError(f"not disabled after {ENABLE_S:g} s: expected switch on disabled")
