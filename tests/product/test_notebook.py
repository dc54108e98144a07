"""The notebook runs from the URDF to MuJoCo, shows what it promises, and stores its own texts."""

import json
import re
import tempfile

import pytest
from notebook_cells import NOTEBOOK, code_cells, run, stored_text

CONTENT = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
SHOWN = {  # of the cells that end with a result
    "fit": ("trust · 13 of 14 tests passed", "<iframe"),
    "parameters": (">meaning</th>", ">first moment x of link 3</td>"),
    "assumed": (">drive gains</td>",),
    "plot": ("torque turn [N m]", "torque elbow [N m]", "Parameters of IV: ZZ1R to Fc3"),
}


def masked(text):
    """Words of a text with x for each number, and its numbers."""
    number = r"(?<![A-Za-z0-9])-?[0-9][0-9.]*(?:e-?[0-9]+)?"
    return re.sub(number, "x", text).split(), [
        float(x.rstrip(".")) for x in re.findall(number, text)
    ]


def test_notebook_has_text_before_code_and_format_of_jupyter():
    assert (CONTENT["nbformat"], CONTENT["nbformat_minor"]) == (4, 5)
    cells = CONTENT["cells"]
    assert [cell["cell_type"] for cell in cells] == ["markdown", "code"] * (len(cells) // 2)
    assert len({cell["id"] for cell in cells}) == len(cells)
    keys = {"cell_type", "id", "metadata", "source"}
    for cell in cells:
        code = {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert set(cell) == keys | code


def test_notebook_identifies_arm_and_checks_it_in_mujoco(tmp_path, monkeypatch):
    pytest.importorskip("mujoco", reason="mujoco, of the extra `test`, is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    names, values = {}, {}
    for cell, (text, value) in zip(
        code_cells(CONTENT), run(code_cells(CONTENT), names), strict=True
    ):
        (words, numbers), (words_now, numbers_now) = masked(stored_text(cell)), masked(text)
        assert words_now == words, f"run tests/notebook_cells.py: {cell['id']}"
        assert numbers_now == pytest.approx(numbers, rel=0.05, abs=0.005)
        values[cell["id"]] = value
    for name, texts in SHOWN.items():
        page = values[name]._repr_html_()
        assert [text for text in texts if text not in page] == []
    true, found = 2.8 * 0.15, names["fit"]["MX3"]
    assert abs(found.value - true) < 1.5 * found.half_width < 0.001 * true
    before, after = names["errors"].values()
    assert min(before) > 25
    assert (after[0] < 3, after[1] < 0.3) == (True, True)
