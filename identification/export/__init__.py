"""Export a fit as URDF, MJCF and robot.toml; make a description from a URDF.

It owns the formats of simulators with a report of what each cannot represent, and the text of a
robot.toml that is made or changed. It may use stored fits, the model, and the control law for
actuators. It reads no recordings, but makes one from a log of another program with its robot.
"""

from .chain import Chain, read_chain
from .description import (
    FILL_IN,
    USES,
    chain_of_letters,
    correct_description,
    describe,
    describe_rows,
    read_robot,
    robot_of_chain,
)
from .exported_model import split_parameters
from .exporting import (
    export_fit,
    export_model,
    model_of_fit,
    replace_in_tables,
    replace_parameters,
    write_models,
)
from .foreign_log import Ask, import_foreign_log
from .formats import make_urdf, quaternion, roll_pitch_yaw
