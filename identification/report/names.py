"""Names of the parameters of a fit, built and read here alone.

    Fv1          a base parameter, common to all recordings
    Fv1@A        that of the recording A alone, a per-recording parameter
    MX:loaded    of the payload on the recording `loaded`; MXR:loaded with others regrouped into it
    K:motor_1    the gain of a drive, as a factor on the described one
    mu1          a base parameter of load friction

Names of recordings and motors may have either sign in them: the first one in a name counts.
"""

import re
from collections.abc import Callable
from functools import partial

_Question = Callable[[str], re.Match[str] | None]

# of the robot, not of a payload or a gain
is_base: _Question = re.compile(r"[^:@]*(@|$)").match
# a base parameter of one recording alone
is_own: _Question = re.compile(r"[^:@]*@").match
is_gain: _Question = re.compile(r"K:").match
is_load: _Question = re.compile(r"mu").match
# the name without its recording: Off1 of Off1@A
base_name: Callable[[str], str] = partial(re.compile(r"\A([^:@]*)@.*", re.DOTALL).sub, r"\1")


def own_name(base: str, recording: str) -> str:
    """Name a base parameter of one recording alone."""
    return f"{base}@{recording}"


def payload_name(parameter: str, recording: str) -> str:
    """Name a parameter of the payload on a recording."""
    return f"{parameter}:{recording}"


def gain_name(motor: str) -> str:
    """Name the gain of a motor's drive."""
    return f"K:{motor}"


def motor_of(gain: str) -> str:
    """Return the motor of the drive whose gain has this name."""
    return gain.partition(":")[2]


def recording_of(name: str) -> str:
    """Return the recording that a base parameter is of alone; empty for a common one."""
    return name.partition("@")[2] if is_own(name) else ""


def payload_parameter(name: str) -> str:
    """Return the parameter without the recording of its payload: MX of MX:loaded."""
    return name.partition(":")[0]
