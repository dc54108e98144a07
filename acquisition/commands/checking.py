"""Findings of `robot-acquire check` about the drives, the description and the bus load.

The checks find out which drives answer, whether they match the description, and whether the bus
carries the load. Nothing moves and no PDO is configured; objects are read and SYNC is measured.
"""

import math
import shutil
import textwrap
from collections.abc import Iterator
from contextlib import closing
from dataclasses import KW_ONLY, dataclass

from ..bus import (
    QUEUE_BYTES,
    Link,
    Master,
    MasterLink,
    is_homed,
    joint_positions,
    listen_for_others,
    needs_of,
    open_bus,
    position_words,
    queue_bytes,
    read_if_there,
    second_stop,
    socket_of,
    supervision_of,
    supervision_refusal,
)
from ..errors import BadInputError, BusFaultError, one_line
from ..protocol import DISABLED, State
from ..robot import (
    FILL_IN,
    HOW_TO_CONFIRM,
    MAX_LOAD,
    Bus,
    Drive,
    Robot,
    check_carriers,
    lines_to_fill_in,
    missing_limits,
    ripple_notes,
)
from ..session import DEVIATIONS, real_time_scheduling, scheduling_words, sync_jitter

SCALES = {
    0x608F: "encoder increments per turns",
    0x6091: "gear",
    0x6092: "feed",
    0x60A8: "position unit",
}
MAX_OFF_SHARE = 0.01  # of SYNC intervals that deviate by more than half a period
OTHER_NODES = "other nodes"
NO_ANSWER = "no drive answers. Without hardware, run `robot-acquire record --dry-run`"


@dataclass(frozen=True)
class Finding:
    """One property of the bus or of a drive, its value, and a flag: a session may start with it."""

    subject: str
    found: str
    _: KW_ONLY
    ok: bool = True
    node: int | None = None  # None for the bus
    track: bool = False  # refuses only `--track`


def check(robot: Robot, bus: Bus) -> list[Finding]:
    """Check the bus, the drives and the computer, without motion.

    A session may start if all findings are `ok`.
    """
    handle = open_bus(bus.file, passive=False)
    with closing(Link(handle)) as link:
        findings = [
            Finding(
                "bus load",
                f"{bus.load:.0%} of {bus.file.bitrate} bit/s at {1 / bus.file.sync_period_s:g} Hz; "
                f"the limit is {MAX_LOAD * bus.file.bitrate / bus.bits:.0f} Hz",
                ok=bus.load <= MAX_LOAD,
            ),
            Finding("watchdog", second_stop(bus.file)),
            *(
                Finding("effort", text)
                for text in ripple_notes(bus.file, robot.controller.bandwidth_hz)
            ),
            *_of_description(robot, bus),
        ]
        if (sock := socket_of(handle)) is not None:
            granted = queue_bytes(sock)
            few = f", less than {QUEUE_BYTES}, so frames may be lost → Raise net.core.rmem_max."
            text = f"{granted} bytes{few if granted < QUEUE_BYTES else ''}"
            findings.append(Finding("kernel queue", text, ok=granted >= QUEUE_BYTES // 10))
        with real_time_scheduling() as scheduling:
            findings.append(Finding("scheduling", scheduling_words(scheduling)))
            found = check_drives(link, bus)
        if all(finding.ok for finding in found if finding.subject in (OTHER_NODES, "state")):
            found += _positions(robot, Master(link, bus))
        return findings + found


def _of_description(robot: Robot, bus: Bus) -> Iterator[Finding]:
    """Yield what robot.toml lacks for a session that sends, or for motion."""
    if lines := lines_to_fill_in(robot):
        yield Finding(
            FILL_IN,
            f"lines {', '.join(map(str, lines))} of robot.toml are incomplete → Complete them.",
            ok=False,
            track=True,
        )
    if robot.unconfirmed:
        yield Finding(
            "unconfirmed",
            f"joints {', '.join(robot.unconfirmed)} were corrected from a recording → "
            f"{HOW_TO_CONFIRM}.",
            ok=False,
            track=True,
        )
    if missing := missing_limits(robot):
        yield Finding(
            "limits",
            f"{'; '.join(missing)} → Add the limits to robot.toml.",
            ok=False,
            track=True,
        )
    try:
        check_carriers(bus)
    except BadInputError as error:
        yield Finding("PDOs", str(error), ok=False, track=True)
    if bus.file.mapped_by_traffic:
        yield Finding(
            "mapping",
            'mapping = "traffic" allows passive recordings only → Run `record --passive`.',
            ok=False,
        )


def table(findings: list[Finding]) -> list[str]:
    """Return one line per finding, failed ones first: mark, property, nodes, value.

    Drives with the same finding share a line. A terminal, or COLUMNS, sets the width in which
    values are wrapped; without it they are not.
    """
    nodes: dict[tuple[str, str, bool], list[str]] = {}
    for finding in findings:
        key = (finding.subject, one_line(finding.found), finding.ok)
        nodes.setdefault(key, []).extend([] if finding.node is None else [str(finding.node)])
    # Drives that differ in a property are listed below each other, so that readers can compare
    # them.
    order = list(dict.fromkeys(subject for subject, _, _ in nodes))
    rows = sorted(
        ((*key, ", ".join(same)) for key, same in nodes.items()),
        key=lambda row: (row[2], order.index(row[0])),
    )
    names, of_nodes = (
        max((len(cell) for cell in cells), default=0) for cells in (order, [row[3] for row in rows])
    )
    return [
        textwrap.fill(
            f"{'ok' if ok else 'FAILED':6}  {name:{names}}  {of:{of_nodes}}  {found}",
            shutil.get_terminal_size((10_000, 0)).columns,
            subsequent_indent=" " * (12 + names + of_nodes),
            break_long_words=False,
            break_on_hyphens=False,
        )
        for name, found, ok, of in rows
    ]


def verdicts(findings: list[Finding]) -> dict[str, str]:
    """Return whether a recording and motion may begin: `passed`, or `failed` with the reasons."""
    return {
        "recording": _verdict([finding for finding in findings if not finding.track]),
        "motion": _verdict(findings),
    }


def _verdict(findings: list[Finding]) -> str:
    failed = [finding for finding in findings if not finding.ok]
    if any(f.found == NO_ANSWER for f in failed):
        return f"failed: {NO_ANSWER}"
    names = dict.fromkeys(
        f.subject if f.node is None else f"{f.subject} of node {f.node}" for f in failed
    )
    return f"failed: {', '.join(names)}" if failed else "passed"


def refusal(findings: list[Finding]) -> str:
    """Return the findings that forbid a session, or only `--track`, in one line.

    The line is empty if there are none.
    """
    recording, motion = verdicts(findings).values()
    failed = "the check for --track failed" if recording == "passed" else "the check failed"
    return "" if motion == "passed" else motion.replace("failed", failed, 1)


def check_drives(link: MasterLink, bus: Bus) -> list[Finding]:
    """Return findings about the drives and SYNC over an open link.

    Nothing is sent if another node is heard first.
    """
    master = Master(link, bus)
    if (other := listen_for_others(master)) is not None:
        return [Finding(OTHER_NODES, f"{other}, so drives and SYNC are not checked", ok=False)]
    findings = [finding for drive in bus.drives for finding in _of_drive(master, drive)]
    if len(findings) == len(bus.drives):  # the state alone: no drive has answered
        return [*findings, Finding("drives", NO_ANSWER, ok=False)]
    return [
        *findings,
        _jitter(master),
        *(
            Finding(
                "node ids",
                f"two devices answer as node {node} → Give one of them another node id.",
                ok=False,
            )
            for node in master.doubled  # while SYNC was measured, too
        ),
    ]


def _of_drive(master: Master, drive: Drive) -> Iterator[Finding]:
    """Yield findings about a drive; only its state if it does not answer."""
    node = drive.node
    try:
        state = master.state(drive)
    except BusFaultError as error:
        text = str(error).removeprefix(f"{error.place}: ")  # the same for all drives
        yield Finding("state", text, ok=False, node=node)
        return
    # A recording leaves a drive in fault as it is; motion begins with its reset.
    fault, disabled = state is State.FAULT, state in DISABLED
    yield Finding(
        "state",
        ("fault → Remove its cause, and reset the drive." if fault else state.words)
        + ("" if disabled else " → Run `robot-acquire disable`."),
        ok=disabled and not fault,
        node=node,
        track=fault,
    )
    try:
        for need in list(needs_of(master, drive, track=True)):
            yield Finding(
                need.name,
                need.refusal or need.found,
                ok=not need.refusal,
                node=node,
                track=need.track,
            )
    except BusFaultError as error:
        yield Finding("objects", str(error), ok=False, node=node)
    for name, text in (
        *supervision_of(master, drive),
        *(("dictionary", text) for text in (drive.dictionary.warnings if drive.dictionary else ())),
        *_scale(master, drive),
    ):
        yield Finding(name, text, node=node)
    if reason := supervision_refusal(master, drive):
        text = f"{reason} → Change this, or pass --unsupervised-drives with --track."
        yield Finding("monitoring", text, ok=False, node=node, track=True)


def _scale(master: Master, drive: Drive) -> list[tuple[str, str]]:
    """Return the drive's objects of position units and the units of the description, as a property.

    Manufacturers combine them differently.
    """
    values = []
    for index, name in SCALES.items():
        is_ratio = (index, 2) in drive.entries
        stated = [
            "not answered"
            if (x := read_if_there(master, drive, index, sub)) is None
            else f"{x}"
            if is_ratio
            else f"0x{x:08X}"
            for sub in ((1, 2) if is_ratio else (0,))
            if (index, sub) in drive.entries
        ]
        values += [f"{name} {index:04X} {'/'.join(stated)}"] if stated else []
    counts = drive.position_codec.counts_per_unit
    text = (
        f"robot.toml: {counts * 2 * math.pi:g} counts per turn or {counts:g} per m → Check that "
        "they agree."
    )
    return [("scale", ", ".join([*values, text]))] if values else []


def _jitter(master: Master) -> Finding:
    """Return the jitter of SYNC, as sent by this program or as received."""
    try:
        jitter = sync_jitter(master)
    except BusFaultError as error:
        return Finding("SYNC", str(error), ok=False)
    even = jitter.off <= MAX_OFF_SHARE
    limit = f" (more than {jitter.largest_s * 1e3 / DEVIATIONS:.3g} ms, too much for --track)"
    text = (
        f"jitter: standard deviation {jitter.sd_s * 1e3:.3f} ms"
        f"{'' if jitter.fit_for_motion else limit}, largest {jitter.worst_s * 1e3:.3f} ms, period "
        f"{master.bus.file.sync_period_s * 1e3:g} ms; {jitter.off:.1%} of the intervals deviate by "
        "more than half a period"
    )
    return Finding("SYNC", text, ok=even and jitter.fit_for_motion, track=even)


def _positions(robot: Robot, master: Master) -> Iterator[Finding]:
    """Yield the reported joint positions, and whether the drives are homed."""
    try:
        words = ", ".join(position_words(robot, joint_positions(robot, master)))
        yield Finding("joint positions", f"{words} → Check that the robot is there.")
        for drive in master.bus.drives:
            homed = is_homed(master, drive)
            yield Finding(
                "homed",
                "not known; the drive's zero may be its position at power-on"
                if homed is None
                else f"yes ({drive.file.homed})"
                if homed
                else f"no ({drive.file.homed}) → Home the drive.",
                ok=homed is not False,
                node=drive.node,
                track=True,
            )
    except BusFaultError as error:
        yield Finding("joint positions", str(error), ok=False)
