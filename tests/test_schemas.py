"""The JSON Schemas: files that are read conform, files that are refused do not, judged by a checker of our own."""

import copy
import json
import re
import tomllib

import pytest
from conftest import REPLAY

from identification.commands import main

TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "integer": int,
    "number": (int, float),
    "null": type(None),
}
KEYS = {
    "$ref", "$schema", "$defs", "title", "description", "default", "type", "enum", "anyOf", "properties", "required",
    "additionalProperties", "items", "prefixItems", "minItems", "maxItems", "pattern", "minLength", "maxLength", "minimum",
    "maximum", "exclusiveMinimum", "exclusiveMaximum",
}  # fmt: skip


def conforms(x, schema, definitions) -> bool:
    """Whether `x` conforms to a schema made of the keys above: draft 2020-12 as far as it is used."""
    assert set(schema) <= KEYS, set(schema) - KEYS
    if "$ref" in schema:
        return conforms(x, definitions[schema["$ref"].removeprefix("#/$defs/")], definitions)
    if "anyOf" in schema and not any(conforms(x, one, definitions) for one in schema["anyOf"]):
        return False
    if "enum" in schema and x not in schema["enum"]:
        return False
    kind = schema.get("type")
    if kind and (not isinstance(x, TYPES[kind]) or (isinstance(x, bool) and kind != "boolean")):
        return False
    if isinstance(x, dict):
        properties, others = schema.get("properties", {}), schema.get("additionalProperties", True)
        return all(name in x for name in schema.get("required", ())) and all(
            conforms(value, properties[name], definitions)
            if name in properties
            else (conforms(value, others, definitions) if isinstance(others, dict) else others)
            for name, value in x.items()
        )
    if isinstance(x, list):
        first, rest = schema.get("prefixItems", []), schema.get("items", True)
        return (
            schema.get("minItems", 0) <= len(x) <= schema.get("maxItems", len(x))
            and all(conforms(value, one, definitions) for value, one in zip(x, first, strict=False))
            and all(conforms(v, rest, definitions) if isinstance(rest, dict) else rest for v in x[len(first) :])
        )
    if isinstance(x, str):
        within = schema.get("minLength", 0) <= len(x) <= schema.get("maxLength", len(x))
        return within and re.search(schema.get("pattern", ""), x) is not None
    if isinstance(x, (int, float)) and not isinstance(x, bool):
        return (
            schema.get("minimum", x) <= x <= schema.get("maximum", x)
            and not x <= schema.get("exclusiveMinimum", x - 1)
            and not x >= schema.get("exclusiveMaximum", x + 1)
        )
    return True


def schema_of(file, capsys):
    assert main(["schema", file]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    for pattern in re.findall(r'"pattern": "((?:[^"\\]|\\.)*)"', json.dumps(schema)):
        assert r"\\A" not in pattern, "Python's own anchor"
        assert r"\\Z" not in pattern, "Python's own anchor"
    return schema


def changed(document, key, value):
    other = copy.deepcopy(document)
    at = other
    *way, last = key.split(".")
    for name in way:
        at = at[int(name) if name.isdigit() else name]
    at[last] = value
    return other


@pytest.mark.parametrize("name", ["scara", "tx40", "emps"])
def test_the_descriptions_conform(name, capsys):
    schema = schema_of("robot", capsys)
    assert conforms(tomllib.loads((REPLAY / name / "robot.toml").read_text()), schema, schema["$defs"])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("nonsense", 1),
        ("name", ""),
        ("name", "two\nlines"),
        ("joint", []),
        ("joint.0.type", "ball"),
        ("joint.0.dh.alpha", 0.0),
        ("controller.bandwidth_hz", 0),
        ("gravity_m_s2", [0, 0]),
        ("bus.bitrate", "fast"),
        ("bus.drive.0.node", 200),
    ],
)
def test_descriptions_that_are_refused_do_not(key, value, capsys):
    schema = schema_of("robot", capsys)
    document = tomllib.loads((REPLAY / "scara" / "robot.toml").read_text())
    assert not conforms(changed(document, key, value), schema, schema["$defs"])


@pytest.mark.parametrize("name", ["scara", "tx40"])
def test_stored_fits_conform(name, capsys):
    schema = schema_of("fit", capsys)
    fit = json.loads((REPLAY / name / "fit.json").read_text())
    assert conforms(fit, schema, schema["$defs"])
    for key, value in (("parameters.0.value", "1"), ("decimation", 0), ("sample_rate_hz", -1.0), ("parameters", None)):
        assert not conforms(changed(fit, key, value), schema, schema["$defs"]), key


@pytest.mark.slow
@pytest.mark.parametrize("method", ["wls", "iv"])
def test_a_new_fit_conforms(method, tmp_path, capsys):
    out = tmp_path / "fit.json"
    assert main(["fit", str(REPLAY / "scara" / "session.mcap"), "--method", method, "--json", str(out)]) == 0
    capsys.readouterr()
    schema = schema_of("fit", capsys)
    assert conforms(json.loads(out.read_text()), schema, schema["$defs"])


def test_another_file_is_wrong_usage(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["schema", "recording"])
    assert "invalid choice: 'recording'" in capsys.readouterr().err
