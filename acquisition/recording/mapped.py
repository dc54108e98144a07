"""What the drives of a log have mapped: as they confirmed it, and where in the log."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace

import numpy as np

from ..protocol import ANSWER, HEARTBEAT, REQUEST, SDO_OBJECTS, Confirmed
from ..robot import Bus, Robot, resolve
from .rows import Block, Rows, Traffic


def resolve_mapped(frames: Block, robot: Robot, place: str) -> tuple[Block, Bus]:
    """Return the frames, and the drives with what they have mapped in them.

    If a drive is mapped by traffic, these are the frames between two changes of what is mapped,
    with most PDOs of the log; others are left out with a warning. In a log without answers what a
    master wrote counts, with a warning. Raises `BadInputError` as `resolve`.
    """
    traffic = Traffic(frames)
    pdos = (traffic.ids > 0x180) & (traffic.ids < ANSWER)
    silent = not ((traffic.ids > ANSWER) & (traffic.ids < REQUEST)).any()
    files = robot.bus.drive if robot.bus is not None else ()
    drives = {file.node: Confirmed(silent=silent) for file in files}
    parts, first, known = list[tuple[int, int, dict[int, Confirmed]]](), 0, deepcopy(drives)
    for row in _rows(traffic).tolist():
        if _changed(drives, int(traffic.ids[row]), bytes(frames[row]["data"])):
            parts.append((first, row, known))
            first = row
        if silent or traffic.ids[row] & 0xFF80 != REQUEST:  # what is asked may change nothing
            known = {k: replace(drive, values=dict(drive.values)) for k, drive in drives.items()}
    parts.append((first, len(frames), drives))
    first, end, known = max(parts, key=lambda part: (pdos[part[0] : part[1]].sum(), part[0]))
    bus = resolve(robot, place, known)
    if not any(file.mapping == "traffic" for file in files):
        return frames, bus
    left_out = np.count_nonzero(pdos) - np.count_nonzero(pdos[first:end])
    notes = {
        "no answer of a drive is in the log: what was written to map PDOs counts": silent,
        f"{left_out} of {np.count_nonzero(pdos)} PDOs are left out: when they were sent, a drive "
        "had another mapping, or one that is not in the log": left_out,
    }
    told = (text for text, so in notes.items() if so)
    return frames[first:end], replace(bus, notes=(*bus.notes, *told))


def _changed(drives: Mapping[int, Confirmed], can_id: int, data: bytes) -> bool:
    """Whether a frame changed what one of the drives has mapped."""
    node = can_id & 0x7F or data[1]  # NMT has it in its data, 0 for all
    changes = [drive.take(can_id & 0x780, data) for k, drive in drives.items() if node in (0, k)]
    return any(changes)


def _rows(traffic: Traffic) -> Rows:
    """Frames that say what is mapped: SDO about `SDO_OBJECTS`, and starts and resets of drives."""
    services = np.isin(traffic.ids & 0xFF80, (ANSWER, REQUEST, HEARTBEAT))
    rows = np.flatnonzero(services | (traffic.ids == 0)).astype(np.int32)
    ids, data = traffic.ids[rows], traffic.at("data", rows)
    index = np.ascontiguousarray(data[:, 1:3]).view("<u2")[:, 0]
    sdo = np.isin(index, SDO_OBJECTS) & (traffic.at("length", rows) == 8)
    # resets of a node, or of its communication, by NMT; boot-up
    kinds = [ids == 0, ids & 0x7F == 0, ids > HEARTBEAT]
    starts = [np.isin(data[:, 0], (0x81, 0x82)), np.False_, data[:, 0] == 0]
    chosen: Rows = rows[np.select(kinds, starts, sdo)]
    return chosen
