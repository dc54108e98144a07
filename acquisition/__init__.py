"""Records joint positions and current references of industrial drives into MCAP files.

The flow::

    robot.toml ──robot, drives──> Robot, Bus ──┐
    drives ──bus, master, session──> frames ───┴──recorder──> recording.mcap ──decoding──> joint samples in it
    tables, CAN logs ──tables, conversions────────────────────────┘

- what is there: ``description`` (TOML), ``robot``, ``bus_description``; ``drives`` resolves it with ``object_dictionary``
  and ``extra_objects``
- protocol without I/O: ``cia402`` (states, raw integers to SI), ``sdo``, ``pdo``, ``error_frames``
- the bus: ``bus`` (the only one that talks to it), ``master``, ``guards``, ``session`` (the only loop), ``record``, ``check``;
  ``listening`` tells who is there before anything is sent, ``homing`` and ``scheduling`` what must hold before motion
- when something is wrong: ``safe_stop`` is the one stop, of the session, of the ``dead_man`` in the recorder's process and
  of ``disabling``; drives supervise the ``master_heartbeat``, and ``supervision`` tells what else they supervise
- the recording: ``recording`` owns the format with ``blocks`` and ``mcap_content``; ``recorder`` writes frames, in
  ``recorder_process`` beside the session; ``decoding`` makes samples of frames, by the ``association`` of PDOs with SYNCs
  and ``sync_times``;
  ``overview`` sums up
- without hardware: ``simulated_node``, ``simulated_supervision``, ``simulated_drives``,
  ``plants``, ``mechanism``, ``dry_run``, ``replay``
- from elsewhere and to elsewhere: ``tables`` with ``table_files`` and ``mat_files``, ``conversions`` with ``can_logs``;
  ``reference`` has trajectories
- ``whole_file`` keeps output files from being half written; ``live_line`` is what a session shows
"""

from collections.abc import Sequence


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, whatever file names and file contents it quotes."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def listed(names: Sequence[str]) -> str:
    """Names for an error that says what was expected; of many the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


class AcquisitionError(Exception):
    """Bad input or a failed session, told in one line: the file, the place, the value and what was expected."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
