"""Prior information about a robot, and the information of a motion about its base parameters.

The information of a motion is M = sum of W'W / s², s the torque noise of each joint; the standard
errors of the parameters are sigma = sqrt(diag(inv(M))). The A-optimal criterion is the logarithm of
the mean square of sigma / sigma of a plain reference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from acquisition.errors import BadInputError, Location
from acquisition.robot import Payload, Robot

from .. import model as dynamics
from .. import regression, report, results
from ..arrays import Array
from ..data import Signals, load_signals
from .limits import Motion

NOISE_SHARE = 0.02  # noise over the rms torque of a joint, if the noise is unknown
NORMAL_QUANTILE = 1.959964  # standard errors to each side of a 95 % interval
RANK_SHARE = 1e-9  # singular values below this share of the largest are zero
SAMPLE_RATE_HZ = 1000.0  # of a recording, if the description gives no rate


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorInformation:
    """Knowledge of the robot before the motion.

    Attributes:
        beta: base parameters for the torque, shape (b,); None if unknown.
        beta_from: origin of `beta`, in words.
        noise: given standard deviation of the torque in a row of the fit, shape (n,), N m or N;
            None if it is not given.
        noise_share: standard deviation in a row of an earlier fit over the rms torque, shape (n,);
            None without a fit.
        payload: payload of a second recording of the motion, to identify drive gains, or None.
        recordings: earlier recordings, whose information is added.
        folder: folder of the description, which is searched first for the meshes of its URDF.
        warnings: warnings about the fit.
    """

    beta: Array | None = None
    beta_from: str = ""
    noise: Array | None = None
    noise_share: Array | None = None
    payload: Payload | None = None
    recordings: Sequence[Signals] = ()
    folder: Path | None = None
    warnings: tuple[str, ...] = ()


def prior_information(
    robot: Robot,
    folder: Path | None = None,
    *,
    fit: Path | report.FitFile | None = None,
    noise: Sequence[float] | None = None,
    after: Sequence[Path | Signals] = (),
    payload: Payload | None = None,
) -> PriorInformation:
    """Collect what is known about the robot from files and arguments.

    The parameters are those of the fit, or else those of the description.

    Parameters
    ----------
    robot : the robot.
    folder : folder of its description, for the meshes of its URDF.
    fit : a fit, or its JSON file, for parameters and noise.
    noise : standard deviation of the torque in a row of the fit, N m or N; one value, or one per
        joint.
    after : earlier recordings, whose information is added.
    payload : payload of a second recording of the motion, to identify drive gains.

    Returns
    -------
    The prior information.

    Raises
    ------
    BadInputError : a file cannot be read, or `noise` has another number of values.
    """
    Location("").require(
        noise is None or len(noise) in (1, robot.n),
        "noise",
        ",".join(f"{x:g}" for x in (() if noise is None else noise)),
        f"one number, or one for each of {robot.n} joints",
    )
    model = dynamics.InverseModel(robot)
    base = dynamics.base_parameters(model)
    known = PriorInformation(
        beta=dynamics.described_parameters(model, base)
        if fit is None and robot.parameters
        else None,
        beta_from="[parameters]",
        noise=None if noise is None else np.ones(robot.n) * noise,
        payload=payload,
        recordings=[load_signals(log) if isinstance(log, Path) else log for log in after],
        folder=folder,
    )
    if fit is None:
        return known
    stored = report.read_fit(fit) if isinstance(fit, Path) else fit
    share, errors = None, stored.joints
    if len(errors) == robot.n and all(
        e.autocorrelation is not None and e.moving_relative_error_percent is not None
        for e in errors
    ):
        # r rows of correlation rho equal r (1 - rho)/(1 + rho) independent ones.
        rho = np.clip([e.autocorrelation or 0.0 for e in errors], 0.0, 0.95)
        share = (
            0.01
            * np.array([e.moving_relative_error_percent for e in errors])
            * np.sqrt((1 + rho) / (1 - rho))
        )
    return replace(
        known,
        beta=results.stored_beta(stored, base, str(fit)),
        beta_from=fit.name if isinstance(fit, Path) else "the fit",
        noise_share=share,
        warnings=(
            *results.terms_without_fit(stored, base, str(fit)),
            *stored.warnings_of(str(fit)),
        ),
    )


def loads_of(
    model: dynamics.InverseModel,
    base: dynamics.BaseParameters,
    knowledge: PriorInformation,
    place: str,
) -> tuple[dynamics.DirectModel, ...]:
    """Return the direct model without a payload and, if there is one, with it.

    The tuple is empty if the parameters are unknown.

    Raises
    ------
    BadInputError : there is a payload, but parameters or drive gains are unknown.
    """
    payload = knowledge.payload
    Location(place).require(
        payload is None or (knowledge.beta is not None and model.robot.gain_known),
        "payload",
        payload and payload.text,
        text="its torque is unknown without parameters and drive gains",
        advice="Add drive_gain to robot.toml, and [parameters] or a fit",
        arguments=("fit",),
    )
    if knowledge.beta is None:
        return ()
    chi = base.standard_parameters(knowledge.beta)
    loads = [chi] if payload is None else [chi, dynamics.add_payload(model, chi, payload)]
    return tuple(dynamics.direct_model(model, x) for x in loads)


def torque_noise(
    robot: Robot,
    model: dynamics.DirectModel | None,
    knowledge: PriorInformation,
    motions: Sequence[Motion],
) -> tuple[Array, str]:
    """Return the standard deviation of the torque noise in a row of the fit.

    It is the first of these that is known: the given one; the relative error of an earlier fit
    times the rms torque along `motions`, larger for correlated rows; a share of this rms torque.
    Without parameters it is 1 N m or N.

    Parameters
    ----------
    robot : the robot.
    model : direct model of the robot; None if its parameters are unknown.
    knowledge : prior information.
    motions : plain motions, for the rms torque.

    Returns
    -------
    The standard deviation, shape (n,), N m or N, and its origin in words.
    """
    if knowledge.noise is not None:
        return knowledge.noise, "as given"
    if model is None:
        return np.ones(robot.n), "assumed as 1 N m or N for each joint"
    rms = np.sqrt(
        np.mean(np.concatenate([model.torque(*motion) for motion in motions]) ** 2, axis=0)
    )
    rms = np.maximum(rms, 1e-6 * rms.max(initial=1e-9))
    assumed = f"{100 * NOISE_SHARE:g} % of the rms torque of the plain references"
    return (
        (NOISE_SHARE * rms, assumed)
        if knowledge.noise_share is None
        else (np.maximum(knowledge.noise_share, 1e-6) * rms, "the torque error of the fit")
    )


def rows_per_s(robot: Robot) -> float:
    """Return the number of rows per second of a fit, by the decimation rule."""
    rate_hz = (
        1 / robot.bus.sync_period_s
        if robot.bus is not None
        else robot.controller.sample_rate_hz or SAMPLE_RATE_HZ
    )
    return rate_hz / regression.decimation_rule(rate_hz, robot.bandwidth_hz)


def earlier_information(
    base: dynamics.BaseParameters, noise: Array, recordings: Sequence[Signals]
) -> Array:
    """Return the information of earlier recordings about the base parameters.

    Parameters
    ----------
    base : base parameters, without load-dependent friction.
    noise : standard deviation of the torque in a row of the fit, shape (n,), N m or N.
    recordings : the recordings.

    Returns
    -------
    The sum of W'W / s² over all rows, shape (b, b).

    Raises
    ------
    BadInputError : a recording has other base parameters.
    """
    M = np.zeros((base.b, base.b))
    for signals in recordings:
        problem = regression.make_problem(signals, regression.Overrides())
        own = problem.base.without(dynamics.load_parameters(problem.base))
        Location(signals.recording).require(
            (own.names, own.units, own.expressions) == (base.names, base.units, base.expressions),
            "robot",
            signals.robot.name,
            text="its base parameters are not those of the described robot",
            advice="Pass recordings of the described robot only",
            arguments=("after",),
        )
        rows = regression.rows_of_recording(*regression.equation_alone(replace(problem, base=own)))
        W, _ = rows.system.weighted(1 / noise)
        M += W.T @ W
    return M


@dataclass(frozen=True, kw_only=True, eq=False)
class Information:
    """The information of motions about the base parameters.

    Attributes:
        model: inverse dynamic model.
        base: base parameters.
        noise: standard deviation of the torque in a row of the fit, shape (n,), in the unit of the
            effort.
        rows: number of rows of the fit per joint in the whole recording, whatever the number of
            samples of a motion.
        earlier: information of earlier recordings, shape (b, b), which is added.
        creep: speeds of the smooth sign u / sqrt(u² + creep²) that replaces the sign of friction,
            shape (n,), because a step has no gradient and a fit has no rows at low speed.
    """

    model: dynamics.InverseModel
    base: dynamics.BaseParameters
    noise: Array
    rows: float
    earlier: Array
    creep: Array

    def sigma(self, motion: Motion) -> Array:
        """Return the standard errors of the parameters after a motion, shape (b,).

        Parameters
        ----------
        motion : positions, speeds and accelerations, shape (N, n) each.
        """
        return np.asarray(np.sqrt(np.diag(inverse(self._information(self._regressor(motion))))))

    def criterion(self, motion: Motion, plain: Array) -> tuple[float, Motion]:
        """Return the criterion of a motion and its gradients.

        Parameters
        ----------
        motion : positions, speeds and accelerations, shape (N, n) each.
        plain : standard errors of the plain references, shape (b,).

        Returns
        -------
        log(mean((sigma / plain)²)), and its gradients by positions, speeds and accelerations, shape
        (N, n) each.
        """
        W, slopes = self._regressor(motion), []
        for c, term in self._sliding:
            friction, slope = term.rounded(motion[1], self.creep)
            W[:, :, c] = friction[:, None] * term.direction
            slopes.append(slope)
        C, D = inverse(self._information(W)), 1 / plain**2
        total = float(D @ np.diag(C))
        # Since total = tr(D C) and C is the inverse of M, d total = -tr(C D C dM) with
        # dM = 2 W'dW / s². This gives the gradient G by the elements of W.
        G = -2 / total * self.rows / len(W) * (W / self.noise[:, None] ** 2) @ ((C * D) @ C)
        by_q, by_dq, by_ddq = dynamics.regressor_gradient(self.model, self.base, motion, G)
        for (c, term), slope in zip(self._sliding, slopes, strict=True):
            by_dq += (slope * (G[:, :, c] @ term.direction))[:, None] * term.direction
        return float(np.log(total / len(D))), (by_q, by_dq, by_ddq)

    def gain_deviations(
        self, motion: Motion, loads: Sequence[dynamics.DirectModel], payload: Payload
    ) -> Array:
        """Return the relative standard errors of all drive gains, shape (n,).

        The motion is run without and with the payload. X = [W L -E] has the rows of both runs: E
        the torques of the motors for each of the two `loads`, L the columns of what is not given of
        the payload. Earlier recordings do not count.

        Parameters
        ----------
        motion : positions, speeds and accelerations, shape (N, n) each.
        loads : direct models without and with the payload.
        payload : the payload.
        """
        moments, half_m = {"MX", "MY", "MZ"}, payload.center_half_width_m
        stated = {"M"} | (moments if payload.center_of_mass_m is not None and not half_m else set())
        columns = [
            x
            for x in zip(dynamics.link_columns(self.model)[-1], dynamics.LINK, strict=True)
            if x[1] not in stated
        ]
        free = self.base.K[:, [column for column, _ in columns]]
        W = (self._regressor(motion) / self.noise[:, None]).reshape(-1, self.base.b)
        others, R = (
            np.block([[W, np.zeros((len(W), free.shape[1]))], [W, W @ free]]),
            self.model.robot.R,
        )
        of_motors = [np.linalg.solve(R.T, model.torque(*motion).T).T for model in loads]
        E = np.concatenate(
            [(x[:, None] * R.T / self.noise[:, None]).reshape(-1, len(R)) for x in of_motors]
        )
        # A given moment with a half-width counts like a measurement, that is, as one more row.
        if payload.center_of_mass_m is not None and half_m and payload.mass_kg:
            at = [self.base.b + k for k, (_, name) in enumerate(columns) if name in moments]
            known = np.eye(others.shape[1])[at] * NORMAL_QUANTILE / (half_m * payload.mass_kg)
            others = np.concatenate([others, known * np.sqrt(len(motion[0]) / self.rows)])
            E = np.concatenate([E, np.zeros((len(at), len(R)))])
        others /= np.maximum(np.linalg.norm(others, axis=0), 1e-300)
        _, s, V = np.linalg.svd(
            E - others @ np.linalg.lstsq(others, E, rcond=RANK_SHARE)[0], full_matrices=False
        )
        V /= np.maximum(s, RANK_SHARE * np.linalg.norm(E))[:, None]
        return np.asarray(np.linalg.norm(V, axis=0) * np.sqrt(len(motion[0]) / self.rows))

    def _regressor(self, motion: Motion) -> Array:
        """Return W, shape (N, n, b)."""
        return self.model.regressor(*motion, self.base.columns)

    def _information(self, W: Array) -> Array:
        V = (W / self.noise[:, None]).reshape(-1, W.shape[-1])
        return np.asarray(V.T @ V * (self.rows / len(W)) + self.earlier)

    @cached_property
    def _sliding(self) -> list[tuple[int, dynamics.JointTerm]]:
        """Columns of the friction terms that have the sign of a speed, and these terms."""
        return [
            (c, term)
            for c, column in enumerate(self.base.columns)
            if (term := self.model.terms.get(column)) and term.kind in dynamics.SLIDING
        ]


def inverse(M: Array) -> Array:
    """Return the inverse of a positive definite matrix, scaled to a diagonal of ones before."""
    with np.errstate(divide="ignore", invalid="ignore"):
        d = 1 / np.sqrt(np.diag(M))
        scaled = M * d[:, None] * d
    try:
        return np.asarray(cho_solve(cho_factor(scaled), np.eye(len(M))) * d[:, None] * d)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise BadInputError(
            "no reference within the limits excites all parameters",
            advice="Widen the limits, or remove friction terms",
        ) from error
