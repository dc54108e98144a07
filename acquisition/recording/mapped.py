"""What the drives of a log have mapped: as they confirmed it, and where in the log."""

from dataclasses import replace

import numpy as np

from ..protocol import ANSWER, HEARTBEAT, REQUEST, SDO_OBJECTS, Confirmed, answer_of, request_of
from ..robot import Bus, Robot, resolve
from .rows import Block, Rows, Traffic

# What comes again sooner is the same frame: at 1 Mbit/s a request and an answer take 0.22 ms.
_DOUBLED_NS = 200_000


def resolve_mapped(frames: Block, robot: Robot, place: str) -> tuple[Block, Bus]:
    """Return the frames in which the drives have what they confirmed last, and the drives.

    Those before and behind, where a drive has another mapping or started again, are left out with
    a warning if a drive is mapped by traffic; else all frames are given. In a log without answers
    what a master wrote counts, with a warning. Raises `BadInputError` as `resolve`.
    """
    traffic = Traffic(frames)
    pdos, ids = (traffic.ids > 0x180) & (traffic.ids < ANSWER), traffic.ids
    silent = not ((ids > ANSWER) & (ids < REQUEST)).any()
    files = robot.bus.drive if robot.bus is not None else ()
    drives = {file.node: Confirmed() for file in files}
    # by node: row of the last change, and of the last start that no mapping followed
    since, until = dict.fromkeys(drives, 0), dict[int, int]()
    for row in _rows(traffic).tolist():
        service, data = int(ids[row]) & 0x780, frames[row]["data"].tobytes()
        node = int(ids[row]) & 0x7F or data[1]  # NMT has it in its data, 0 for all
        for k in [k for k in drives if node in (0, k)]:
            transfer = request_of(data) if service == REQUEST else answer_of(data)
            if service not in (REQUEST, ANSWER) and not drives[k].stored:
                until.setdefault(k, row)
                continue
            changed = (service not in (REQUEST, ANSWER) or k in until) and drives[k].started()
            until.pop(k, None)
            if service == REQUEST:
                drives[k].asked(transfer)
            if service == ANSWER or (silent and transfer.kind == "write"):
                kind = "written" if silent else transfer.kind
                changed |= drives[k].answered(replace(transfer, kind=kind))
            since[k] = row if changed else since[k]
    mapped = [file.node for file in files if file.mapping == "traffic"]
    first = max((since[k] for k in mapped), default=0)
    end = min((until[k] for k in mapped if k in until), default=len(frames))
    if not pdos[first:end].any():  # they have sent nothing by what is known of them
        for k in until:
            drives[k] = Confirmed(refused="the drive started again after it was mapped")
    bus = resolve(robot, place, drives)
    left_out = int(np.count_nonzero(pdos[:first]) + np.count_nonzero(pdos[end:]))
    notes = {
        "no answer of a drive is in the log: what was written to map PDOs counts": silent,
        f"{left_out} of {np.count_nonzero(pdos)} PDOs are left out: when they were sent, a drive "
        "had another mapping, or one that is not in the log": left_out,
    }
    told = tuple(text for text, so in notes.items() if so and mapped)
    return frames[first:end], replace(bus, notes=(*bus.notes, *told))


def _rows(traffic: Traffic) -> Rows:
    """Frames that say what is mapped: SDO about `SDO_OBJECTS`, and starts and resets of drives."""
    ids = traffic.ids
    rows = np.flatnonzero(
        (ids == 0) | (ids > ANSWER) & (ids < REQUEST + 128) | (ids > HEARTBEAT) & (ids < 0x780)
    ).astype(np.int32)
    ids, data, sdo = ids[rows], traffic.at("data", rows), (ids[rows] > ANSWER) & (ids[rows] < 0x680)
    index = np.ascontiguousarray(data[:, 1:3]).view("<u2")[:, 0]
    known = np.isin(index, SDO_OBJECTS) & (ids != REQUEST) & (traffic.at("length", rows) == 8)
    again = (np.abs(np.diff(traffic.at("time_ns", rows))) < _DOUBLED_NS) & (ids[1:] == ids[:-1])
    known[1:] &= ~(again & (data[1:] == data[:-1]).all(axis=1))
    # resets of a node, or of its communication, by NMT; boot-up
    other = np.where(ids == 0, np.isin(data[:, 0], (0x81, 0x82)), data[:, 0] == 0)
    return rows[np.where(sdo, known, other)]
