"""Records joint positions and current references of industrial drives into MCAP files.

The flow::

    robot.toml ──robot──> Robot ──┐
    tables (CSV, MAT) ──tables────┴──> recording.mcap (raw data, robot description, health)

``robot`` says what the robot is, ``recording`` owns the file format with ``blocks``, its rows, and ``mcap_content``,
the container; ``tables`` imports recordings made elsewhere through ``table_files``; ``overview`` sums a recording up;
``whole_file`` keeps output files from being half written.
"""


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, whatever file names and file contents it quotes."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


class AcquisitionError(Exception):
    """Bad input or a failed session, told in one line: the file, the place, the value and what was expected."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
