"""What tests of a fit say: of each test a row with all its words, and of each assumption.

A test is a function that finds which of its cases holds, and the figures. All words stand in its
row, below it, as templates of these figures: the terminal, the report and the JSON print the case
that holds, and the guides have tables of the rows. A row also has parts of texts. A part stands in
a text, or in a later part, where its name stands in braces; where the test says that it does not
hold, nothing stands there. `WORDS` in `verdict` has the rows of all tests.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ..report import Assumed, Level, TrustLine
from .evidence import Figure, FitData


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
        test: its name.
        place: by which lines of the same level are sorted.
        by: gives its line, None where it does not apply; without, the line is made with the
            solution or with its predictions.
        of_data: whether it tests the recording, not the estimate: the guides begin with these.
        wrong, advice: for the guide what is wrong where it fails, and what to do.
        detects, limit: the same in full, for the page of results.
        cases: what it says, by name.
        parts: of the texts of its cases.
        unit: of its figures by joint, motor or block.
    """

    test: str
    place: int = 1000  # the last
    by: Callable[[FitData], TrustLine | None] | None = None
    of_data: bool = False
    wrong: str
    advice: str
    detects: str
    limit: str
    cases: Mapping[str, Case]
    parts: Mapping[str, str] = field(default_factory=dict)
    unit: str = ""

    def line(self, evidence: FitData) -> TrustLine | None:
        """The line of a fit."""
        return self.by(evidence) if self.by else evidence.made.get(self.test)

    def judge(
        self,
        cases: Mapping[str, object],
        *,
        value: float | None = None,
        figures: tuple[Figure, ...] = (),
        assumed: tuple[Assumed, ...] = (),
        **said: object,
    ) -> TrustLine | None:
        """Return the line by the first of the cases that holds; None where none does.

        `cases`: by name whether they hold; `said`: the figures of their words, and which parts
        hold.
        """
        name = next((name for name, holds in cases.items() if holds), None)
        if name is None:
            return None
        case, said = self.cases[name], {"value": value, **said}
        text, advice, finding = (
            written(text, self.parts, said) for text in (case.text, case.advice, case.finding)
        )
        return TrustLine(
            test=self.test,
            level=case.level,
            text=": ".join(filter(None, (text, advice))),
            value=value,
            finding=finding,
            figures=figures,
            unit=self.unit,
            case=name,
            assumed=assumed,
        )

    def part(self, part: str, **said: object) -> str:
        """Return a part of the texts."""
        return written(f"{{{part}}}", self.parts, said)


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
