"""The cells of replay_data/notebook.ipynb, run without Jupyter.

`python tests/notebook_cells.py` stores their texts in the notebook anew; pictures are made when a
user runs it.
"""

import ast
import io
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

NOTEBOOK = Path(__file__).resolve().parents[1] / "replay_data" / "notebook.ipynb"


def run(cells: list[dict[str, Any]], names: dict[str, Any]) -> Iterator[tuple[str, object]]:
    """Yield what each code cell prints, and the value of the expression that it ends with."""
    for cell in cells:
        *lines, last = ast.parse("".join(cell["source"])).body
        printed, value = io.StringIO(), None
        with redirect_stdout(printed), patch.dict(os.environ, COLUMNS="110"):
            exec(compile(ast.Module(lines, []), cell["id"], "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), cell["id"], "eval"), names)
            else:
                exec(compile(ast.Module([last], []), cell["id"], "exec"), names)
            text = "" if value is None else repr(value)
        yield printed.getvalue() + text, value


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def stored_text(cell: dict[str, Any]) -> str:
    return "".join("".join(one["text"]) for one in cell["outputs"])


if __name__ == "__main__":
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        found = list(run(code_cells(notebook), {}))
    for number, (cell, (text, _)) in enumerate(zip(code_cells(notebook), found, strict=True), 1):
        lines = [f"{line.rstrip()}\n" for line in text.splitlines()]
        output = {"name": "stdout", "output_type": "stream", "text": lines}
        cell |= {"execution_count": number, "outputs": [output] if text else []}
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
