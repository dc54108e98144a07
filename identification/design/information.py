"""Prior information about a robot, and the information of a motion about its base parameters.

The information of a motion is M = sum of W'W / s², s the torque noise of each joint; the deviations
of the parameters are sigma = sqrt(diag(inv(M))). The A-optimal criterion is log(mean((sigma / sigma
of a plain reference)²)).
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

NOISE_SHARE = 0.02  # of a joint's rms torque, if the noise is unknown
NORMAL_QUANTILE = 1.959964  # deviations to each side of a 95 % interval
RANK_SHARE = 1e-9  # of the largest: a smaller singular value is zero
SAMPLE_RATE_HZ = 1000.0  # of a recording, if none is stated


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorInformation:
    """Knowledge about the robot before the motion.

    Attributes:
        beta: (b,) base parameters for the torque; None if unknown.
        beta_from: their origin, in words.
        noise: (n,) given standard deviation of the torque, or None.
        noise_share: (n,) standard deviation in a fit's rows over the rms torque; None without a
            fit.
        payload: that a second recording of the motion will carry, to identify drive gains; None:
            none.
        recordings: earlier ones, whose information is added.
        folder: of the description, searched first for meshes of its URDF.
        warnings: about the fit.
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
    fit: Path | None = None,
    noise: Sequence[float] | None = None,
    after: Sequence[Path] = (),
    payload: Payload | None = None,
) -> PriorInformation:
    """Collect information from files and options: a fit's parameters, else those of the
    description.
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
        recordings=[load_signals(path) for path in after],
        folder=folder,
    )
    if fit is None:
        return known
    stored = report.read_fit(fit)
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
        beta_from=fit.name,
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
    """Return the robot with its parameters, then the same with the payload, which needs them.

    The result is empty without parameters.
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
    """Return the standard deviation (n,) of each joint's torque in a row of the fit, and its origin
    in words.

    It is the given one; else the error of a fit in percent of the torque along `motions`, larger
    where rows are correlated; else a share of that torque; else 1 for each joint, if no parameters
    are known.
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
    """Return the rows per second of a fit, by the decimation rule."""
    rate_hz = (
        1 / robot.bus.sync_period_s
        if robot.bus is not None
        else robot.controller.sample_rate_hz or SAMPLE_RATE_HZ
    )
    return rate_hz / regression.decimation_rule(rate_hz, robot.bandwidth_hz)


def earlier_information(
    base: dynamics.BaseParameters, noise: Array, recordings: Sequence[Signals]
) -> Array:
    """Return the sum of W'W / s² (b, b) over the rows of earlier recordings of the same robot.

    `base` has no load-dependent friction.
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
        model, base: the inverse dynamic model, its base parameters.
        noise: (n,) standard deviation of each joint's torque in a row of the fit, in the unit of
            its
            effort.
        rows: of the fit in the whole recording, whatever the number of samples of a motion.
        earlier: (b, b) information of earlier recordings, which is added.
        creep: (n,) speeds of the smooth sign u / sqrt(u² + creep²) of friction in the criterion: a
            jump
            has no gradient, and a fit leaves out rows of low speed.
    """

    model: dynamics.InverseModel
    base: dynamics.BaseParameters
    noise: Array
    rows: float
    earlier: Array
    creep: Array

    def sigma(self, motion: Motion) -> Array:
        """Return standard errors (b,) of the parameters after a motion q, dq, ddq (N, n)."""
        return np.asarray(np.sqrt(np.diag(_inverse(self._information(self._regressor(motion))))))

    def criterion(self, motion: Motion, plain: Array) -> tuple[float, Motion]:
        """Return the criterion relative to the standard errors `plain` (b,), and its gradients (N,
        n) by q, dq and ddq.
        """
        W, slopes = self._regressor(motion), []
        for c, term in self._sliding:
            friction, slope = term.rounded(motion[1], self.creep)
            W[:, :, c] = friction[:, None] * term.direction
            slopes.append(slope)
        C, D = _inverse(self._information(W)), 1 / plain**2
        total = float(D @ np.diag(C))
        # total = tr(D C), so d total = -tr(P dM) with P = C D C, and dM = 2 W'dW / s².
        G = -2 / total * self.rows / len(W) * (W / self.noise[:, None] ** 2) @ ((C * D) @ C)
        by_q, by_dq, by_ddq = dynamics.regressor_gradient(self.model, self.base, motion, G)
        for (c, term), slope in zip(self._sliding, slopes, strict=True):
            by_dq += (slope * (G[:, :, c] @ term.direction))[:, None] * term.direction
        return float(np.log(total / len(D))), (by_q, by_dq, by_ddq)

    def gain_deviations(
        self, motion: Motion, loads: Sequence[dynamics.DirectModel], payload: Payload
    ) -> Array:
        """Return relative standard errors (n,) of all drive gains, from runs of the motion without
        and with the payload.

        X = [W L -E] of both runs: E from the torques of the robot with each of the two `loads`, L
        of what is not given of the payload. Earlier recordings do not count.
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
        # a row for each stated moment
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
        """Return W (N, n, b)."""
        return self.model.regressor(*motion, self.base.columns)

    def _information(self, W: Array) -> Array:
        V = (W / self.noise[:, None]).reshape(-1, W.shape[-1])
        return np.asarray(V.T @ V * (self.rows / len(W)) + self.earlier)

    @cached_property
    def _sliding(self) -> list[tuple[int, dynamics.JointTerm]]:
        """Columns and terms of friction with the sign of a speed."""
        return [
            (c, term)
            for c, column in enumerate(self.base.columns)
            if (term := self.model.terms.get(column)) and term.kind in dynamics.SLIDING
        ]


def _inverse(M: Array) -> Array:
    """Return the inverse of a positive definite matrix, first scaled to a diagonal of ones."""
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
