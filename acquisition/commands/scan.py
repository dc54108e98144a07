"""`robot-acquire scan`: the nodes of an unknown bus and what they state, by
listening and SDO reads only.
"""

import argparse
from contextlib import closing

from ..errors import COMMAND_LINE, Location, one_line
from .command_line import Progress, add_bus, add_path


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_bus(parser, required=True)
    parser.add_argument(
        "--bitrate",
        type=int,
        metavar="BIT/S",
        help="needed for an adapter; ip link sets socketcan's",
    )
    add_path(
        parser, "--toml", "BUS.toml", "write [bus] with a block for each drive, to be filled in"
    )


def run(options: argparse.Namespace) -> None:
    """Scan the bus, print a table, and write `[bus]`."""
    from ..bus import SHARED, Uploads, open_link, scan_nodes
    from ..files import write_text
    from ..robot import BITRATES, FILL_IN, BusFile
    from .checking import table
    from .scanning import ARRAYS, OBJECTS, bus_lines, findings_of

    interface, bitrate, out = options.interface, options.bitrate, options.toml
    COMMAND_LINE.require(
        interface != "socketcan" or bitrate is None,
        "--bitrate",
        bitrate,
        f"none: ip link set {options.channel} type can bitrate {bitrate}",
        text="of socketcan",
    )
    COMMAND_LINE.require(
        bitrate in BITRATES or (bitrate is None and interface in SHARED),
        "--bitrate",
        bitrate,
        f"one of {', '.join(map(str, BITRATES))}",
        text="a wrong one destroys the frames of others",
    )
    Location(str(out)).require(
        out is None or not out.exists(),
        text="already exists",
        expected="a new name; descriptions are not replaced",
    )
    # No heartbeat is a sign of a master (node 0 has none): 127, the default, is the node
    # id of many new drives.
    file = BusFile(
        interface=interface,
        channel=options.channel,
        drive=(),
        sync_period_s=1.0,
        master_node=0,
        **({} if bitrate is None else {"bitrate": bitrate}),
    )
    with closing(open_link(file, passive=False)) as link, Progress("listening") as line:
        uploads = Uploads(link, file, line.say)
        nodes = scan_nodes(uploads, OBJECTS, ARRAYS)
    print(*table(findings_of(nodes, uploads.heard)), sep="\n")
    Location(f"bus: {interface} {options.channel}").require(
        nodes,
        text="no node answers",
        expected="one at least: drives on, cable, terminators, bitrate",
    )
    if out is not None:
        text = "\n".join([*bus_lines(file, nodes, uploads.heard), ""])
        write_text(out, text)
        print(one_line(f"{out}: to be filled in: {text.count(FILL_IN)} lines with {FILL_IN}"))
