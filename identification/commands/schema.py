"""`robot-identify schema`: JSON Schemas for editors and checks."""

import argparse
import json
from typing import Any


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", choices=["robot", "fit"], help="robot: robot.toml; fit: the file of `fit --json`")


def run(options: argparse.Namespace) -> None:
    """Print the schema as JSON."""
    print(json.dumps(schema(options.file), indent=1, ensure_ascii=False))


def schema(file: str) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of `robot` or `fit`, from the types that read and write these files."""
    import msgspec

    from acquisition.robot import RobotFile

    from ..report import FitFile

    found = msgspec.json.schema(RobotFile if file == "robot" else FitFile)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_with_common_anchors(found)}


def _with_common_anchors(part: Any) -> Any:
    r"""Patterns with ^ and $, since a schema has no \A and \Z."""
    if isinstance(part, list):
        return [_with_common_anchors(x) for x in part]
    if not isinstance(part, dict):
        return part
    return {
        key: x.replace(r"\A", "^").replace(r"\Z", "$")
        if key == "pattern" and isinstance(x, str)
        else _with_common_anchors(x)
        for key, x in part.items()
    }
