"""A fit on a recording that it was not made from: the description that its parameters belong to."""

from pathlib import Path

from ..data import Signals, load_signals
from ..model import InverseModel, base_parameters
from ..report import StoredFit


def as_fitted(
    signals: Signals, recording: Path, stored: StoredFit, place: str, *, kept: bool
) -> tuple[Signals, list[str]]:
    """The signals of a recording, by the fit's own description where the parameters are not those of the recording's.

    `kept`: the user chose the description. The lines say what a reader must know; `place` names the fit in them.
    """
    other = stored.other_meaning(base_parameters(InverseModel(signals.robot)))
    if not other:
        return signals, []
    names = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
    robot = None if kept else stored.robot(place)
    if robot is None:
        return signals, [
            f"{place}: {names}: perhaps not the same quantities as those of robot {signals.robot.name} here"
        ]
    told = f"{signals.recording}: its description does not have the parameters of the fit ({names}): that of {place} is used"
    return load_signals(recording, robot), [told]
