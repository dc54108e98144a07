"""The command `robot-identify`: parse, one library call, print."""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquisition.commands import STATUSES, run_command
from acquisition.errors import AcquisitionError, one_line

from ..errors import IdentificationError
from .options import (
    above_zero,
    add_method_options,
    add_plan_options,
    add_simulation_options,
    cutoffs,
    factors,
    make_folder,
    not_negative,
    positive,
    refuse_clash,
    share,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.status import Status

    from ..data import Signals
    from ..methods import Fit
    from ..model import BaseParameters
    from ..regression import Overrides
    from ..study import Noise


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit status, as `acquisition.commands.command_line.STATUSES` says."""

    def command() -> int | None:
        options = _parser().parse_args(arguments)
        status: int | None = options.run(options)
        return status

    return run_command("robot-identify", (AcquisitionError, IdentificationError), command)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="robot-identify",
        description="Identify the dynamic parameters of a robot from a recording.",
        epilog=STATUSES,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    fit = commands.add_parser("fit", help="base parameters from a recording")
    fit.add_argument("recording", type=Path, metavar="LOG.mcap")
    add_method_options(fit)
    add_plan_options(fit)
    fit.add_argument("--json", type=Path, metavar="FILE", help="write the fit as JSON")
    fit.add_argument("--rrd", type=Path, metavar="FILE", help="write trajectories and fit as a Rerun file")
    fit.set_defaults(run=_fit)

    view = commands.add_parser("view", help="look at a recording that has not been fitted, in Rerun")
    view.add_argument("recording", type=Path, metavar="LOG.mcap")
    add_plan_options(view)
    view.add_argument("-o", "--out", type=Path, metavar="VIEW.rrd", help="file to write (default: LOG.rrd)")
    view.set_defaults(run=_view)

    compare = commands.add_parser("compare", help="parameters of two fits side by side")
    compare.add_argument("a", type=Path, metavar="A.json")
    compare.add_argument("b", type=Path, metavar="B.json")
    compare.add_argument("--rrd", type=Path, metavar="FILE", help="write the comparison as a Rerun file")
    compare.set_defaults(run=_compare)

    validate = commands.add_parser("validate", help="apply a fit to another recording")
    validate.add_argument("fit", type=Path, metavar="FIT.json")
    validate.add_argument("recording", type=Path, metavar="LOG.mcap")
    add_plan_options(validate)
    validate.add_argument("--json", type=Path, metavar="FILE", help="write the errors as JSON")
    validate.add_argument(
        "--max-error-percent", type=above_zero, metavar="P", help="above it, of all rows, the exit status is 3"
    )
    validate.set_defaults(run=_validate)

    base = commands.add_parser("base", help="base parameters of a robot, with their expressions")
    base.add_argument("robot", type=Path, metavar="ROBOT.toml")
    base.add_argument("--json", type=Path, metavar="FILE", help="write them as JSON")
    base.set_defaults(run=_base)

    simulate = commands.add_parser("simulate", help="recording of a simulated robot with known parameters")
    simulate.add_argument("robot", type=Path, metavar="ROBOT.toml", help="description with [parameters]")
    simulate.add_argument("-o", "--out", type=Path, required=True, metavar="LOG.mcap")
    add_simulation_options(simulate)
    simulate.set_defaults(run=_simulate)

    study = commands.add_parser("study", help="Monte-Carlo on a simulated robot: what to trust of least squares and iv")
    study.add_argument("robot", type=Path, metavar="ROBOT.toml", help="description with [parameters]")
    study.add_argument("--runs", type=positive, default=100, metavar="N", help="default 100")
    study.add_argument("--cutoffs", type=cutoffs, default=(5.0, 10.0, 0.0), metavar="A,B,none", help="x bandwidth")
    study.add_argument(
        "--starts", type=factors, default=(0.05, 1.0, 20.0), metavar="A,B", help="x each joint's true inertia"
    )
    study.add_argument("--gain-errors", type=factors, default=(0.7, 1.0, 1.3), metavar="A,B", help="x true gains")
    study.add_argument("--low-speed-percent", type=share, metavar="P", help="as of fit")
    add_simulation_options(study, encoder_step=1e-5, effort_noise_percent=2.0)
    study.add_argument("--json", type=Path, metavar="FILE", help="write every run as JSON")
    study.add_argument("--rrd", type=Path, metavar="FILE", help="draw every run's error as a Rerun file")
    study.set_defaults(run=_study)

    demo = commands.add_parser("demo", help="simulated drives, a recording, a fit against the truth")
    demo.add_argument(
        "--out", type=Path, default=Path("session"), metavar="DIR", help="folder for results (default: session)"
    )
    demo.add_argument("--robot", choices=["scara", "tx40"], default="tx40", help="default tx40")
    demo.add_argument(
        "--noise", type=not_negative, default=3.0, metavar="P", help="torque noise, %% of rms (default 3)"
    )
    demo.set_defaults(run=_demo)
    return parser


def _overrides(options: argparse.Namespace) -> "Overrides":
    from ..regression import Overrides

    return Overrides(
        cutoff_hz=options.cutoff_hz,
        decimation=options.decimate,
        span="all" if options.all_samples else None,
        low_speed_percent=getattr(options, "low_speed_percent", None),  # only a fit has it
    )


def _load(options: argparse.Namespace) -> "Signals":
    from acquisition.robot import load_robot

    from ..data import load_signals

    return load_signals(options.recording, load_robot(options.robot) if options.robot else None)


def _untrusted(reasons: Sequence[str]) -> int:
    """The exit status of a result; one that is not to be trusted has a line on stderr that says why."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0


def _fit(options: argparse.Namespace) -> int:
    for name in ("start", "tolerance_percent", "max_iterations"):
        if options.method != "iv" and getattr(options, name) is not None:
            told = f"--{name.replace('_', '-')} {getattr(options, name)}"
            raise IdentificationError(
                f"{told}: does nothing with --method {options.method}: expected --method iv with it"
            )
    inputs = [options.recording, options.robot, Path(options.start or "regular")]
    refuse_clash(inputs, options.json)
    refuse_clash(inputs, options.json, options.rrd, folders=False)
    with _progress() as status:
        from ..report import fit_json, fit_tables, write_json

        status.update("reading")
        signals = _load(options)
        status.update("fitting")
        fit = _identify(options, signals, status.update)
    try:
        if options.json:
            write_json(options.json, fit_json(signals, fit))
        if options.rrd:
            with _progress() as status:
                status.update("writing the Rerun file")
                from ..methods import identify_ls
                from ..view import write_fit_rrd

                beside = identify_ls(signals, _overrides(options), essential=options.essential) if fit.iv else None
                write_fit_rrd(options.rrd, signals, fit, beside=beside)
    finally:  # a file that cannot be written must not cost its fit
        _print(fit_tables(signals, fit))
    return _untrusted(fit.distrust)


def _identify(options: argparse.Namespace, signals: "Signals", say: Callable[[str], None]) -> "Fit":
    from ..methods import Iteration, identify_iv, identify_ls
    from ..report import read_fit

    if options.method != "iv":
        return identify_ls(signals, _overrides(options), method=options.method, essential=options.essential, say=say)
    values = None
    start = options.start or "regular"
    if start not in ("regular", "ls"):
        stored = read_fit(Path(start))

        def values(base: "BaseParameters") -> "NDArray[np.float64]":
            return stored.beta(base, start)

    given = {name: getattr(options, name) for name in ("tolerance_percent", "max_iterations")}
    iteration = Iteration(
        start=start, values=values, **{name: value for name, value in given.items() if value is not None}
    )
    return identify_iv(signals, _overrides(options), iteration, essential=options.essential, say=say)


def _view(options: argparse.Namespace) -> None:
    out = options.out or Path(str(options.recording).removesuffix(options.recording.suffix) + ".rrd")
    refuse_clash([options.recording, options.robot], out)
    with _progress() as status:
        from ..view import write_recording_rrd

        status.update("reading")
        signals = _load(options)
        status.update("writing the Rerun file")
        write_recording_rrd(out, signals, _overrides(options))
    _print(f"look at it: rerun --bind 127.0.0.1 {out}")


def _compare(options: argparse.Namespace) -> None:
    from ..report import difference_table, doubts, frame_lines, read_fit, values_of_stored

    refuse_clash([options.a, options.b], options.rrd)
    same = options.a.stem == options.b.stem
    labels = [str(path) if same else path.stem for path in (options.a, options.b)]
    fits = [read_fit(path) for path in (options.a, options.b)]
    a, b = (values_of_stored(fit, label) for fit, label in zip(fits, labels, strict=True))
    told = [*doubts(fits[0], str(options.a)), *doubts(fits[1], str(options.b))]
    told += frame_lines(fits[0], fits[1], (labels[0], labels[1]))
    if options.rrd:
        from ..view import write_comparison_rrd

        write_comparison_rrd(options.rrd, a, b)
    _print(difference_table(a, b), *(f"warning: {text}" for text in told))


def _validate(options: argparse.Namespace) -> int:
    refuse_clash([options.fit, options.recording, options.robot], options.json)
    with _progress() as status:
        from ..methods import validate
        from ..report import doubts, errors_json, errors_table, plan_json, plan_lines, provenance, read_fit, write_json
        from .validation import as_fitted

        status.update("reading")
        stored, signals = read_fit(options.fit), _load(options)
        signals, told = as_fitted(signals, options.recording, stored, str(options.fit), kept=options.robot is not None)
        status.update("predicting")
        overrides = _overrides(options).over(stored.settings(signals.sample_rate_hz))
        plan, errors = validate(signals, overrides, lambda base: stored.beta(base, str(options.fit)))
    units = signals.robot.effort_units
    warnings = [*plan.warnings, *told, *doubts(stored, str(options.fit))]
    if options.json:
        content = {"fit": options.fit.name, **errors_json(errors, units), **plan_json(signals, plan)}
        write_json(options.json, {**content, "warnings": warnings, "provenance": provenance(signals)})
    _print(errors_table(errors, units), *plan_lines(signals, plan), *(f"warning: {text}" for text in warnings))
    error, most = errors[-1].relative_error_percent, options.max_error_percent
    if most is None or (error is not None and error <= most):
        return 0
    found = "no torque to compare with" if error is None else f"relative torque error {error:.4g} %"
    return _untrusted([f"{options.fit} on {options.recording}: {found}: expected at most {most:g} %"])


def _base(options: argparse.Namespace) -> None:
    refuse_clash([options.robot], options.json)
    with _progress() as status:
        from acquisition.robot import load_robot

        from ..model import InverseModel, base_parameters
        from ..report import base_json, base_table, write_json

        status.update("base parameters")
        robot = load_robot(options.robot)
        base = base_parameters(InverseModel(robot))
    if options.json:
        write_json(options.json, {"robot": robot.name, "parameters": base_json(base)})
    _print(base_table(base, robot.name))


def _simulate(options: argparse.Namespace) -> None:
    refuse_clash([options.robot], options.out)
    with _progress() as status:
        from acquisition.robot import load_robot

        from ..study import closed_loop, random_reference, write_signals

        status.update("simulating")
        robot = load_robot(options.robot)
        q_ref = random_reference(
            robot, duration_s=options.duration_s, sample_rate_hz=options.rate_hz, seed=options.seed
        )
        signals = closed_loop(robot, q_ref, options.rate_hz, noise=_noise(options), seed=options.seed)
        write_signals(options.out, signals, source=f"simulated: random reference and noise of seed {options.seed}")
    _print(f"{options.out}: simulated, {options.duration_s:g} s at {options.rate_hz:g} Hz")


def _noise(options: argparse.Namespace) -> "Noise":
    from ..study import Noise

    position, effort = options.position_noise, options.effort_noise_percent
    return Noise(encoder_step=options.encoder_step, position=position, effort_percent=effort)


def _study(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import track

    from acquisition.robot import load_robot

    from ..report import study_notes, study_table, write_json
    from ..study import Study, run_study, study_json, study_truth

    refuse_clash([options.robot], options.json, options.rrd)
    robot = load_robot(options.robot)
    study = Study(
        runs=options.runs,
        noise=_noise(options),
        cutoffs=options.cutoffs,
        starts=options.starts,
        gain_errors=options.gain_errors,
        duration_s=options.duration_s,
        sample_rate_hz=options.rate_hz,
        low_speed_percent=options.low_speed_percent,
        seed=options.seed,
    )
    base, true = study_truth(robot)
    err = Console(stderr=True)
    each = run_study(robot, study)
    runs = list(track(each, "runs", study.runs, console=err, transient=True, disable=not err.is_terminal))
    if not any(run.error_ls > 0 for run in runs):
        raise IdentificationError(f"{options.robot}: no run can be fitted: {runs[0].reason}")
    notes = study_notes(study)
    try:
        if options.json:
            write_json(options.json, study_json(study, runs, base.names, true))
        if options.rrd:
            from ..view import write_study_rrd

            write_study_rrd(options.rrd, robot.name, runs, true, notes)
    finally:  # a file that cannot be written must not cost an hour of runs
        _print(study_table(robot.name, runs, true), *notes)


def _demo(options: argparse.Namespace) -> None:
    with _progress() as status:
        from acquisition.files import whole_file
        from acquisition.robot import load_robot

        from ..data import load_signals
        from ..methods import Iteration, identify_iv, identify_ls
        from ..regression import Overrides
        from ..report import fit_json, fit_tables, truth_json, truth_table, write_json
        from ..study import Rehearsal, description, rehearse, study_truth
        from ..view import write_fit_rrd

        place, out = description(options.robot), options.out
        robot = load_robot(place)
        make_folder(out)
        with whole_file(out / "session.mcap") as recording:
            rehearse(robot, str(place), recording, Rehearsal(noise_percent=options.noise), status.update)
        signals = load_signals(out / "session.mcap")
        base, true = study_truth(robot)
        write_json(out / "truth.json", truth_json(robot.name, base, true))
        fits = {}
        status.update("least squares")
        fits["ls"] = identify_ls(signals, Overrides())
        fits["iv"] = identify_iv(signals, Overrides(), Iteration(), say=status.update)
        for name, fit in fits.items():
            write_json(out / f"{name}.json", fit_json(signals, fit))
        status.update("writing the Rerun file")
        write_fit_rrd(out / "demo.rrd", signals, fits["iv"], beside=fits["ls"], truth=true)
    for fit in fits.values():
        _print(fit_tables(signals, fit))
    _print(truth_table(list(fits.values()), true))
    _print(f"look at it: rerun --bind 127.0.0.1 {out / 'demo.rrd'}")


@contextmanager
def _progress() -> Iterator["Status"]:
    """A line on stderr, on a terminal only, that says what is being done."""
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield status


def _print(*items: Any) -> None:
    from ..report import print_whole

    print_whole(*items)
