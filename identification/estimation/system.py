"""The over-determined system that estimators take."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Y = W beta + rho, equations (5) and (6) of Janot2014: rows stacked joint by joint, and which of them count.

    Attributes:
        W: (r, b) regressor.
        Y: (r,) torques.
        joint_of_row: (r,) joint index of each row, ascending.
        names: (b,) parameters.
        used: (r,) 1 for rows that count, 0 for others.
        rows: (n,) samples per joint that count; more than rows of W where these are QR factors of the samples.
    """

    W: Array
    Y: Array
    joint_of_row: NDArray[np.intp]
    names: tuple[str, ...]
    used: Array
    rows: NDArray[np.intp]

    def __post_init__(self) -> None:
        r, b = self.W.shape
        if {self.Y.shape, self.joint_of_row.shape, self.used.shape} != {(r,)} or len(self.names) != b:
            raise ValueError(f"shapes do not agree: W {self.W.shape}, Y {self.Y.shape}, {len(self.names)} parameters")

    @classmethod
    def whole(cls, W: Array, Y: Array, joint_of_row: NDArray[np.intp], names: tuple[str, ...]) -> "System":
        """A system all of whose rows are samples that count."""
        rows = np.bincount(joint_of_row)
        return cls(W=W, Y=Y, joint_of_row=joint_of_row, names=names, used=np.ones(len(Y)), rows=rows)

    def with_rows(self, used: Array) -> "System":
        """The same system with the rows that count given anew, `used` (r,) of 1 and 0."""
        counts = np.bincount(self.joint_of_row, weights=used, minlength=len(self.rows))
        return replace(self, used=used, rows=counts.astype(np.intp))

    def with_columns(self, columns: NDArray[np.intp]) -> "System":
        """The same system for some of its parameters."""
        if len(columns) == len(self.names):
            return self
        return replace(self, W=self.W[:, columns], names=tuple(self.names[i] for i in columns))

    def weighted(self, weights: Array) -> tuple[Array, Array]:
        """W (r, b) and Y (r,) with rows of joint j times `weights` (n,), and zero where they do not count."""
        w = weights[self.joint_of_row] * self.used
        return self.W * w[:, None], self.Y * w
