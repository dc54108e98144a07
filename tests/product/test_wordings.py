"""The wordings of all errors, in tests/wordings.txt."""

from wordings import TABLE, table


def test_the_table_has_the_wordings_of_the_code():
    assert TABLE.read_text(encoding="utf-8") == table(), "read what changed, then `python tests/wordings.py`"
