"""The demo's session: simulated drives move a simulated robot, and a recording is made.

Simulated CiA 402 drives on an in-process CAN bus move the rigid robot in simulated time. This is the only place where
`identification` gives an object to `acquisition`: the plant that the drives move.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from acquisition.bus import Master
from acquisition.robot import Robot, resolve
from acquisition.session import InlineLog, Recorder, Stop, Task, run_active
from acquisition.simulated import SUBSTEPS, DrivenPlant, LockStepLink, SimulatedDrives, describe_loops

from ..arrays import Array
from ..errors import IdentificationError
from ..model import inertias
from ..simulation import RigidBodyPlant, drive_loops
from .simulated_cell import periodic_reference, true_model

DURATION_S, SEED = 12.0, 1  # of the session; of reference and noise


def record_simulated_session(
    robot: Robot, place: str, out: Path, say: Callable[[str], None], *, noise_percent: float = 3.0
) -> None:
    """Record a session: simulated drives track a random exciting reference with the robot of `[parameters]`.

    `noise_percent` is the noise of the torque, of each joint's rms.

    Raises `IdentificationError` or `AcquisitionError`: if the description lacks `[bus]` or values, or the session
    fails.
    """
    if robot.bus is None:
        raise IdentificationError(place=place, key="[bus]", value=None, expected="the drives to simulate")
    model = true_model(robot)
    period_s = robot.bus.sync_period_s
    t_s: Array = np.arange(round(DURATION_S / period_s) + 1, dtype=np.float64) * period_s
    q_ref, dq_ref, ddq_ref = periodic_reference(robot, duration_s=DURATION_S, seed=SEED).at(t_s)
    tau = model.torque(q_ref, dq_ref, ddq_ref)
    plant = RigidBodyPlant(
        model,
        q_ref[0],
        speed_scale=np.abs(dq_ref).max(axis=0),
        step_s=period_s / SUBSTEPS,
        disturbance=0.01 * noise_percent * np.sqrt(np.mean(tau**2, axis=0)),
        seed=SEED,
    )
    mechanism = DrivenPlant(plant=plant, loops=drive_loops(robot, inertias(model.inertia(q_ref[::50]))))
    bus = resolve(robot, place)
    source = "simulated drives with the rigid robot of [parameters]"
    log = InlineLog(Recorder(out, describe_loops(robot, mechanism.loops), source=source, place=place))
    simulated = LockStepLink(SimulatedDrives(robot, bus, mechanism), tap=log.tap)
    try:
        say(f"simulated drives: {DURATION_S:g} s on the bus")
        outcome = run_active(robot, Master(simulated, bus), log, Task(reference=q_ref, place="reference"), Stop())
        log.finish(simulated.now_ns())
    finally:
        log.close()
    if outcome.fault:
        raise IdentificationError(f"{out}: the simulated session failed: {outcome.reason}")


def description(name: str) -> Path:
    """The description of a robot of this project: `scara` or `tx40`."""
    installed = Path(__file__).parents[1] / "robots" / name / "robot.toml"
    return installed if installed.exists() else Path(__file__).parents[2] / "replay_data" / name / "robot.toml"
