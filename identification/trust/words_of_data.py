"""Words of the tests of the data: columns, rows, drives, and what they carry."""

from collections.abc import Mapping

from .words import Case, Words

OF_DATA: Mapping[str, Words] = {
    "signs and order": Words(
        wrong="two efforts are exchanged, or an effort or a position has the wrong sign; with "
        "the torque error once that is undone",
        advice="correct columns and signs in `map.toml`, import again",
        detects="Only printed if efforts of two motors or joints are exchanged, or an effort or "
        "a position of a motor has the wrong sign. Where a joint's torque error is over 5 %, or "
        "a motor takes power from the robot over the recording, each such mistake is undone and "
        "least squares solved again",
        limit="`do not use`: a mistake undone leaves half of the torque error at most; of a "
        "sign of a motor that takes power, 95 %",
        cases={
            "mistake": Case(
                "do not use",
                "{mistake}: undone, the torque errors of joints are {undone:.2g} % (rms) in "
                "place of {error:.2g} %",
                "check columns and signs of the recording",
                "{mistake}",
            )
        },
        parts={
            "exchanged": "the efforts of {one} and {other} are exchanged",
            "effort": "the effort of {one} has the wrong sign",
            "position": "the position of {one} has the wrong sign",
        },
    ),
    "saturation": Words(
        wrong="a drive saturates at a limit that is not described, so the simulated robot does not",
        advice="state `saturation` of the motor",
        detects="Only printed if the law or the simulated robot is not confirmed and drives "
        "saturate at a limit that is not stated: over 1 % of their efforts are within 2 to 8 % "
        "of their largest, and three times as many as in each of the next two ranges as wide",
        limit="`do not use`: there is no fixed point. `caution`: there is one",
        cases={
            "no fixed point": Case(
                "do not use", "{limits}", "state saturation of the motor", "{first}"
            ),
            "not confirmed": Case(
                "caution", "{limits}", "state saturation of the motor", "{first}"
            ),
        },
    ),
    "positions": Words(
        wrong="joints move within a 57th of their limits",
        advice="check whether positions are radians, declared as degrees",
        detects="Only printed if positions look like radians that were declared as degrees",
        limit="`caution`: revolute joints move within a 57th of their limits, one of them over "
        "a tenth of its range if its radians were degrees",
        cases={"radians": Case("caution", "{text}", finding="radians declared as degrees?")},
    ),
    "gains": Words(
        wrong="identified drive gains are negative, not determined, or off by one common factor",
        advice="check which recording has the payload, and its mass",
        detects="With `--gains` only: whether the drive gains are positive and determined, and "
        "not all off by one factor",
        limit="`do not use`: a drive gain is negative, or the best one is known to no better "
        "than 50 %. `caution`: none is known to 10 %, or all differ from the described ones by "
        "one common factor of over 10 %",
        cases={
            "all negative": Case(
                "do not use",
                "all drive gains are negative: the recordings are exchanged, the payload "
                "belongs to another",
                finding="recordings exchanged",
            ),
            "negative": Case(
                "do not use",
                "{wrong}: its drive gain is negative, others are positive",
                "check the sign of its effort and of its position",
                "{wrong}",
            ),
            "none usable": Case(
                "do not use",
                "no drive gain is usable ({unsure})",
                "check which recording has the payload",
                "drive gains not determined",
            ),
            "none determined": Case(
                "caution",
                "no drive gain is known to {limit:g} % ({unsure})",
                "use a heavier payload",
                "drive gains not determined",
            ),
            "one factor": Case(
                "caution",
                "drive gains are {factor:.3g} times those described (median), which scatter by "
                "{scatter:.2g} %",
                "check the payload's mass, or peak against rms",
                "drive gains off by one factor",
            ),
            "ok": Case("ok", "known to {least:.2g} to {value:.2g} %{some_unsure}{torques}"),
        },
        parts={
            "wrong": "wrong sign of {negative}",
            "some_unsure": "; not determined: {unsure}",
            "torques": "; all are 1 N m per unit: the recorded effort is a torque already",
        },
        unit="N m per unit of effort",
    ),
    "centre of mass": Words(
        wrong="the data contradict the stated centre of mass of a payload",
        advice="measure it again, or state a larger `center_half_width_m`",
        detects="Only printed for a payload whose centre of mass is stated: how far the centre "
        "by the recordings alone is from it",
        limit="`caution`: beyond the 95 % region of the statement and the data together "
        "(Hotelling's F); the statement is then not used",
        cases={
            "differs": Case(
                "caution",
                "{distance}, beyond its ± {stated:g} mm, and not used",
                "check centre, frame and mass",
                "centre of mass differs",
            ),
            "ok": Case("ok", "{distance}"),
        },
        parts={
            "distance": "centre of mass by the data {value:.2g} ± {half:.2g} mm from the stated one"
        },
        unit="mm",
    ),
    "motion": Words(
        wrong="a joint stands still in all recordings",
        advice="move it",
        detects="A joint stands still in all recordings",
        limit="`caution`: one does, so its friction values are not valid for motion",
        cases={
            "standing": Case(
                "caution",
                "joint {names} does not move: its friction values do not hold for motion",
                "move it, or do not use them",
                "{names} does not move",
            )
        },
    ),
    "rows": Words(
        wrong="rows of the log are missing or repeated",
        advice="record stamps or a counter with the rows; record again",
        detects="Only printed if rows are doubtful, by position steps that are twice the median "
        "of their four neighbours, or none, where these are over 10 robust deviations",
        limit="`caution`: over 0.1 % of the moving rows are missing or repeated. `ok`: rows "
        "that [nobody measured](#which-rows-are-fitted), which weigh nothing; or double steps "
        "next to zero steps: the encoder is slower than the log, or its counts are coarse",
        cases={
            "lost": Case(
                "caution",
                "{where}{found} (position steps that are double or zero)",
                "record time stamps or a row counter ([time] in map.toml), or record again",
                "{found}",
            ),
            "note": Case("ok", "{note}"),
        },
        parts={
            "share": "{percent:.2g} % of the rows {what}",
            "slow": "the log is faster than the encoder{joints}: {percent:.2g} % of the steps "
            "are double or zero",
        },
    ),
    "control law": Words(
        wrong="the law found from reference, position and effort is not the described one",
        advice="check rated value, ratio, sample rate, `[controller]`; a structure that fits "
        "better is named",
        detects="Kp, Kd, Ki found by least squares from reference, position and effort, with "
        "their intervals, against those described. The delay of the reference is estimated "
        "beside them and not judged; the drive gain is on both sides and is not tested. Without "
        "a described law one is reported where at most 2 % of the effort is left at every "
        "motor, Kp and Kd are positive, and every structure that does not contain it leaves 1.5 "
        "times as much at some motor; the simulated robot then has it",
        limit="`do not use`: all are negative with 2 % of the effort left. `caution`: a gain is "
        "off by 1 % beyond its interval, another structure fits better, or 5 % of the effort is "
        "left",
        cases={
            "no reference": Case("not made", "not made: the recording has no reference"),
            "computed torque": Case(
                "not made", "not made: computed torque depends on the robot's own model"
            ),
            "short": Case("not made", "not made: the recording is too short"),
            "none found": Case(
                "not made",
                "not made: [controller] describes no law, and none is found in the recording: "
                "{reason}",
            ),
            "found": Case(
                "ok",
                "{structure} found, {gains} of motor {motor}, {left:.2g} % left; {late}{unclear}",
            ),
            "another": Case(
                "caution",
                "{reason}, {left:.2g} % left: a feed-forward that is not recorded, or another law?",
            ),
            "sign": Case("do not use", "{law}", "check the sign of its effort"),
            "rival": Case(
                "caution",
                "{law}: {rival} fits better than {structure}",
                "check structure and gains of [controller]",
                "{rival} for {structure}",
            ),
            "scale": Case(
                "caution",
                "{law}: the effort is {value:.3g} x the law's",
                "check rated value, ratio and drive_gain",
            ),
            "off": Case(
                "caution",
                "{law}",
                "check structure, gains and sample rate of [controller], and whether the effort "
                "is recorded behind a filter",
            ),
            "ok": Case("ok", "{law}"),
        },
        parts={
            "late": "reference {delay_ms:.3g} ms late",
            "unclear": "; {alone} alone do not show it",
            "law": "motor {motor}: {gains}; {left:.2g} % left; {late}",
            "fed": "{text}; gravity that is fed forward is fitted and subtracted",
        },
    ),
    "lag": Words(
        wrong="the delay of the torque cannot be estimated, or contradicts what is stated; "
        "without a reference it is assumed",
        advice="state `effort_timing`, take `--method iv`, or record longer moves",
        detects="How late the recorded torque is against the motion; [found, corrected and "
        "counted](#the-lag-of-the-torque)",
        limit="`caution`: the recorded reference does not show it, and its uncertainty moves an "
        "essential parameter by over one half-width; a torque is before its command; or the "
        "data contradict a `torque_lag_s` at t > 4. `cannot tell`: without a reference it is "
        "assumed, and the intervals include it",
        cases={
            "contradicted": Case(
                "caution",
                "{stated}; the data give {found:.4g} ± {found_half:.2g} s",
                "leave torque_lag_s out",
            ),
            "stated": Case("ok", "{stated}"),
            "harmless": Case("ok", "{known}"),
            "not shown": Case(
                "caution",
                "{known}",
                "state effort_timing, or record longer moves: joints reverse too often for "
                "their rows to show it",
            ),
            "not measured": Case(
                "caution", "{known}", "state effort_timing, or take --method iv, which measures it"
            ),
            "assumed": Case(
                "cannot tell",
                "{known}: no reference is recorded that would show it; state effort_timing",
            ),
            "impossible": Case(
                "caution",
                "{late}, which is impossible",
                "check sample_rate_hz of [controller], time stamps, and whether the effort is "
                "recorded behind a filter",
            ),
            "ok": Case("ok", "{late}"),
        },
        parts={
            "stated": "{value_s:.4g} s, as torque_lag_s states",
            "cost": "±{moved:.2g} half-widths at {name}, included in the intervals",
            "unknown": "not known, {value_ms:g} ± {sd_ms:g} ms",
            "by_source": "{value_ms:.2g} ± {sd_ms:.2g} ms by {source}",
            "known": "{unknown}{by_source}: {cost}",
            "rejected": "; {source} gives {prior:.2f}, which contradicts it and is not used",
            "delayed": "; it acts {delay:.2f} ± {delay_half:.2f} samples after the command",
            "whitened": "; whitened over {order} rows, not {usual}, as joints reverse often",
            "late": "torque {size:.2f} ± {half:.2f} samples {way}: corrected, included in the "
            "intervals{rejected}{delayed}{whitened}",
        },
        unit="samples",
    ),
    "position noise": Words(
        wrong="noise of the position biases least squares",
        advice="take `--method iv`, which needs the reference",
        detects="Least squares only: how far position noise has moved the estimate, in "
        "half-widths. Noise of the spectrum seen above the low-pass (white, or falling with "
        "frequency as AR(1)) is added to the position with both signs; the mean of the two "
        "moves is the bias. It underestimates a large bias. At most three minutes of a "
        "recording are used",
        limit="`caution`: over one half-width and 1 % of an essential parameter, or half of one "
        "and 5 %",
        cases={
            "no noise": Case(
                "cannot tell", "{reason}", "use --method iv (needs a recorded reference)"
            ),
            "ok": Case("ok", "{moves}"),
            "biased": Case(
                "caution",
                "{moves} or more",
                "use --method iv (needs a recorded reference)",
                "least squares biased by position noise",
            ),
        },
        parts={
            "moves": "moves {name} by {value:.2g} half-widths ({percent:.2g} %)",
            "no low-pass": "without a low-pass noise and motion cannot be separated",
            "wide": "too little of the noise is above the cut-off of {cutoff_hz:g} Hz",
            "interpolated": "interpolated samples have less noise",
        },
    ),
    "effort": Words(
        wrong="a recorded effort is a fifth or more beyond `effort_nm`, `effort_n`, the URDF's "
        "`effort` or `saturation`",
        advice="check drive gain, ratio and unit; correct the limit",
        detects="Only printed if a recorded effort is beyond its limit (`effort_nm`, "
        "`effort_n`, the URDF's `effort`, `saturation`). Rated values, which drives exceed for "
        "seconds, and the range of the recorded object are no limits. Not made with `--gains`",
        limit="`caution`: 20 % or more beyond it",
        cases={
            "beyond": Case(
                "caution",
                "{overloads}",
                "check drive_gain, ratio and unit of the effort, or correct the limit",
                "effort beyond its limit",
            )
        },
    ),
}
