"""A fit builds the model, solves least squares and filters the recording
once for itself and once for its torque errors, with all its files.
"""

import pytest
from conftest import REPLAY

import identification.methods.iteration as iteration
import identification.methods.start as start
import identification.regression.motion as motion
from identification.commands import main
from identification.model import InverseModel


@pytest.mark.parametrize(
    ("options", "filters", "solutions"),
    [
        # Two solutions choose the ramps of the weights.
        ([], 3, 3),
        # The span of motion, the weights and the controller's inertias go by the rule's low-pass,
        # least squares with it.
        (["--cutoff-hz", "none"], 3, 4),
        (["--cutoff-hz", "40"], 4, 4),
    ],
)
def test_fit_with_all_files(tmp_path, monkeypatch, options, filters, solutions):
    calls = {"model": 0, "filter": 0, "least squares": 0}

    def counted(name, function):
        def count(*arguments, **named):
            calls[name] += 1
            return function(*arguments, **named)

        return count

    monkeypatch.setattr(InverseModel, "__init__", counted("model", InverseModel.__init__))
    monkeypatch.setattr(motion, "lowpass", counted("filter", motion.lowpass))
    for room in (start, iteration):  # the former names the solver
        monkeypatch.setattr(
            room, "weighted_least_squares", counted("least squares", room.weighted_least_squares)
        )
    files = ["--json", str(tmp_path / "fit.json"), "--rrd", str(tmp_path / "fit.rrd")]
    recording = REPLAY / "scara" / "session.mcap"
    assert main(["fit", str(recording), "--method", "iv", *files, *options]) == 0
    assert calls == {"model": 1, "filter": filters, "least squares": solutions}
