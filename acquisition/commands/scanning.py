"""`robot-acquire scan`: readings of the nodes of a bus, as a table and as `[bus]` of robot.toml."""

import json
from collections.abc import Collection, Iterator, Mapping

from ..bus import Readings
from ..protocol import (
    EFFORT_OBJECTS,
    NOT_VALID,
    PARAMETERS,
    RULES,
    TEXTS,
    find_state,
    position_units_per_turn,
)
from ..robot import FILL_IN, BusFile
from .checking import Finding

PDOS = {
    f"{way} {k + 1}": (first + k, mapping + k)
    for way, (first, mapping) in PARAMETERS.items()
    for k in range(4)
}
GROUPS = {
    "drive": (0x1000, 0x1018),
    "name, versions": TEXTS,
    "state": (0x6041, 0x6064),
    "modes": (0x6502,),
    "rated mA, mN m": (0x6075, 0x6076),
    "units per turn": (0x6092, 0x6091, 0x608F),
    "limits": (0x607D, 0x607F, 0x6080, 0x6085),
    "supervision": (0x1016, 0x6007, 0x6065),
    "efforts": tuple(index for index, _ in EFFORT_OBJECTS),
}
_SUBS = {0x1016: (), 0x1018: (1, 2, 3, 4)} | dict.fromkeys((0x6092, 0x6091, 0x608F, 0x607D), (1, 2))
OBJECTS = [
    *(
        (index, sub)
        for group in GROUPS.values()
        for index in group
        for sub in _SUBS.get(index, (0,))
    ),
    *((parameters, 1) for parameters, _ in PDOS.values()),
]
ARRAYS = (0x1016, *(mapping for _, mapping in PDOS.values()))
_HEXADECIMAL = (0x1000, 0x1016, 0x1018, 0x6041, 0x6065, 0x6502)


def is_drive(readings: Readings) -> bool:
    """Test whether a node is a drive.

    It is one if 1000h names CiA 402, or if it has a statusword and a position.
    """
    device, *both = (readings[index, 0].value for index in (0x1000, 0x6041, 0x6064))
    return (device or 0) & 0xFFFF == 402 or None not in both


def findings_of(nodes: Mapping[int, Readings], heard: Mapping[int, set[str]]) -> list[Finding]:
    """Return rows for drives, for other devices, and for nodes that were only heard."""
    rows = []
    for node, readings in nodes.items():
        others = {"not a drive": GROUPS["drive"], "name, versions": TEXTS}
        for subject, group in (GROUPS if is_drive(readings) else others).items():
            keys = [key for key in readings if key[0] in group]
            ok = all("not exist" in readings[key].problem for key in keys if readings[key].problem)
            rows.append(
                Finding(
                    subject, ", ".join(_words(readings, *key) for key in keys), ok=ok, node=node
                )
            )
        if is_drive(readings):
            unread = sorted(
                {
                    reading.problem
                    for (index, _), reading in readings.items()
                    if 0x1400 <= index < 0x1C00
                    and reading.problem
                    and "not exist" not in reading.problem
                }
            )
            text = "; ".join([*_pdos(readings), *unread]) or "no PDO is mapped"
            rows.append(Finding("PDOs", text, ok=not unread, node=node))
    return rows + [
        Finding("only heard", ", ".join(sorted(heard[node])), ok=False, node=node)
        for node in sorted(heard)
        if node not in nodes
    ]


def _words(readings: Readings, index: int, sub: int) -> str:
    value, problem, text = readings[index, sub]
    words = f"{index:04X}:{sub}".removesuffix(":0")
    if index in TEXTS and not problem:
        return f'{words} "{text}"'
    if value is None:
        return f"{words} -" if "not exist" in problem else f"{words} ({problem})"
    words += f" 0x{value:X}" if index in _HEXADECIMAL else f" {value}"
    if index == 0x6041 and (state := find_state(value)) is not None:
        words += f" {state.words}"
    if index == 0x6502:
        words += f" modes {', '.join(str(bit + 1) for bit in range(32) if value >> bit & 1)}"
    return f"{words} ({problem})" if problem else words


def _pdos(readings: Readings) -> Iterator[str]:
    for name, (parameters, mapping) in PDOS.items():
        can_id = readings[parameters, 1].value
        entries = [
            reading.value or 0 for key, reading in readings.items() if key[0] == mapping and key[1]
        ]
        if can_id is not None and (entries or not can_id & NOT_VALID):
            objects = (
                f" {entry >> 16:04X}:{entry >> 8 & 0xFF}".removesuffix(":0") for entry in entries
            )
            yield (
                f"{name} "
                f"0x{can_id & 0x7FF:03X}{' off' if can_id & NOT_VALID else ''}{''.join(objects)}"
            )


def bus_lines(
    file: BusFile, nodes: Mapping[int, Readings], heard: Collection[int] = ()
) -> Iterator[str]:
    """Yield the lines of `[bus]`, with a block for each drive.

    The user must complete the lines with `FILL_IN`. The master gets a node id that is not in
    `heard`.
    """
    yield "[bus]"
    yield f"interface = {json.dumps(file.interface)}"
    yield f"channel = {json.dumps(file.channel)}"
    yield f"bitrate = {file.bitrate}" + (
        f" # {FILL_IN}: copy it from ip link" if file.interface == "socketcan" else ""
    )
    yield (
        f"sync_period_s = 0.002 # {FILL_IN}: choose the period; robot-acquire check shows the "
        "bus load"
    )
    yield (
        f"other_nodes = {[node for node, readings in nodes.items() if not is_drive(readings)]} "
        "# nodes that are not drives"
    )
    free = max(set(range(1, 128)) - {*nodes, *heard}, default=None)
    if free != 127:
        yield (
            f"master_node = {free} # node id of this program; no device uses it"
            if free
            else f"# master_node = ... # {FILL_IN}: node id of this program; all are in use"
        )
    for node, readings in nodes.items():
        yield from _drive_lines(node, readings) if is_drive(readings) else ()


def _drive_lines(node: int, readings: Readings) -> Iterator[str]:
    yield f"\n[[bus.drive]] # {FILL_IN}: which joint? Put the blocks in the order of the motors"
    yield f"node = {node} # {', '.join(_words(readings, 0x1018, sub) for sub in range(1, 5))}"
    efforts = [
        key
        for key in EFFORT_OBJECTS
        if readings[key].value is not None and not readings[key].problem
    ]
    if not efforts:
        yield f'# reference = "..." # {FILL_IN}: object of the current or torque reference'
    for key in sorted(efforts, key=lambda key: "actual" in EFFORT_OBJECTS[key][2])[:1]:
        kind, rule, meaning = EFFORT_OBJECTS[key]
        certain = "" if key[0] >= 0x6000 else f"{FILL_IN}: check that it is "
        # The standard does not define the types of manufacturer-specific objects.
        yield from [f'objects = {{ "{key[0]:04X}" = "{kind}" }}'] if certain else []
        yield (
            f'{"actual" if "actual" in meaning else "reference"} = "{key[0]:04X}" # '
            f"{certain}{meaning}, {RULES[rule].unit}"
        )
        if rated := RULES[rule].rated:
            # A value with all bits set means that the drive has none.
            raw = (readings[0x6075 if "current" in rated else 0x6076, 0].value or 0) % 0xFFFFFFFF
            yield (
                f"{rated} = {raw / 1000:.10g}"
                if raw
                else f"# {rated} = ... # {FILL_IN}: the drive does not report it"
            )
    counts = position_units_per_turn({key: reading.value for key, reading in readings.items()})
    comment = f"# {FILL_IN}: turn the motor once to check value and sign; if linear, counts_per_m"
    yield (
        f"counts_per_turn = {counts:.12g} {comment}"
        if counts
        else f"# counts_per_turn = ... {comment}"
    )
