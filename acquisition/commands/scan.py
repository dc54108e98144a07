"""`robot-acquire scan`: find the nodes of an unknown bus by listening and SDO reads only."""

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
        help="bit rate in bit/s; required for an adapter (for socketcan, ip link sets it)",
    )
    add_path(
        parser,
        "--toml",
        "BUS.toml",
        "write a [bus] table with one entry per drive; complete its marked lines",
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
        text="the system sets the bit rate of socketcan",
        advice=f"Run this instead: `ip link set {options.channel} type can bitrate {bitrate}`",
    )
    COMMAND_LINE.require(
        bitrate in BITRATES or (bitrate is None and interface in SHARED),
        "--bitrate",
        bitrate,
        f"one of {', '.join(map(str, BITRATES))}",
        text="a wrong bit rate destroys the frames of other nodes",
    )
    Location(str(out)).require(
        out is None or not out.exists(),
        text="the file already exists",
        advice="Choose a new name; a description is never replaced",
    )
    # The master has node id 0 here, which no heartbeat has. The default, 127, is the node id of
    # many new drives, whose heartbeats would be taken for those of another master.
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
        advice="Check the power of the drives, the cable, the terminators and the bit rate",
    )
    if out is not None:
        text = "\n".join([*bus_lines(file, nodes, uploads.heard), ""])
        write_text(out, text)
        print(one_line(f"{out}: complete the {text.count(FILL_IN)} lines marked {FILL_IN}"))
