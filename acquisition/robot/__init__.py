"""The robot's description (robot.toml): joints, motors, limits, payload, bus and drives.

It owns the keys of the file and their checks, the rule from motors to joints, the PDOs and codecs
of the drives, and the reference motions within the limits. It may use `protocol` and `files`.
"""

from .bus import (
    BITRATES,
    FILL_IN,
    BusFile,
    DriveFile,
    EffortTiming,
    demand_ripple,
    efforts_of_scan,
    parse_homed,
    ripple_notes,
)
from .description import Joint, RobotFile
from .drives import (
    MAX_LOAD,
    Bus,
    Drive,
    axis_index,
    axis_of,
    check_carriers,
    refuse_load,
    refuse_out_of_range,
)
from .fit_tables import (
    FRICTION,
    Capsule,
    Controller,
    Edges,
    FrictionTerm,
    LowSpeed,
    low_speed_by_method,
)
from .limits import (
    RADIANS_AS_DEGREES,
    EffortLimits,
    check_recorded_efforts,
    check_recorded_positions,
    check_recorded_velocities,
    effort_limits,
)
from .payload import Payload, parse_payload
from .reference import (
    HARMONICS,
    FourierReference,
    approach,
    check_limits,
    follow,
    fourier_reference,
    missing_limits,
    table_reference,
)
from .resolving import resolve
from .robot import (
    HOW_TO_CONFIRM,
    SIMULATED_CONTROLLER,
    Robot,
    lines_to_fill_in,
    load_robot,
    marks_of_motion,
    robot_from_files,
)
from .toml import Positive, note, parse_toml
