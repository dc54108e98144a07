"""Commands of `robot-identify` run in this process."""

from identification.commands import main


def run(capsys, *arguments) -> tuple[int, str, str]:
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def refused(capsys, *arguments) -> str:
    """The one line on stderr of a command that must fail."""
    status, _, err = run(capsys, *arguments)
    assert status == 1
    assert err.startswith("robot-identify: ")
    assert err.count("\n") == 1
    return err
