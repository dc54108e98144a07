"""Values in the tables of a description, such as its [[joint]]s; all other lines stay as they are."""

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from ..errors import BadInputError


def replace_in_tables(text: str, kind: str, values: Mapping[str, Mapping[str, Any]], place: str) -> str:
    """A description with these values, by key, in the [[kind]] tables of these names; a key for None becomes a comment."""
    now, written = tomllib.loads(text), set()
    made, *tables = re.split(rf"(?m)^([ \t]*\[\[[ \t]*{kind}[ \t]*\]\][ \t]*(?:#.*)?)$", text)
    for own, header, table in zip(now[kind], tables[::2], tables[1::2], strict=False):  # headers and what follows them
        for key, value in values.get(own["name"], {}).items():
            written.add(own["name"])
            line = re.compile(rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)(?:\[[^\]]*\]|[^#\n]*?)([ \t]*(?:#.*)?)$")
            if value is None:
                own.pop(key, None)
                table = line.sub(r"# \g<0>", table)
                continue
            own[key], shown = value, json.dumps(value)
            table, found = line.subn(rf"\g<1>{shown}\g<2>", table, count=1)
            if not found:  # after the first key
                table = re.sub(r"^\n[^\n]*", rf"\g<0>\n{key} = {shown}", table)
        made += header + table
    with suppress(tomllib.TOMLDecodeError):
        if written == values.keys() and tomllib.loads(made) == now:
            return made
    problem, expected = "cannot be replaced line by line", f"a line [[{kind}]] of each, then a line per key"
    raise BadInputError(problem, place=place, key=f"[[{kind}]]", expected=expected)
