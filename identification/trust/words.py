"""What tests of a fit say: of each test a row with all its words, and of each assumption.

A test is a function that finds which of its cases holds, and the figures. All words stand in the
rows, as templates of these figures: the terminal, the report and the JSON print the case that
holds, and the guides have tables of the rows. A row also has parts of texts. A part stands in a
text, or in a later part, where its name stands in braces; where the test says that it does not
hold, nothing stands there. `WORDS` in `evidence` has the rows of all tests.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..report import Assumed, Level


@dataclass(frozen=True)
class Case:
    """What a test says: one sentence with its figures, what to do, and the finding in a few words
    for the first line of a report.
    """

    level: Level
    text: str
    advice: str = ""
    finding: str = ""


@dataclass(frozen=True, kw_only=True)
class Words:
    """The row of a test.

    Attributes:
        wrong, advice: for the guide what is wrong where it fails, and what to do.
        detects, limit: the same in full, for the page of results.
        cases: what it says, by name.
        parts: of the texts of its cases.
        unit: of its figures by joint, motor or block.
    """

    wrong: str
    advice: str
    detects: str
    limit: str
    cases: Mapping[str, Case]
    parts: Mapping[str, str] = field(default_factory=dict)
    unit: str = ""


@dataclass(frozen=True)
class Assumption:
    """The row of an assumption: its value, why no test covers it, and parts of these texts."""

    value: str
    why: str
    parts: Mapping[str, str] = field(default_factory=dict)


def written(text: str, parts: Mapping[str, str], said: Mapping[str, object]) -> str:
    """Fill a template in, with its parts that hold."""
    for name, part in reversed([*parts.items()]):
        text = text.replace(f"{{{name}}}", part if said.get(name, True) else "")
    return text.format(**said)


def assume(what: str, **said: object) -> Assumed:
    """Return an assumption with its figures filled in."""
    row = ASSUMPTIONS[what]
    value, why = (written(text, row.parts, said) for text in (row.value, row.why))
    return Assumed(what, value, why)


ASSUMPTIONS: Mapping[str, Assumption] = {
    "payload": Assumption(
        "{payload}",
        "{scales}{taken_off}{both}{always}",
        {
            "scales": "drive gains and all parameters scale with its mass",
            "exact": ", as if it were exact: no half-width of its mass is stated",
            "taken_off": "it is taken off the arm{exact}",
            "both": "; ",
            "always": "no recording is without payload: the parameters include what is not stated "
            "of the lightest",
        },
    ),
    "drive gains": Assumption(
        "{gains}{recorded}",
        "a wrong gain scales all parameters, and fits equally well{common}",
        {
            "recorded": "torques recorded in {units}",
            "common": " if it is common to all joints",
        },
    ),
    "efforts": Assumption(
        "the whole torque of each motor",
        "what a drive adds behind the recorded effort, such as friction or gravity, cannot be seen",
    ),
    "own parameters": Assumption(
        "their mean elsewhere",
        "other recordings are validated with the mean of those of these",
    ),
    "ratios": Assumption("{ratios}", "joint positions and torques are computed with them"),
    "lengths": Assumption("{lengths}", "link parameters absorb an error of a length"),
    "sample rate": Assumption("{fs:g} Hz", "speeds and accelerations scale with it"),
    "control law": Assumption(
        "{law}{default}", "{reason}", {"default": "a {bandwidth_hz:g} Hz PD"}
    ),
    "lag": Assumption(
        "{lag}",
        "{stated}{unseen}",
        {
            "stated": "stated by torque_lag_s",
            "unseen": "no reference is recorded that would show it: {cost}",
        },
    ),
    "filters": Assumption(
        "{duration_s:.0f} s of motion",
        "intervals include noise only; filters distort a parameter by about 0.1 %, which is as "
        "much here",
    ),
    "encoder noise": Assumption(
        "the same spectrum below and above the low-pass",
        "position noise biases least squares; only the noise above the low-pass is tested",
    ),
    "zeros": Assumption(
        "right at {joints}", "a wrong zero turns the links' parameters; not noticed: {each}"
    ),
    "rotors": Assumption(
        "none at {joints} (rotor_inertia = false)",
        "the links' parameters take a rotor; not noticed: {each}",
    ),
}
