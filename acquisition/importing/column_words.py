"""Words and units in the names of columns, in several languages and of several tools."""

import re

from .quantities import EFFORT_UNITS, POSITION_UNITS, TIME_UNITS, VELOCITY_UNITS

_WORDS = {
    "position": "q qpos jpos pos posn position positions angle angles theta winkel lage stellung "
    "posizione angolo posicion angulo posicao 位置 角度",
    "velocity": "dq qd qdot qvel jvel vel velo velocity velocities speed speeds omega "
    "geschwindigkeit drehzahl vitesse velocita velocidad velocidade 速度",
    "torque": "tau torque torques trq moment drehmoment couple coppia par 力矩 扭矩 转矩 トルク",
    "current": "current currents curr strom motorstrom courant corrente corriente 电流 電流",
    "effort": "eff effort efforts",
    "reference": "ref reference references set setpoint setpoints target targets tgt cmd command "
    "commanded des desired d soll "
    "goal consigne consigna riferimento referencia 目标 目標 指令 期望 给定",
    "measured": "act actual ist istwert feedback fb fbk meas measured msr present mesure mesuree "
    "reale real 实际 実際",
    "time": "t time timestamp stamp zeit temps tiempo tempo duration 时间 時間",
    "motor": "m motor motors mot moteur motore encoder enc 电机",
    "joint": "joint joints j axis axes axe achse gelenk asse eje articulation 关节 関節 轴",
    "name": "name names",
    "given": "given",
    "": "a state states robot data value values controller trajectory nc to plc field header",
}
KIND = {word: kind for kind, words in _WORDS.items() for word in words.split()}
AT_JOINT = {"q", "qpos", "jpos", "angle", "angles", "theta", "winkel", "angolo", "angulo", "角度"}
EFFORTS = ("torque", "current", "effort")
GIVEN = "given"  # word in names of columns that a user has given
UR, FRANKA = "UR RTDE", "libfranka"
# Makers by names of columns that only they use.
MAKERS = {
    UR: r"^actual_q_\d",
    FRANKA: r"(^|\.)tau_J[\[_]\d",
    "ROS, REP 103": r"joint_states|controller_state"
    r"|(feedback|reference|actual|desired)[./]positions"
    r"|^field\.position\d",  # `rostopic echo -p` of joint states
}
UNITS = {
    unit.lower(): unit for unit in (*POSITION_UNITS, *VELOCITY_UNITS, *TIME_UNITS, *EFFORT_UNITS)
} | {
    "radian": "rad",
    "radians": "rad",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
    "u/min": "rpm",
    "rads": "rad/s",
    "degs": "deg/s",
    "degps": "deg/s",
    "°/s": "deg/s",
    "\u03bcs": "us",
    "nm": "N m",
    "n*m": "N m",
    "mnm": "mN m",
    "‰": "per mille",
    "permille": "per mille",
    "promille": "per mille",
    "o/oo": "per mille",
}
# Two words of one name without a sign between them, as `qref` and `posAct`.
GLUED = re.compile(
    r"(?<![^\W\d_])(d?q|pos|vel|tau)(ref|des|cmd|set|act|meas|msr|fb)(?![^\W\d_])", re.IGNORECASE
)
TOKEN = re.compile(r"[^\W\d_]+|\d+")
# A unit is in brackets, or a word or a sign of its own.
UNIT = re.compile(
    r"[\[(]([^\])\d]+)[\])]"
    r"|(?<![a-z])(rad_?p?s|deg_?p?s|rad|deg|rpm|n_?m|ma|ms|us|ns|mm)(?![a-z])"
    r"|(?<=[\d\s_])([°‰])(?=[\s_]|$)",
    re.IGNORECASE,
)
