"""What a fit rests on that none of its tests can see: given by the user, and taken as it is."""

from collections.abc import Iterator, Mapping

import numpy as np

from .evidence import Evidence
from .lines import Assumed, TrustLine


def assumed(evidence: Evidence, lines: Mapping[str, TrustLine]) -> tuple[Assumed, ...]:
    """What was given and not tested, of the tests that were made."""
    return tuple(_assumed(evidence, lines))


def _assumed(evidence: Evidence, lines: Mapping[str, TrustLine]) -> Iterator[Assumed]:
    signals, several = evidence.problem.signals, evidence.problem.signals.robot.n > 1
    robot = signals.robot
    if robot.gain_known:
        gains = [f"{m.drive_gain:g} {m.drive_gain_unit}" for m in robot.motors if m.drive_gain is not None]
        yield Assumed(
            what="drive gains",
            value=", ".join(gains)
            or f"torques recorded in {' and '.join(sorted({m.recorded_unit for m in robot.motors}))}",
            why="a wrong one scales all parameters, and fits as well"
            + (", where it is that of all joints" if several else ""),
        )
    ratios = ", ".join(f"{x:g}" for x in np.diag(robot.R))
    yield Assumed(what="ratios", value=ratios, why="positions and torques at the joints are made with them")
    if several:
        yield Assumed(
            what="lengths",
            value="urdf" if robot.urdf is not None else "dh",
            why="the parameters of the links absorb an error of a length",
        )
    yield Assumed(
        what="sample rate", value=f"{signals.sample_rate_hz:g} Hz", why="speeds and accelerations scale with it"
    )
    if evidence.method == "iv" and lines["replay"].level == "not made":
        yield Assumed(
            what="control law",
            value=robot.controller.structure or f"a PD of {robot.bandwidth_hz:g} Hz stands in",
            why=lines["replay"].text.removeprefix("not made: "),
        )
    if evidence.lags and evidence.lags[0].prior.stated:
        yield Assumed(what="lag", value=f"{evidence.lags[0].value_s:g} s", why="stated by torque_lag_s")
    if evidence.method != "iv":
        yield Assumed(
            what="white encoder noise",
            value="above and below the low-pass",
            why="least squares is biased by noise of the position, and the line position noise takes it for white",
        )
