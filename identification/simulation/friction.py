"""A step of the simulated robot: implicit friction with stick phases, so that light joints do not chatter."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model import DirectModel

STRIBECK = 0.1  # of a direction's speed scale: what Coulomb friction has more at rest falls by exp(-(v/this)²)
STICTION = 1e-3  # of a direction's speed scale: Coulomb friction builds up linearly below this speed
MODE_PASSES = 8  # of the search for which directions stick; nearly always one or two are needed
BRAKE = 1e9  # added to the inertia of a joint that is held: it does not move


class Friction:
    """The robot's equation of motion, its smooth part stepped explicitly and its friction implicitly.

    A step h solves (M + h V / 2) dv = h (tau - bias - V v - Sᵀ f - offset), viscous friction being that of its middle. f in
    each direction slips or sticks. A direction slips at its full Coulomb level, or sticks: then its friction grows linearly up
    to a creep speed `v_s`. The modes of the step before are tried first; a direction that would turn round sticks, one that
    exceeds v_s slips. Friction by the square root of a speed is linearised, its slope being that at v_s below v_s, and taken
    in the middle of the step like viscous friction. Friction by load has the links' torque of the step before.
    """

    def __init__(self, model: DirectModel, fastest: Array, v: Array, h: float, stribeck: float = 0.0) -> None:
        """`fastest` (c,) are the speeds that the directions reach, `v` (n,) the joints' at the start, `h` the step in s.

        Coulomb friction at rest is (1 + stribeck) of its level.
        """
        from scipy.linalg import lapack  # takes as long to import as a fit by least squares

        self._solve = lapack.dposv
        self._model, self._h, self._S = model, h, model.directions
        speed = np.maximum(fastest, 1e-9)
        self._v_s, self._stribeck, self._falls = STICTION * speed, stribeck, STRIBECK * speed
        self._shaped = model.shapes.any()
        self._rigid: Array | None = None  # of the links in the step before
        self._coulomb = (1 + stribeck) * (model.up + model.down) / 2
        self._hold(self._coulomb)
        self._one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
        self._V, self._added = model.viscous, model.rotor + 0.5 * h * model.viscous
        self._turn(np.sign(self._S @ v))

    def _hold(self, level: Array) -> None:
        """Take up the friction at rest `level` (c,), half of the distance between its two directions."""
        self._resists = level > 0
        self._slope = np.where(self._resists, level / self._v_s, 0.0)

    def _turn(self, mode: Array) -> None:
        """Take up the modes (c,): +1 and -1 slip that way, 0 sticks."""
        model, S = self._model, self._S
        self._mode, self._forward = mode, mode[:, None] * S
        stuck = mode == 0
        level = np.where(stuck, (model.up - model.down) / 2, np.where(mode > 0, model.up, -model.down))
        self._stuck, self._level = bool(stuck.any()), level @ S + model.offset
        if self._stribeck:
            self._slips = np.where(stuck, 0.0, self._stribeck * level)
        self._creep = (S.T * (self._slope * stuck)) @ S

    def step(self, q: Array, v: Array, tau: Array, held: NDArray[np.bool_] | None = None) -> Array | None:
        """Speed (n,) after a step under the torque tau, brakes holding joints where `held`; None where M is not positive."""
        h = self._h
        M, bias = self._model.inertia_and_bias(q, v)
        if self._one_sided:
            self._V = self._model.viscous + self._model.viscous_up * (v > 0) + self._model.viscous_down * (v < 0)
            self._added = self._model.rotor + 0.5 * h * self._V
        M = M + self._added
        if held is not None:
            M = M + np.diag(BRAKE * held)
        force = tau - bias - self._V.dot(v)
        near = np.exp(-((self._S.dot(v) / self._falls) ** 2)) if self._stribeck else None
        if self._shaped:
            shape, steepness = self._shapes(bias if self._rigid is None else self._rigid, v)
        added: Array | float = 0.0
        for _ in range(MODE_PASSES):
            level = self._level if near is None else self._level + (near * self._slips) @ self._S
            if self._shaped:
                level = level + (self._mode * shape) @ self._S
                added = 0.5 * h * (self._S.T * (steepness * (self._mode != 0))) @ self._S
            if self._stuck:
                creep = self._creep
                _, dv, info = self._solve(M + added + h * creep, h * (force - level - creep.dot(v)))
            else:
                _, dv, info = self._solve(M + added, h * (force - level))
            if info:
                return None
            w = v + dv
            if not self._stuck and min(self._forward.dot(w).tolist(), default=1.0) > 0:
                break
            after, mode = self._S.dot(w), self._mode
            stuck = mode == 0
            found = np.where(stuck & (np.abs(after) > self._v_s), np.sign(after), mode)
            found = np.where(~stuck & (mode * after < 0), np.where(self._resists, 0.0, -mode), found)
            if (found == mode).all():
                break
            self._turn(found)
        if self._shaped:
            self._rigid = self._model.of_links(q, v, dv / h)
        return np.asarray(w)

    def _shapes(self, rigid: Array, v: Array) -> tuple[Array, Array]:
        """Friction (c,) beside Coulomb's of directions that slip at the speeds v (n,), and its slope by the speed."""
        shapes, v_s = self._model.shapes, self._v_s
        along = self._S.dot(rigid)
        # What sticks is held by as much as slips at the creep speed.
        self._hold(self._coulomb + shapes.friction(v_s, along))
        if self._stuck:
            self._creep = (self._S.T * (self._slope * (self._mode == 0))) @ self._S
        u = np.maximum(np.abs(self._S.dot(v)), v_s)
        return shapes.friction(u, along), shapes.steepness(u)
