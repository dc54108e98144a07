"""Reference trajectories and the way along them; limits, checked before motion."""

from .following import follow
from .reference import (
    HARMONICS,
    LIMIT_SHARE,
    FourierReference,
    approach,
    check_limits,
    fourier_reference,
    table_reference,
)
