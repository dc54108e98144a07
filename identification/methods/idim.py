"""Identification by the inverse dynamic model, with least squares or instrumental variables.

Equation numbers are those of Janot2014: A. Janot, P.-O. Vandanjon, M. Gautier, "An instrumental
variable approach for rigid industrial robots identification", Control Engineering Practice 25
(2014) 85-101. Letters (A) to (I) are those of identification/docs/method.md.
"""

from dataclasses import replace
from typing import Literal

from ..data import Recordings, Signals
from ..errors import BadInputError, NoFitError
from ..estimation import intervals_of, one_thread
from ..regression import Overrides
from ..report import Method
from ..trust import FIXED_POINT
from .iteration import Iteration, Loop, by_reference, conclude, next_values, tests_of
from .model import Model, ProgressCallback, read_model
from .passes import Pass
from .solution import Solution, inputs_of, position_noise_line, solution_by_instruments, status_of
from .start import at_gains, least_squares, solution_of, step_of, with_best_ramps


@one_thread
def solve(
    signals: Signals | Recordings,
    overrides: Overrides,
    *,
    method: Method | None = None,
    iteration: Iteration | None = None,
    essential: bool = False,
    say: ProgressCallback = lambda text: None,
) -> Solution:
    """Solve for the base parameters beta (b,) from measured torque and position.

        tau = IDM(q, dq, ddq) beta                                                       (2)
        Y = W beta + rho,     Y = F[w Y_fm],     W = F[w W_fm]                           (6)
        wls: min |S (Y - W beta)|²,     S = 1/s_j in rows of joint j                     (B)
        iv: beta_k+1 = (Z'W)⁻¹ Z'Y,     Z = F[w IDM(q_s, dq_s, ddq_s)]                   (D)

    Parameters
    ----------
    signals : the recording, or several recordings of one robot; each is filtered and decimated
        separately.
    overrides : settings that replace those of the description; `Overrides()` for none.
    method : `iv`, instrumental variables; `wls`, least squares with rows weighted by joint; `ols`,
        least squares without weights. Default: `iv` if every recording has its reference, else
        `wls`.
    iteration : start and end of the iterations of `iv`.
    essential : True to fit only the essential parameters.
    say : called with a line of text for each step.

    Returns
    -------
    The solution, with the inputs of its tests. The status of least squares is `solved`. The status
    of `iv` is `converged` only if two iterations agree and the robot simulated with the estimate
    follows the recording, or if the instruments from the reference suffice alone.

    Raises
    ------
    NoFitError : a recording is too short, the recordings excite too little, or the first iteration
        gives no estimate.
    BadInputError : the recordings are not of one robot, or an `iteration` is given for least
        squares.
    """
    # Equations (1), (2), (H), (I): tau = IDM(q, dq, ddq) beta, its terms and the unknowns x.
    model, by, reason = _read(signals, overrides, method, iteration, say)
    model, found = least_squares(*with_best_ramps(model, instruments=by == "iv"), by)  # (B)
    if by == "iv" and _can_be_simulated(model, found):
        try:
            loop = Loop(
                model, at_gains(model, found), iteration or Iteration(), essential=essential
            )
            # Its rows take as much memory as those of an iteration.
            del found
            solution = _by_instruments(loop, say)
        except NoFitError as error:
            if method is None and not overrides.gains:
                error.advice, error.arguments = "Use least squares: wls", ["method"]
            raise
    else:
        solution = _by_measured_motion(model, found, by, essential=essential)
    return replace(solution, method_reason=reason)


def _read(
    signals: Signals | Recordings,
    overrides: Overrides,
    method: Method | None,
    iteration: Iteration | None,
    say: ProgressCallback,
) -> tuple[Model, Method, str]:
    """Return the model, the method, and the reason for this method.

    Drive gains always need instruments. Else the default is instruments if every recording has its
    reference.
    """
    if overrides.gains and method not in (None, "iv"):
        raise BadInputError(
            "least squares biases drive gains towards zero",
            key="method",
            value=method,
            advice="Use iv, or do not estimate gains",
            arguments=("gains",),
        )
    model = read_model(signals, replace(overrides, method="iv" if overrides.gains else method), say)
    by, reason = (method, "as requested") if method is not None else _default_method(model)
    by = "iv" if overrides.gains else by
    least = model.problems[0].settings.low_speed
    low = least.iv if by == "iv" else least.ls
    # Recordings with and without a reference are read with different limits of low speed, but one
    # method needs one limit.
    if any(problem.settings.low_speed_percent != low for problem in model.problems):
        model = read_model(signals, replace(overrides, method=by), say)
    if iteration is not None and by != "iv":
        raise BadInputError(
            f"is used ({reason}), but only instrumental variables iterate",
            key="method",
            value=by,
            advice="Use iv",
        )
    return model, by, reason


def _default_method(model: Model) -> tuple[Literal["iv", "wls"], str]:
    """Return the default method and its reason."""
    if model.exogenous:
        return "iv", "reference recorded"
    without = [problem.signals for problem in model.problems if problem.signals.q_ref is None]
    return "wls", "no reference" + (
        f" in {without[0].recording}" if len(model.problems) > 1 else ""
    )


def _can_be_simulated(model: Model, found: Pass) -> bool:
    """Test whether the robot can be simulated.

    With given drive gains it always can. Estimated drive gains must be positive and converged, and
    all references must be recorded.
    """
    gains = model.x_of(found.estimate, found.x)[model.unknowns.gains]
    return not model.unknowns.motors or (
        model.exogenous and found.parameters_settled and bool((gains > 0).all())
    )


def _by_measured_motion(model: Model, found: Pass, method: Method, *, essential: bool) -> Solution:
    """Solve by IDIM-LS: W and Y follow from the measured torque and the filtered position.

    Only the instruments of drive gains differ: they are the torques that x predicts, equation (I).
    """
    x, gains = model.x_of(found.estimate, found.x), model.unknowns.motors
    rows = model.rows(x, model.candidates(x, (found.kept.speed, found.kept.most)))
    # The tests need the estimate of exactly these rows, not of those one step before.
    estimate = step_of(model, rows, method)
    found = replace(
        found, x=x, rows=rows, estimate=estimate, intervals=intervals_of(rows.system, estimate)
    )
    x = model.x_of(estimate, x)
    full, ls, kept = solution_of(model, at_gains(model, found), essential=essential)
    solved = replace(found, tau_predicted=model.predicted(x)) if gains else ls
    inputs = inputs_of(model, method, solved, x, full.estimate, kept)
    if gains:
        line = {
            "convergence": FIXED_POINT.judge(
                {"none": not found.parameters_settled, "no simulation": True},
                why="drive gains from the measured motion: the robot cannot be simulated "
                + ("with them" if model.exogenous else "without a recorded reference"),
            )
        }
    else:
        alone = model.unknowns.plain and not len(model.load)
        # The first recording is enough, as the test uses only the first minutes of a long one.
        first = inputs.problem.with_samples()
        line = {"noise bias": position_noise_line(first, method, ls, kept, alone=alone)}
    inputs = replace(inputs, made={**inputs.made, **line})
    return Solution(model=model, x=x, inputs=inputs, least_squares=ls, essential=kept)


def _by_instruments(loop: Loop, say: ProgressCallback) -> Solution:
    """Solve by IDIM-IV, with instruments Z along the motion of the simulated robot.

        Z = F[w IDM(q_s, dq_s, ddq_s)],     beta_k+1 = (Z'W)⁻¹ Z'Y                       (D)

    W and Y are those of IDIM-LS. Each iteration simulates the closed loop with beta_k, under the
    recorded reference and the control law, with controller gains by equation (E). It evaluates and
    decimates Z as W, estimates the delay of the torque with the same instruments, equation (G), and
    solves for beta_k+1.
    """
    model, passes, failure = loop.model, [loop.start], None
    while not passes[-1].is_last and len(passes) <= loop.most:
        x, asked = next_values(loop, passes)
        passes = [one.without_rows() for one in passes]
        say(f"iteration {len(passes)}: simulating the robot")
        try:
            passes += [loop.next_pass(passes, x, asked)]
        except NoFitError as error:
            failure = f"iteration {len(passes)}: {error}"
            if len(passes) == 1:
                raise NoFitError(
                    f"instruments cannot be computed: {failure}", place=", ".join(model.recordings)
                ) from error
            break
    best, confirmed = conclude(loop, passes)
    tests, passes = tests_of(best), [one.without_rows() for one in passes]
    ended = status_of(model, passes[-1], (best, confirmed), tests[1], failure)
    if (alone := by_reference(loop, best, ended)) is not None:
        best, confirmed = replace(alone, number=len(passes)), alone.z
        passes, tests = [*passes, best.without_rows()], tests_of(best)
        ended = status_of(model, best, (best, confirmed), tests[1], None)
    return solution_by_instruments(loop, (best, confirmed), passes, ended, tests)
