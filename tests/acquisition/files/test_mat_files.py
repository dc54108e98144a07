"""MAT files as people have them: structs, matrices either way round, objects of MATLAB's
classes beside the numbers.
"""

import struct
import zlib

import numpy as np
import pytest
import scipy.io

from acquisition.errors import BadInputError
from acquisition.files import read_columns

Q = np.arange(21.0).reshape(7, 3)  # 7 samples of 3 joints
T = np.arange(7.0)


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def matlab_object(name: bytes) -> bytes:
    """An object of a class as MATLAB writes it: array flags of class 17 (opaque), no dimensions,
    three names, its number.
    """
    number = element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    inside = (
        element(6, struct.pack("<II", 9, 0))
        + element(5, struct.pack("<2i", 6, 1))
        + element(1, b"")
    )
    names = [element(1, text) for text in (name, b"MCOS", b"timeseries")]
    return element(
        14, element(6, struct.pack("<II", 17, 0)) + b"".join(names) + element(14, inside + number)
    )


def workspace() -> bytes:
    """What MATLAB writes at the end of a file with objects: a matrix without a name."""
    content = element(1, b"") + element(2, bytes(range(16)))
    return element(
        14, element(6, struct.pack("<II", 9, 0)) + element(5, struct.pack("<2i", 1, 16)) + content
    )


def mat(tmp_path, variables, *, before=b"", behind=b""):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, variables)
    whole = path.read_bytes()
    path.write_bytes(whole[:128] + before + whole[128:] + behind)
    return path


def refused(path, columns, count) -> str:
    with pytest.raises(BadInputError) as caught:
        read_columns(path, columns, count)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


@pytest.mark.parametrize("compressed", [False, True])
def test_other_objects_are_skipped(tmp_path, compressed):
    opaque = matlab_object(b"log")
    if compressed:
        opaque = struct.pack("<II", 15, len(zlib.compress(opaque))) + zlib.compress(opaque)
    path = mat(tmp_path, {"q": Q, "data": {"t": T}}, before=opaque, behind=workspace())
    with pytest.raises(Exception, match="NoneType"):
        scipy.io.whosmat(path)  # this file is one of those that cannot be listed
    assert np.array_equal(read_columns(path, ["q"], 3), Q)
    assert np.array_equal(read_columns(path, ["data.t"], 1), T[:, None])
    assert refused(path, ["log"], 1) == "variable 'log' does not exist: expected one of q, data.t"


def test_fields_by_dotted_name(tmp_path):
    path = mat(tmp_path, {"data": {"q": Q.T, "motor": {"tau": -Q, "t": T}, "note": "text"}, "x": T})
    assert np.array_equal(read_columns(path, ["data.q"], 3), Q)
    assert np.array_equal(read_columns(path, ["data.motor.tau"], 3), -Q)
    there = "expected one of data.q, data.motor.tau, data.motor.t, data.note, x"
    for name in ("data.v", "data.q.x", "motor", "x.y"):
        assert refused(path, [name], 3) == f"variable {name!r} does not exist: {there}"
    kind = (
        "variable 'data.motor' is a struct or object with the fields tau, t: expected a vector "
        "or matrix of real numbers"
    )
    assert refused(path, ["data.motor"], 1) == kind
    many = mat(tmp_path, {"many": np.array([(1.0,), (2.0,)], dtype=[("q", "O")])})
    assert "variable 'many' is an array of 2 structs: expected one struct" in refused(
        many, ["many.q"], 1
    )


@pytest.mark.parametrize("turned", [False, True])
def test_matrices_in_both_orientations(tmp_path, turned):
    both = {"q": Q, "first": Q[:, :2], "last": Q[:, 2:], "deep": Q[:, :, None]}
    path = mat(
        tmp_path,
        {name: np.swapaxes(value, 0, 1) if turned else value for name, value in both.items()},
    )
    for names in (["q"], ["first", "last"], ["deep"]):
        assert np.array_equal(read_columns(path, names, 3), Q), names
    # A signal of joints by one by samples.
    assert np.array_equal(read_columns(mat(tmp_path, {"q": Q.T[:, None, :]}), ["q"], 3), Q)
    assert np.array_equal(
        read_columns(mat(tmp_path, {"t": T[None, None, :]}), ["t"], 1), T[:, None]
    )


def test_matrix_parts_by_index_and_label(tmp_path):
    spoilt = np.where(np.arange(21).reshape(7, 3) == 7, np.nan, Q)
    path = mat(tmp_path, {"q": Q, "data": {"r": Q.T, "s": spoilt.T}})
    assert refused(path, ["data.s"], 3) == "row 3: data.s(:,2) = nan: expected a finite number"
    assert np.array_equal(read_columns(path, ["q(:,3)", "q(:,1:2)"], 3), Q[:, [2, 0, 1]])
    assert np.array_equal(read_columns(path, ["data.r(2:3, :)", "q(:, 1)"], 3), Q[:, [1, 2, 0]])
    assert (
        refused(path, ["q(:,4)"], 1)
        == "variable 'q(:,4)' exceeds the matrix, which is 7 x 3: expected 1 to 3"
    )
    assert (
        refused(path, ["q(0,:)"], 1)
        == "variable 'q(0,:)' exceeds the matrix, which is 7 x 3: expected 1 to 7"
    )
    assert (
        refused(path, ["q(1,2)"], 1)
        == "variable 'q(1,2)' selects neither columns nor rows: expected (:,k) for columns, or "
        "(k,:) for rows"
    )
    assert "does not exist" in refused(path, ["q(1)"], 1)


def test_ambiguous_shape_is_refused(tmp_path):
    square = Q[:3]
    path = mat(tmp_path, {"q": square, "wide": Q[:, :2], "short": T[:5]})
    assert refused(path, ["q"], 3) == (
        "q 3 x 3: its samples may be rows or columns. Write 'q(:,1:3)' if rows are samples, "
        "'q(1:3,:)' if columns are."
    )
    assert np.array_equal(read_columns(path, ["q(:,1:3)"], 3), square)
    assert np.array_equal(read_columns(path, ["q(1:3,:)"], 3), square.T)
    apart = (
        "the variables do not fit together: {}: expected variables of one length, 3 columns in all"
    )
    assert refused(path, ["wide", "short"], 3) == apart.format("wide 7 x 2, short 1 x 5")
    # 14 + 7 numbers would be 7 rows of 3; but here the name says that each row of three is a joint.
    path = mat(tmp_path, {"q": Q[:, :2].T, "t": T})
    assert refused(path, ["q(:,1:7)", "t"], 3) == apart.format("q(:,1:7) 2 x 7, t 1 x 7")
