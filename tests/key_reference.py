"""The references of all keys, options and public names, and the table of the tests of a fit:
made from the structures and parsers that read them, docstrings, and the words of the tests.

`python tests/key_reference.py` writes the references in the docs of both packages, and the table
in identification/docs/reading-a-fit.md again.
"""

import argparse
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from msgspec import to_builtins
from msgspec.json import schema_components

import acquisition
import identification
from acquisition.commands.command_line import Program
from acquisition.commands.program import PROGRAM as ACQUIRE
from acquisition.importing import TableMap
from acquisition.robot import BusFile, RobotFile
from identification.commands.program import PROGRAM as IDENTIFY
from identification.trust import WORDS

ROOT = Path(__file__).resolve().parents[1]
ROBOT_TABLES = {
    "RobotFile": "top level",
    "Joint": "[[joint]]",
    "DH": "dh",
    "Capsule": "capsule, base_capsule",
    "Motor": "[[motor]]",
    "Controller": "[controller]",
    "Identification": "[identification]",
    "LowSpeed": "low_speed_percent",
    "PayloadFile": "[payload]",
}
BUS_TABLES = {"BusFile": "[bus]", "DriveFile": "[[bus.drive]]", "PdoFile": "tpdo, rpdo"}
MAP_TABLES = {
    "TableMap": "top level",
    "Time": "[time]",
    "Angles": "[position] and [reference]",
    "Quantity": "[effort] and others",
}
# The page with the table of tests, and its columns, each with the field of `Words` that it shows.
TESTS_PAGE = ROOT / "identification" / "docs" / "reading-a-fit.md"
TESTS_COLUMNS = {"what it detects": "detects", "limit": "limit", "what to do": "advice"}
MADE = "made by `python tests/key_reference.py` -->"  # the mark above a table in a guide
HEAD = "Made by `tests/key_reference.py` from the types that read these files; do not edit."


# By the limits in the schema of a number, the range in words.
RANGES = {
    (): "",
    ("minimum",): " ({minimum:.12g} or greater)",
    ("exclusiveMinimum",): " (greater than {exclusiveMinimum:.12g})",
    ("maximum", "minimum"): " ({minimum:.12g} to {maximum:.12g})",
    ("exclusiveMaximum", "minimum"): " ({minimum:.12g} to less than {exclusiveMaximum:.12g})",
    ("exclusiveMinimum", "maximum"): " (greater than {exclusiveMinimum:.12g}, at most {maximum:g})",
    (
        "exclusiveMaximum",
        "exclusiveMinimum",
    ): " (between {exclusiveMinimum} and {exclusiveMaximum})",
}


def keys_of(kind: type) -> dict[str, dict[str, Any]]:
    """Return by structure the keys, each with its JSON Schema, and under `required` whether it
    must be given.
    """
    _, found = to_builtins(schema_components((kind,)))
    return {
        name: {
            key: {**schema, "required": key in table.get("required", ())}
            for key, schema in table["properties"].items()
        }
        for name, table in found.items()
    }


def values_of(schema: Mapping[str, Any]) -> str:
    """Return what a key may be: its words, else its type and range."""
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "anyOf" in schema:
        parts = [values_of(one) for one in schema["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(parts))
    if "$ref" in schema:
        return "table"
    if schema["type"] == "array":
        items = schema.get("prefixItems")
        return (
            f"{len(items)} numbers"
            if items
            else "list of "
            + re.sub(r"([a-rt-z])(?=$| \()", r"\1s", values_of(schema["items"]), count=1)
        )
    names = {
        "number": "number",
        "integer": "whole number",
        "string": "text",
        "boolean": "`true`, `false`",
    }
    range_of = RANGES[tuple(sorted(key for key in schema if key.lower().endswith("imum")))]
    return {**names, "object": "table"}[schema["type"]] + range_of.format(**schema)


def default_of(schema: Mapping[str, Any]) -> str:
    default = list(x) if isinstance(x := schema.get("default"), tuple) else x
    if schema["required"] or default in (None, [], {}) or "$ref" in schema:
        return "required" * schema["required"]
    return f"`{str(default).lower() if isinstance(default, bool) else default}`"


def key_tables(kind: type, places: Mapping[str, str]) -> Iterator[str]:
    tables = keys_of(kind)
    for name, place in places.items():
        yield f"\n### {place}\n\n| key | value | default | meaning |\n|---|---|---|---|"
        for key, schema in tables[name].items():
            yield (
                f"| `{key}` | {values_of(schema)} | {default_of(schema)} | "
                f"{schema['description']} |"
            )


def options_of(program: Program) -> Iterator[tuple[str, argparse.Action]]:
    """Command, action: of all commands of a program but `--help`."""
    commands = next(
        action for action in program.parser(*program.commands)._actions if action.choices
    )
    assert isinstance(commands.choices, dict)
    for name, command in commands.choices.items():
        for action in command._actions:
            if "--help" not in action.option_strings:
                yield name, action


def option_name(action: argparse.Action) -> str:
    metavar = action.metavar or (
        "|".join(map(str, action.choices)) if action.choices else action.dest.upper()
    )
    value = "" if action.nargs == 0 else f" {metavar}"
    if action.nargs == "?":
        value = f" [{metavar}]"
    return f"{', '.join(action.option_strings)}{value}".strip().replace("|", "\\|")


def command_table(program: Program) -> Iterator[str]:
    """Yield a row per command."""
    yield (
        f"\n`{program.name} --print-completion bash` (or `zsh`) prints a script that completes "
        "commands, options and\nfiles; it needs `pip install 'robot-idim[completion]'`.\n\n"
        "| command | what it does |\n|---|---|"
    )
    for name, purpose in program.commands.items():
        yield f"| `{name}` | {purpose} |"


def option_table(program: Program) -> Iterator[str]:
    """Yield a row per option and meaning, with the commands that have it."""
    rows: dict[tuple[str, str], list[str]] = {}
    common = [(program.name, one) for one in program.parser()._actions if one.option_strings]
    for command, action in (*options_of(program), *common):
        meaning = (action.help or "").replace("%%", "%").replace("|", "\\|")
        rows.setdefault((option_name(action), meaning), []).append(command)
    yield "\n| option | of | meaning |\n|---|---|---|"
    for (name, meaning), commands in rows.items():
        yield f"| `{name}` | {', '.join(f'`{command}`' for command in commands)} | {meaning} |"


def signature(name: str, of: Callable[..., Any]) -> str:
    """Return a call with the names of all arguments, and the defaults that are short."""
    given = inspect.signature(of)
    plain = [
        one.replace(annotation=one.empty)
        for one in given.parameters.values()
        if one.name not in ("self", "cls")
    ]
    text = f"{name}{given.replace(parameters=plain, return_annotation=given.empty)}"
    return re.sub(r"<function [^>]*> at \w+>", "...", text)


def described(of: object) -> Iterator[str]:
    """Yield the lines of a docstring, with its sections as lists."""
    section, item = "", r"(?:    )?(\w+(?:, \w+)*) ?: (.*)"
    for line, below in pairwise((*(inspect.getdoc(of) or "").splitlines(), "")):
        if re.fullmatch("-{3,}", line):
            continue
        if re.fullmatch("-{3,}", below) or line == "Attributes:":
            section = line.strip(":")
            yield f"**{section}**\n"
        elif section and (found := re.fullmatch(item, line)):
            yield f"- `{found[1]}`: {found[2]}"
        else:
            yield f"  {line.strip()}".rstrip() if section and line[:1] == " " else line


def members(name: str, of: type) -> Iterator[str]:
    """Yield the public properties and methods of a class."""
    for member, value in vars(of).items():
        if isinstance(value, property | cached_property):
            yield from ("", f"### `{name}.{member}`", "", *described(value))
        elif not member.startswith("_") and callable(found := getattr(of, member)):
            yield from ("", f"### `{signature(f'{name}.{member}', found)}`", "", *described(found))


def python_reference(package: ModuleType) -> str:
    """Return the page of all public names of a package, from their docstrings."""
    lines = [f"# Reference: `import {package.__name__}`", "", HEAD]
    for name in package.__all__:
        of = getattr(package, name)
        is_record = isinstance(of, type)
        lines += ["", f"## `{name if is_record else signature(name, of)}`", "", *described(of)]
        lines += members(name, of) if is_record else ()
    return "\n".join(lines) + "\n"


def page_of_tests() -> str:
    """Return the page with the table of the tests of a fit, between two marks."""
    rows = [
        ("test", *TESTS_COLUMNS),
        ("---",) * (1 + len(TESTS_COLUMNS)),
        *(
            (f"`{name}`", *map(vars(row).get, TESTS_COLUMNS.values()))
            for name, row in WORDS.items()
        ),
    ]
    lines = [f"|{'|'.join(row)}|" for row in rows]
    split = re.split(f"(?<={MADE})\n\n(.*?)(?=<!-- end)", TESTS_PAGE.read_text(), flags=re.S)
    return "\n".join((split[0], "", *lines, "", split[-1]))


def pages() -> dict[Path, str]:
    """Path and text of each reference."""
    optional = (
        "A key with an empty default may be left out. It then has no effect, unless its meaning "
        "gives a default."
    )
    robot = [
        "# Reference: robot.toml, commands and options of robot-identify",
        "",
        HEAD,
        "",
        "Angles are in degrees, everything else in SI. Unknown keys are refused. " + optional,
        "",
        "## robot.toml",
        "",
        "The table `[bus]` is in [the other reference](../../acquisition/docs/reference.md).",
        *key_tables(RobotFile, ROBOT_TABLES),
        "",
        "## Commands of robot-identify",
        *command_table(IDENTIFY),
        "",
        "## Options of robot-identify",
        *option_table(IDENTIFY),
    ]
    bus = [
        "# Reference: bus keys of robot.toml, map.toml, commands and options of robot-acquire",
        "",
        HEAD,
        "",
        optional,
    ]
    bus += ["", "## Bus keys of robot.toml", *key_tables(BusFile, BUS_TABLES)]
    bus += ["", "## map.toml", *key_tables(TableMap, MAP_TABLES)]
    bus += ["", "## Commands of robot-acquire", *command_table(ACQUIRE)]
    bus += ["", "## Options of robot-acquire", *option_table(ACQUIRE)]
    texts = {"identification": robot, "acquisition": bus}
    found = {
        ROOT / folder / "docs" / "reference.md": "\n".join(lines) + "\n"
        for folder, lines in texts.items()
    }
    for package in (acquisition, identification):
        page = ROOT / package.__name__ / "docs" / "python-reference.md"
        found[page] = python_reference(package)
    return found | {TESTS_PAGE: page_of_tests()}


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
