"""Words of the tests of the estimate: its solution, its parameters, its predictions."""

from collections.abc import Mapping

from .words import Case, Words

_SIGN = "check the sign of effort and position of joint {joint}{or_terms}"
_TERMS = (
    "check friction, rotor and zero of joint {joint}; its signs fit better than turned{or_terms}"
)
_WRONG = "{joint}: effort or position has the wrong sign"
_OFF = Case(
    "caution",
    "{error}: the fit does not generalise ({ratio:.2g} times in weighted rows)",
    "record {more}, with more varied motion, or fit with --essential{consistent}",
    "does not generalise",
)
_APART = Case(
    "caution",
    "{distance}, above {bound:.3g}, the limit of chance",
    "check signs and units of efforts and positions, and frames",
)

OF_ESTIMATE: Mapping[str, Words] = {
    "fixed point": Words(
        wrong="iv does not converge, or the simulated robot does not confirm it",
        advice="check signs, gains, `bandwidth_hz`; record faster motion",
        detects="Whether the passes of iv converge to a fixed point that the simulated robot "
        "confirms. With `instruments: reference` nothing is simulated, and there is one "
        "solution, as by least squares",
        limit="`do not use`: there is no fixed point. `caution`: the simulated robot does not "
        "confirm it",
        cases={
            "none": Case(
                "do not use", "{why}", "check signs, gains, bandwidth_hz; record faster motion"
            ),
            "no simulation": Case("caution", "{why}", "record the reference, check [controller]"),
            "not confirmed": Case(
                "caution", "{why}", "check [controller]; compare with least squares"
            ),
            "least squares": Case("ok", "least squares has one solution"),
            "by reference": Case("ok", "{why}: one solution, less efficient where joints stick"),
            "confirmed": Case("ok", "converged, and the simulated robot confirms it"),
        },
        parts={"caused": "{text}: {cause}?"},
    ),
    "physical": Words(
        wrong="the inertia matrix is not positive, friction feeds energy, a rotor inertia is "
        "negative, or torques lack the robot's weight",
        advice="check what the line names: a sign only where it may be wrong; what the driver "
        "publishes as effort, `gravity_m_s2`",
        detects="Whether M is positive on the trajectory, friction takes energy, and no rotor "
        "inertia is below zero. Joints that share motors are tested together: the viscous "
        "matrix, and Coulomb power at its corners (Fc5 + Fcm6, Fc6 + Fcm6, Fc5 + Fc6 of the "
        "TX40). With further friction terms: the power of each joint alone, and of joints that "
        "share motors, at some 300 recorded speeds. Also whether a model without gravity fits "
        "better: the torques then lack the robot's weight",
        limit="`do not use`: a value is below zero by over two half-widths of the 95 % "
        "interval, or two of a joint by over one each; or the parameters are far from those of "
        "a robot (M not positive, or chi² of `consistent` above three times its limit), and a "
        "witness says why: a negative factor of `prior`, a sign that leaves 95 % of the error "
        "when turned, or more than 20 % held out. `caution`: M is below zero by less, or "
        "friction by over 1.4 half-widths; or a model without gravity leaves less than 90 % of "
        "the residual",
        cases={
            "wrong sign": Case("do not use", "{what}", _SIGN, _WRONG),
            "impossible": Case("do not use", "{what}", _TERMS),
            "noise": Case(
                "caution", "{what}, which may be noise; before simulating run fit --consistent"
            ),
            "perhaps wrong sign": Case("caution", "{what}", _SIGN),
            "doubtful": Case("caution", "{what}", _TERMS),
            "no weight": Case(
                "caution",
                "the torques fit a model without gravity better: residual {without:.3g} % "
                "against {residual:.3g} %: the efforts lack the robot's weight, are no torques, "
                "or gravity_m_s2 is wrong",
            ),
            "ok": Case(
                "ok",
                "M is positive on the trajectory (lowest eigenvalue {value:.3g}), no friction "
                "or rotor inertia is below zero",
            ),
        },
        parts={
            "drives": "friction would drive joint {joint} at {speed:.3g} {length}/s: "
            "{lowest:.3g} ± {half:.2g} {effort} against its motion",
            "inertia": "the inertia matrix is not positive on the trajectory (lowest eigenvalue "
            "{least:.3g}; {lowest:.3g} ± {half:.2g} about joint {joint})",
            "below": "below zero: {each}",
            "or_terms": ", or leave terms out",
            "weighted": "by weighted least squares {text}",
            "far": "{text}; far from a physical robot, and {witness}",
        },
    ),
    "units": Words(
        wrong="joints share a parameter, and their drive gains are not known",
        advice="state `drive_gain`",
        detects="Whether joints share a parameter although their drive gains, and so the units "
        "of their torques, are not known",
        limit="`do not use`: they do",
        cases={
            "known": Case("ok", "torques of all joints are in known units"),
            "shared": Case(
                "do not use",
                "{shared} act at several joints, and the drive gains are not known",
                "state drive_gain, or record with and without a weighed payload and fit with "
                "--gains",
                "drive gains not known",
            ),
            "apart": Case("ok", "drive gains are not known, but no joints share a parameter"),
        },
    ),
    "prior": Words(
        wrong="the torque of a joint is not that of the links in the URDF or `[parameters]`; "
        "columns seem exchanged, a zero off by 90 degrees, or the efforts lack the torque of "
        "links",
        advice="check its drive gain, ratio, units and the order of columns; then the URDF",
        detects="Only printed if the URDF or `[parameters]` describe links, and gains are "
        "known: the torque of each joint over that of these links, with rotor and friction "
        "fitted beside",
        limit="`caution`: a factor is below 0.5 or above 2 beyond its interval, where these "
        "links explain a quarter of what is not rotor or friction; or a mistake, corrected, "
        "lets these links explain the torque far better: exchanged columns, positions in other "
        "units or of another sign, a zero off by 90 or 180 degrees, gravity along another axis; "
        "or factors are near 0 at every joint, as the efforts lack the links' torque. `cannot "
        "tell`: all factors are outside, without a common one: the prior is off everywhere. "
        "Never `do not use`",
        cases={
            "cause": Case(
                "caution", "{cause}? {links} then need the recorded torques", finding="{cause}"
            ),
            "unlike": Case("ok", "no torque is like that of {links}"),
            "ok": Case("ok", "{all_factors}"),
            "links lost": Case(
                "caution",
                "{all_factors}: the efforts lack the links' torque (an external torque, noise, or "
                "a dead channel), or it is another robot's prior?",
                finding="the efforts lack the links' torque",
            ),
            "negative": Case(
                "caution",
                "{off}: effort or position of {negative} has the wrong sign?",
                finding="{negative}: effort or position has the wrong sign",
            ),
            "everywhere": Case("cannot tell", "the prior is off everywhere: {all_factors}"),
            "off": Case(
                "caution",
                "{off}: drive_gain, ratio, unit, a payload, or the prior?",
                finding="{off}",
            ),
        },
        parts={
            "links": "the {source}'s links",
            "all_factors": "torques are {factors} times what {links} need",
            "everywhere": "{all_factors}",
            "some": "{each} what {links} need",
            "torque": "torque of {joint} is {factor:.2g} times",
            "off": "{everywhere}{some}",
            "efforts": "recorded efforts of joints {one} and {other} exchanged",
            "positions": "recorded positions of joints {one} and {other} exchanged",
            "degrees": "position of {one} in rad declared as degrees",
            "sign": "sign of the position of {one}",
            "zero": "zero of joint {one} off by {deg} deg",
            "gravity": "gravity along {axis} of the base (gravity_m_s2)",
        },
    ),
    "halves": Words(
        wrong="both halves differ",
        advice="warm the robot up; look for what changes in time",
        detects="Both halves, fitted separately, differ: the torque changes with time",
        limit="`caution`: a Wald test at 0.1 %",
        cases={
            "undetermined": Case(
                "not made",
                "not made: a half alone does not determine the parameters; record longer",
            ),
            "exact": Case("not made", "not made: the fit is exact"),
            "differ": Case(
                "caution",
                "{wald}: the torque changes with time",
                "warm the robot up, check for drift, fit each half alone",
            ),
            "ok": Case("ok", "{wald}"),
        },
        parts={
            "wald": "Wald {value:.3g} for {count} parameters, p = {p:.2g}; {name} differs most, "
            "by {most:.2g} sigma"
        },
    ),
    "excitation": Words(
        wrong="the motion hardly excites a combination of parameters, as joints on a single "
        "sine do",
        advice="record a more varied motion: `excite` designs one",
        detects="The motion hardly excites a combination of the essential parameters: condition "
        "number of their columns, scaled, with the parameters of the worst direction",
        limit="`caution`: above 50 (a motion of five sines has 7 to 11, a single sine 80 to 100)",
        cases={
            "hardly": Case(
                "caution",
                "a combination of parameters, mostly {names}, is hardly excited: condition "
                "number {value:.3g}, limit {limit:g}",
                "record a more varied motion, as `robot-identify excite` designs one",
                "hardly excited",
            ),
            "ok": Case(
                "ok", "condition number {value:.3g} of the essential parameters (limit {limit:g})"
            ),
        },
    ),
    "added columns": Words(
        wrong="a term is missing or wrong: friction, offset, a rotor, a spring, tilt of "
        "gravity, the zero or the ratio of a joint, a lag of one joint, clocks that run apart, "
        "drifts, hysteresis, a limit of the effort, a brake that drags for a time",
        advice="describe it (`friction`, `offset`, `gravity_m_s2`), record it "
        "([`known_torque`](../acquisition/formats.md#maptoml)), remove its cause",
        detects="A term that the model lacks: asymmetric friction, friction by the root of "
        "speed or by load, offset, drift, a spring, one that is not linear, a limit of the "
        "effort, Stribeck friction, a denied rotor, tilt of gravity, the zero of a joint, gain, "
        "ratio or lag of one joint against the others, a lag that grows because positions and "
        "efforts have two clocks, a torque constant or friction that drifts, hysteresis (Dahl), "
        "friction of a sixth of the time. Lags and clocks are tested in fast rows only. What "
        "explains as much at the same joint is named too: a wrong ratio looks like a rotor",
        limit="`caution`: t is above 5, and the term takes over 2 % of the squared residual (a "
        "spring 10 % where gravity acts on no link, friction of a part of the time 10 %; a lag "
        "instead moves an essential parameter by over one half-width, clocks do one or the "
        "other)",
        cases={
            "every term": Case("not made", "not made: the model has every term that is tried"),
            "missing": Case("caution", "{strongest}{more}", "{each}", "{finding}"),
            "ok": Case(
                "ok", "no missing term found ({tried} tried; strongest: {strongest}){lone}{units}"
            ),
        },
        parts={
            "strongest": "{coefficient}, t = {t:.1f}, {taken:.1f} % of the residual",
            "more": "; {others} more with t above {limit:g}",
            "lone": "; one joint has no relative gain",
            "units": "; relative gains not tried: the drive gains are not known",
        },
    ),
    "held-out blocks": Words(
        wrong="parts of the recording are not predicted by the rest",
        advice="record longer, with more varied motion; `--essential`",
        detects="Five blocks of time, or each of several recordings, predicted by the fit of "
        "the others",
        limit="`caution`: their error is over 1.5 times that of the fit. `do not use`: over 3 "
        "times, and M is not positive",
        cases={
            "few rows": Case(
                "not made",
                "not made: too few rows outside a block for {count} parameters; record longer",
            ),
            "no torque": Case("not made", "not made: no torque"),
            "not predicted": Case("cannot tell", "{without}"),
            "far off": _OFF,
            "off": _OFF,
            "ok": Case("ok", "{error}"),
        },
        parts={
            "lost": "{names} undetermined",
            "resting": "it has no torque",
            "no prediction": "{name} cannot be predicted by the others: {lost}{resting}",
            "of_recordings": " of recordings",
            "and_without": "; {without}",
            "error": "error {value:.3g} %{of_recordings} held out, {training:.3g} % "
            "trained{and_without}",
            "consistent": ", or take the parameters of --consistent, which generalise better",
            "not positive": "{text}; and the inertia matrix is not positive: fit with --consistent",
        },
        unit="%",
    ),
    "consistent": Words(
        wrong="the nearest physical robot is further away than noise explains",
        advice="check signs, units, frames",
        detects="How far the nearest parameters of a physical robot are: chi² over all "
        "parameters, and the largest move in half-widths of the 95 % interval; as by "
        "`--consistent` with its default prior",
        limit="`caution`: further than noise explains (0.1 % level)",
        cases={
            "unknown gains": Case(
                "not made",
                "links cannot be compared: the drive gains are not known",
                "state drive_gain",
            ),
            "none near": Case("cannot tell", "{error}"),
            "far": _APART,
            "apart": _APART,
            "ok": Case("ok", "{distance}"),
        },
        parts={
            "distance": "the nearest physical robot is at chi² = {value:.3g} ({count} "
            "parameters), {name} moved by {moved:.2g} half-widths of its interval"
        },
    ),
    "ends": Words(
        wrong="outliers at an end",
        advice='`edges = "smooth"`; cut the ends off',
        detects="Outliers of moving rows at an end of a recording, as of a bad edge",
        limit="`caution`: one at an end is beyond 30 robust deviations, and twice the largest "
        "elsewhere",
        cases={
            "edge": Case(
                "caution",
                "{outliers}; joint {joint}: largest {elsewhere:.3g}, at the ends {value:.3g}",
                'set edges = "smooth", or cut the ends off (cut_start_samples, cut_end_samples)',
            ),
            "ok": Case("ok", "{outliers}"),
        },
        parts={
            "outliers": "{count} outliers in {rows} moving rows; largest {middle:.3g} robust "
            "deviations (limit {limit:g}), at the ends {ends:.3g}"
        },
    ),
    "essential": Words(
        wrong="no inertia has an interval narrower than itself",
        advice="record faster, longer motion",
        detects="No inertia is determined",
        limit="`caution`: no inertia has an interval narrower than itself",
        cases={
            "ok": Case("ok", "{essential} of {count}"),
            "no inertia": Case(
                "caution",
                "no inertia has an interval narrower than its value",
                "record faster, longer motion",
                "no inertia is determined",
            ),
        },
    ),
    "instruments": Words(
        wrong="weak: first-stage F below 10",
        advice="record faster motion; describe the controller",
        detects="The instruments hardly explain the regressor, or are the regressor itself",
        limit="`caution`: weak, first-stage F below 10. `cannot tell`: they are W itself",
        cases={
            "weak": Case(
                "caution",
                "weak: first-stage F = {value:.2g}, below {limit:g}",
                "record faster motion, check [controller]",
            ),
            "regressor": Case(
                "cannot tell",
                "the instruments are W itself: this is least squares, with the same bias by "
                "position noise",
            ),
            "ok": Case("ok", "strong: first-stage F = {value:.3g}"),
        },
    ),
}
