"""Enables and disables all drives together, one transition of CiA 402 after the other.

While a drive is not enabled, its target follows the measured position. From the moment it reports operation enabled, its
target stays at the last position before. If the target still followed, the arm could sink when the brake opens, and the
drive's own supervision would see no following error.
"""

from collections.abc import Collection, Iterator

from ..bus import Master, Orders, status_words
from ..errors import AcquisitionError
from ..protocol import Command, State, toward

ENABLE_S = 5.0  # for all drives to be enabled, or disabled
# One transition at a time, so that a drive can decelerate and engage its brake before voltage is off.
_DOWN = {
    State.OPERATION_ENABLED: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.DISABLE_VOLTAGE,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


def all_enabled(master: Master) -> bool:
    """Whether every drive is in operation enabled."""
    return all(watch.state is State.OPERATION_ENABLED for watch in master.nodes)


def enable(master: Master, targets: list[int], in_fault: Collection[int] = ()) -> Iterator[Orders | None]:
    """Orders of one SYNC after the other until every drive is in operation enabled; None where nothing is to be sent.

    `targets`, empty, receives the target counts (n) at which the drives are held. Only the faults of the nodes `in_fault` are
    reset: those that the operator was asked about. Raises `AcquisitionError`: another fault, or not enabled after 5 s.
    """
    for k in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        watches = master.nodes
        measured = [watch.counts for watch in watches if watch.counts is not None]
        if len(measured) == len(watches):
            targets[:] = [
                target if watch.state is State.OPERATION_ENABLED else counts
                for watch, target, counts in zip(watches, targets or measured, measured, strict=True)
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
            if command is Command.FAULT_RESET and watch.drive.node not in in_fault:
                place, expected = f"node {watch.drive.node} ({watch.drive.name})", "switch on disabled, as before"
                raise AcquisitionError("went into fault after the session began", place=place, expected=expected)
            if command is Command.FAULT_RESET and k % 2:
                command = None  # a drive acts on the rising edge of this bit
            controls.append(command.controlword if command else 0)
        yield list(zip(controls, targets, strict=True))
    states = ", ".join(
        f"node {w.drive.node} {'silent' if w.statusword is None else status_words(w.statusword)}"
        for w in master.nodes
        if w.state is not State.OPERATION_ENABLED
    )
    raise AcquisitionError(f"not enabled after {ENABLE_S:g} s: {states}", expected="operation enabled")


def disable(master: Master, targets: list[int]) -> Iterator[Orders]:
    """Orders at constant targets until every drive is in switch on disabled or fault. Raises `AcquisitionError` after 5 s."""
    for _ in range(round(ENABLE_S / master.bus.file.sync_period_s)):
        states = [watch.state for watch in master.nodes]
        if all(state in (State.SWITCH_ON_DISABLED, State.FAULT) for state in states):
            return
        downs = [
            Command.DISABLE_VOLTAGE if state is None else _DOWN.get(state, Command.DISABLE_VOLTAGE) for state in states
        ]
        yield [(command.controlword, target) for command, target in zip(downs, targets, strict=True)]
    raise AcquisitionError(f"not disabled after {ENABLE_S:g} s", expected="switch on disabled")
