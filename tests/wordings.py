"""The wordings of errors, in one table: `python tests/wordings.py` writes wordings.txt
anew from the packages.

A line is a file, the class of the error, its text, what it expects, and its advice. What stands
in braces is filled in when it is raised. Tests assert an error's class and its data; a better
wording changes its line here and no test.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_name("wordings.txt")
CLASSES = (
    "BadInputError",
    "NoFitError",
    "RefusedError",
    "BusFaultError",
    "NoAnswerError",
    "SdoAbortedError",
)
# Of each way to raise: the names of the positional arguments.
POSITIONS = {
    **dict.fromkeys(CLASSES, ("text",)),
    "refuse": ("key", "value", "expected"),
    "require": ("holds", "key", "value", "expected"),
    "given": ("found", "key", "value", "expected"),
}


def wording(node: ast.expr | None) -> str:
    """A text as it is written; of what is computed the expression in braces."""
    if node is None:
        return ""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(wording(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return wording(node.left) + wording(node.right)
    return f"{{{ast.unparse(node.value if isinstance(node, ast.FormattedValue) else node)}}}"


def name_of(call: ast.Call) -> str:
    """The name of what is called, without the object that has it."""
    return getattr(call.func, "id", getattr(call.func, "attr", ""))


def assigned(function: ast.AST) -> dict[str, ast.expr]:
    """The texts that a function gives a name once, by name."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found.setdefault(node.targets[0].id, []).append(node.value)
    return {name: values[0] for name, values in found.items() if len(values) == 1}


def lines_of(path: Path) -> Iterator[str]:
    """A line for each place of a file that raises an error with a text of its own."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    calls = [(name_of(x), x, x.args) for x in ast.walk(tree) if isinstance(x, ast.Call)]
    calls += [
        ("require", call, rule.elts)
        for name, call, _ in calls
        if name == "require_all"
        for rule in ast.walk(call)
        if isinstance(rule, ast.Tuple) and len(rule.elts) == len(POSITIONS["require"])
    ]
    for name, call, arguments in (one for one in calls if one[0] in POSITIONS):
        around = [one for one in functions if one.lineno <= call.lineno <= (one.end_lineno or 0)]
        names = assigned(around[-1]) if around else {}
        given = dict(zip(POSITIONS[name], arguments, strict=False)) | {
            k.arg: k.value for k in call.keywords
        }
        # A rule of a table of robot.toml may give a fact and an advice instead of what is expected.
        given |= (
            dict(zip(("text", "advice", "expected"), (*says.elts, None), strict=True))
            if isinstance(says := given.get("expected"), ast.Tuple)
            else {}
        )
        text, expected, advice, arguments = (
            wording(names.get(x.id, x) if isinstance(x := given.get(key), ast.Name) else x)
            for key in ("text", "expected", "advice", "arguments")
        )
        advice = " ".join(filter(None, (advice, arguments)))
        fact = ": ".join(filter(None, (text, expected and f"expected {expected}")))
        if line := " ".join(filter(None, (f"{fact}." if fact and advice else fact, advice))):
            yield f"{path.relative_to(ROOT)}: {name}: {line}{'.' if advice else ''}"


def table() -> str:
    """All lines, in the order of files and places."""
    files = sorted(
        path
        for package in ("acquisition", "identification")
        for path in (ROOT / package).rglob("*.py")
    )
    return "\n".join(line for path in files for line in lines_of(path)) + "\n"


if __name__ == "__main__":
    TABLE.write_text(table(), encoding="utf-8")
