"""Robots with chosen friction terms, their models, and motions and recordings of them."""

import dataclasses
import tomllib

import numpy as np
from conftest import REPLAY

from acquisition.robot import FRICTION, fourier_reference, robot_from_files
from identification.data import Recordings, signals_from_arrays
from identification.design import with_terms
from identification.export import replace_in_tables
from identification.model import (
    SHAPES,
    InverseModel,
    base_parameters,
    described_parameters,
    direct_model,
)
from identification.regression import FilteredMotion, Motion, Overrides, make_problem
from identification.study import Noise, closed_loop, random_reference

USUAL = ["viscous", "coulomb", "offset"]
RECORDED_HZ = 250.0  # of `recorded`, whose noise is as dense as 2 % at 1 kHz
ALL = [*USUAL, "asymmetric", "root", "load", "stribeck"]
# whatever `FRICTION` has, so that a term that is new is tried too
EVERY = [*USUAL, *(kind for kind in SHAPES if kind != "stribeck"), "stribeck"]


def with_friction(text: str, terms) -> str:
    """A description with a list of terms for each joint."""
    others = dict.fromkeys(("viscous", "coulomb", "offset"))
    joints = zip(tomllib.loads(text)["joint"], terms, strict=True)
    return replace_in_tables(
        text, "joint", {joint["name"]: {"friction": own} | others for joint, own in joints}, ""
    )


def described(name: str, terms, more: str = ""):
    """A description of replay_data with a list of terms for each joint, and more parameters."""
    text = with_friction((REPLAY / name / "robot.toml").read_text(), terms)
    text = text.replace('"stribeck"]\n', '"stribeck"]\nstribeck_speed_deg_s = 20\n')
    return robot_from_files({"robot.toml": f"{text}\n{more}".encode()}, f"{name}.toml")


def model_of(robot):
    model = InverseModel(robot)
    base = base_parameters(model)
    return model, base, described_parameters(model, base)


def direct_of(model, base, beta):
    return direct_model(model, base.standard_parameters(beta))


def whole_arm(terms=ALL):
    """The TX40 with these terms at every joint, and values for them."""
    values = {FRICTION[kind].name: 0.2 for kind in terms if kind in {*SHAPES} - {"load"}} | {
        "Fa": 0.1,
        "Fr": 0.7,
        "Fs": 0.4,
    }
    more = "".join(
        f"Off{j} = 0.{j}\nmu{j} = 0.{j + 1}\n"
        + "".join(f"{name}{j} = {value}\n" for name, value in values.items())
        for j in range(1, 7)
    )
    return described("tx40", [terms] * 6, f"{more}Frm6 = 0.5\nFsm6 = 0.3\n")


class Exact(FilteredMotion):
    """A motion known exactly, where that of a recording is filtered."""

    def __init__(self, motion: Motion) -> None:
        self.motion, self._made = motion, {}

    def between(self, start, stop, cutoff_hz):
        m = self.motion
        parts = (np.array(x[start:stop]) for x in (m.t_s, m.q, m.dq, m.ddq, m.tau))
        return Motion(**dict(zip(("t_s", "q", "dq", "ddq", "tau"), parts, strict=True)))


def exact_problem(robot, x, rate_hz=250.0):
    """The identification of a robot from q, dq, ddq (N, n) as they are, and their torque."""
    model, base, known = model_of(robot)
    tau = direct_of(model, base, known).torque(*x)
    signals = signals_from_arrays(x[0], tau, rate_hz, robot)
    problem = make_problem(signals, Overrides(decimation=1, torque_lag_s="none", cutoff_hz=40.0))
    motion = Motion(t_s=np.arange(len(tau)) / rate_hz, q=x[0], dq=x[1], ddq=x[2], tau=tau)
    return dataclasses.replace(problem, motion=Exact(motion)), known


def upright(terms, more: str = ""):
    """The SCARA turned upright, so that its links hang."""
    robot = described("scara", terms, more)
    text = robot.files["robot.toml"].decode()
    return robot_from_files(
        {"robot.toml": ("gravity_m_s2 = [0, -9.81, 0]\n" + text).encode()}, "upright"
    )


def axis(terms, vertical: bool = False, **values: float):
    text = (REPLAY / "emps" / "robot.toml").read_text().split("[parameters]")[0]
    if vertical:
        text = text.replace("alpha_deg = 90", "alpha_deg = 0")
    known = "".join(f"{name}1 = {value}\n" for name, value in {"M": 95.0, **values}.items())
    text = with_friction(f"{text}[parameters]\n{known}", [terms])
    return robot_from_files(
        {
            "robot.toml": text.replace(
                '"stribeck"]', '"stribeck"]\nstribeck_speed_m_s = 0.02'
            ).encode()
        },
        "axis",
    )


def two_speeds(robot, a_m_s2: float, speeds=(0.1, 0.2)):
    """Exact motion of one axis to and fro at two speeds, with jumps of acceleration in
    between: q, dq, ddq (N, 1).
    """
    rate = 250.0
    parts = [np.full(200, sign * speed) for speed in speeds for sign in (1.0, -1.0)] * 3
    dq = np.concatenate(parts)[:, None]
    ddq = a_m_s2 * np.sin(np.arange(len(dq)) / 7.0)[:, None]
    q = np.cumsum(dq, axis=0) / rate
    return exact_problem(robot, (q, dq, ddq), rate_hz=rate)


def recorded(robot, seed: int, duration_s: float):
    """A recording of exact motion, and of torque with 1 % of white noise, by the robot
    without its further terms.
    """
    model, base, beta = model_of(robot)
    t = np.arange(0.0, duration_s, 1 / RECORDED_HZ)
    x = fourier_reference(robot, period_s=duration_s, seed=seed).at(t)
    tau = direct_of(model, base, beta).torque(*x)
    noise = (
        0.01 * np.sqrt((tau**2).mean(axis=0)) * np.random.default_rng(seed).normal(size=tau.shape)
    )
    plain = with_terms(robot, (frozenset(),) * robot.n)
    return signals_from_arrays(x[0], tau + noise, RECORDED_HZ, plain)


NONE, ROOT, LOAD = frozenset(), frozenset({"root"}), frozenset({"load"})
WITHOUT_LAG = Overrides(torque_lag_s="none")


def simulated(robot, *seeds: int):
    """Recordings of a simulated cell by its own description."""
    found = []
    for seed in seeds:
        q = random_reference(robot, duration_s=4.0, sample_rate_hz=1000.0, seed=seed)
        signals = closed_loop(
            robot, q, 1000.0, noise=Noise(encoder_step=1e-6, effort_percent=2.0), seed=seed
        )
        found.append(dataclasses.replace(signals, recording=f"r{seed}.mcap", sha256=f"{seed:064x}"))
    return Recordings(sources=tuple(found))


def moved(robot, *seeds: int, noise: float = 1.0):
    """Recordings of 6 s of exact motion, and of torque with white noise in N or N m."""
    model, base, beta = model_of(robot)
    found = []
    for k in seeds:
        motion = fourier_reference(robot, period_s=6.0, seed=k).at(np.arange(0.0, 6.0, 1e-3))
        tau = direct_of(model, base, beta).torque(*motion)
        tau = tau + np.random.default_rng(k).normal(0, noise, tau.shape)
        signals = signals_from_arrays(motion[0], tau, 1000.0, robot)
        found.append(dataclasses.replace(signals, recording=f"r{k}.mcap", sha256=f"{k:064x}"))
    return Recordings(sources=tuple(found))
