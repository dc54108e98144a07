"""The words of the project: lines that fit a terminal, short sentences, and the terms of the field
in guides, help, errors, tests of a fit and docstrings.
"""

import ast
import re
import shutil

import pytest
from conftest import ACQUIRE, IDENTIFY, REPLAY, ROOT
from key_reference import options_of
from wordings import TABLE

from identification.study import simulated_cell
from identification.trust import WORDS

PACKAGES = ("acquisition", "identification")
GENERATED = ("reference.md", "python-reference.md")  # of which the docstrings and help are tested
GUIDES = [
    path
    for package in PACKAGES
    for path in sorted((ROOT / package / "docs").rglob("*.md"))
    if path.name not in GENERATED
]
README = ROOT / "README.md"
MOST_WORDS_OF_GUIDES, MOST_WORDS, MOST_LINES = 16_000, 750, 120
MOST_MEAN, MOST_OF_A_SENTENCE = 20, 40
# What the field calls otherwise, or what no engineer says.
GONE = (
    r"(?<!well )(?<!well-)\bdetermined\b",
    r"cannot tell",
    r"\bnot made\b",
    r"\bstated\b|\bstates (none|no|it)\b|\bunstated\b",
    r"described law|(?<!control )\blaw\b(?! of)",
    r"surrogate|replica",
    r"\b(coarse|first|last|each|next|two|three) pass(es)?\b|pass settled",
    r"fixed point|regular start",
    r"\blags?\b(?! 1\b)",
    r"(?<!square-)\broot friction|(?<!-)\bload friction",
    r"feeds energy|denied rotor",
    r"\b(moving|standing) rows|rows (moving|standing)",
    r"\bweighs? nothing|\bramps of\b",
    r"\bspans?\b",
    r"held-out blocks|\btrained\b|added columns|\bhalves\b:",
    r"of the residual(?! (variance|norm))",
    r"instruments strong|(?<!non-)(physical|possible) robot",
    r"\bcertificate\b|added chi",
    r"(?<!standard )\bdeviations?\b",
    r"±95|half of them to|\bthe worst\b|\bown parameters\b",
    r"links of the \[parameters\]",
    r"contradict|\bby chance\b|columns exchanged",
    r"\bjoints? stands?\b|\bstands still\b",
    r"go or no go|no go\b|second stop|signs? of life",
    r"quick stop's ramp|quick[- ]stop ramp",
    r"torque demand(?! value)",
    r"\bbitrates?\b|time-out",
    r"(?<![-_])\bstamps?\b",
    r"doubled rows|\bwas cut\b",
    r"known torque",
    r"\bpictures?\b|\brooms?\b|\bour own\b",
    r"\btells?\b|\btold\b|\bknows\b|\bnobody\b|\bgoes by\b",
    r"as good as|\bas of\b|\bis none\b|(?<!here )\bis no (?!longer)|\bthe same of\b",
    r"what is (given|known)",
)
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)
# No docstring of a function begins with these: it says what the function does.
FIRST = {
    *("A", "All", "An", "And", "At", "Both", "By", "Each", "For", "From", "How", "If", "In", "Its"),
    *("None", "Of", "On", "One", "Only", "That", "The", "Those", "To", "True", "Two", "What"),
    *("When", "Where", "Whether", "Which", "Who", "With"),
}


def text_of(page: str) -> str:
    """Return a page of Markdown without code, links, comments and headings."""
    page = re.sub(r"^```.*?^```|<!--.*?-->|^\$\$.*?^\$\$", "", page, flags=re.M | re.S)
    page = re.sub(r"^ {4,}.*$|^#.*$", "", page, flags=re.M)
    page = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", page)
    return re.sub(r"`[^`]*`", "x", page)


def sentences(page: str) -> list[str]:
    """Return the sentences of a page; an item of a list ends one, a table has none."""
    blocks = re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.) |^\|.*$", text_of(page), flags=re.M)
    parts = (part for block in blocks for part in re.split(r"(?<=[.!?])[)\"*]*\s+", block))
    return [" ".join(part.split()) for part in parts if len(part.split()) > 1]


def gone_in(text: str) -> list[str]:
    """Return what a text says that the field calls otherwise, with what stands around it."""
    return [
        text[max(found.start() - 40, 0) : found.end() + 40]
        for words in GONE
        for found in re.finditer(words, text)
    ]


def test_words_count_and_sentences_are_split():
    page = "# A\n\nOne `x y` two. Three\nfour [b c](d.md)?\n\n- five six: seven\n\n| a b c |\n"
    assert sentences(page) == ["One x two.", "Three four b c?", "five six: seven"]
    assert len(gone_in("the lag (lag 1) of a mass is stated")) == 2


def test_guides_are_short():
    guides = [path.read_text().replace("|", " ") for path in GUIDES]
    assert sum(len(page.split()) for page in guides) <= MOST_WORDS_OF_GUIDES
    first = README.read_text()
    assert (len(first.splitlines()), len(first.split())) <= (MOST_LINES, MOST_WORDS)
    assert len(first.split()) <= MOST_WORDS


@pytest.mark.parametrize("guide", [README, *GUIDES], ids=lambda path: str(path.relative_to(ROOT)))
def test_sentences_of_guides(guide):
    found = sentences(guide.read_text())
    words = [len(sentence.split()) for sentence in found]
    assert [s for s, n in zip(found, words, strict=True) if n > MOST_OF_A_SENTENCE] == []
    assert sum(words) <= MOST_MEAN * len(words)
    assert gone_in(text_of(guide.read_text())) == []


def test_help_has_terms_of_the_field():
    texts = [
        text
        for program in (ACQUIRE, IDENTIFY)
        for text in (program.description, *program.commands.values())
    ] + [action.help for program in (ACQUIRE, IDENTIFY) for _, action in options_of(program)]
    assert {found for text in texts for found in gone_in(re.sub(r"`[^`]*`", "x", text))} == set()


def test_errors_have_terms_of_the_field():
    """In the table of wordings, without the expressions that are filled in."""
    lines = TABLE.read_text().splitlines()
    for _ in range(4):  # expressions have braces too
        lines = [re.sub(r"\{[^{}]*\}", "x", line) for line in lines]
    texts = [re.sub(r"`[^`]*`", "x", line.split(": ", 2)[-1]) for line in lines]
    assert {found for text in texts for found in gone_in(text)} == set()


def test_tests_of_a_fit_have_terms_of_the_field():
    texts = [
        text
        for row in WORDS.values()
        for text in (row.advice, row.detects, row.limit, *row.parts.values())
    ] + [
        text
        for row in WORDS.values()
        for case in row.cases.values()
        for text in vars(case).values()
        if isinstance(text, str)
    ]
    found = {one for text in texts for one in gone_in(re.sub(r"`[^`]*`|\{[^{}]*\}", "x", text))}
    assert found == set()


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_begin_with_one_short_sentence(package):
    """It has one line and says what a function does; records and properties have noun phrases."""
    wrong = []
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, DOCUMENTED) or not (text := ast.get_docstring(node)):
                continue
            kinds = {
                ast.unparse(one).rpartition(".")[2] for one in getattr(node, "decorator_list", ())
            }
            acts = isinstance(node, ast.FunctionDef) and not kinds & {"property", "cached_property"}
            first, line = text.split()[0], text.splitlines()[0]
            if not line.endswith((".", ":")) or (
                acts and (first.strip(",:;") in FIRST or re.match(r"[A-Z]\w", first) is None)
            ):
                wrong.append(f"{path.relative_to(ROOT)}: {getattr(node, 'name', '')}: {line}")
        if "| |" in path.read_text():
            wrong.append(f"{path.relative_to(ROOT)}: rows of a table on one line")
    assert wrong == []


MAX_LINES, MAX_CHARACTERS = 40, 120  # a screen
# Words of the method where plain ones say more.
UNKNOWN_TO_USERS = (
    r"relative gain of joint \S+ missing",
    r"lag of joint joint",
    r"\btests ok\b",
    r"\|(beta - )?true\|",
    r"look at it|read it:",
    r"gives A at the motor: expected",
    r"come from the prior",
    r"not_confirmed, ",
    r"bus missing",
    r"move M1 of LS",
    r"asked for",
)
EVERY = (
    "robot-identify fit log.mcap --json fit.json --report fit.html",
    "robot-identify compare fit.json robot.toml",
    "robot-identify export fit.json --mjcf arm.xml --allow-untrusted",
    "robot-identify validate fit.json log.mcap",
)
SMALL = (
    "robot-identify fit log.mcap --consistent",
    "robot-identify base robot.toml",
    "robot-identify view log.mcap",
    "robot-identify friction log.mcap",
    "robot-identify fleet . -o fleet.parquet",
    "robot-identify excite robot.toml -o out.csv --periods 1 --harmonics 2 --period 3",
    "robot-identify study robot.toml --runs 1 --duration-s 2",
    "robot-identify fit log.mcap --method wls --all",
    "robot-acquire info log.mcap",
    "robot-acquire import log.mcap -o again.mcap",
    "robot-acquire check robot.toml",
    "robot-acquire record robot.toml -o dry.mcap --dry-run --track ref.csv --no-fit",
    "robot-identify fit log.mcap --method wls --brief",
    "robot-identify demo --robot scara --out demo",
)


@pytest.mark.parametrize(
    ("name", "commands"), [("scara", EVERY + SMALL), ("tx40", EVERY[:2]), ("emps", EVERY)]
)
def test_lines_fit_terminal_and_use_user_words(name, commands, tmp_path, monkeypatch, capsys):
    for file, source in (("log.mcap", "session.mcap"), ("robot.toml", "robot.toml")):
        shutil.copy(REPLAY / name / source, tmp_path / file)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulated_cell, "SESSION_S", 2.0)
    (tmp_path / "ref.csv").write_text("time_s,shoulder,elbow\n0,0,0\n0.3,0,0\n")
    for command in commands:
        program, *arguments = command.split()
        {"robot-identify": IDENTIFY, "robot-acquire": ACQUIRE}[program].main(arguments)
        printed = capsys.readouterr()
        # The recordings of replay_data have stored a name of 6074h that has changed since.
        out = printed.out.replace("(torque demand,", "(torque demand value,")
        lines = [*out.splitlines(), *printed.err.splitlines()]
        assert lines, command
        if "--all" not in arguments:
            assert len(printed.out.splitlines()) <= MAX_LINES, command
        if "--all" not in arguments and "info" not in arguments:  # in a pipe these have whole lines
            assert [
                line for line in lines if len(line) > MAX_CHARACTERS and "─" not in line
            ] == [], command
        for words in (*UNKNOWN_TO_USERS, *GONE):
            assert not [line for line in lines if re.search(words, line)], (command, words)
