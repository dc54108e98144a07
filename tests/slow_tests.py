"""Which tests are slow: those of slow.txt, which have taken over half a second of CPU time; `-m
"not slow"` leaves them out.

With TEST_CPU=FILE the CPU time of each test is written there. `python tests/slow_tests.py FILE...`
makes the list of such files; `--check FILE` fails with those of the list that took less than
LEAST_S and others that took more than MOST_S, in seconds of the machine of the list, and do so
again: each in a process of its own, and all in one process, twice. Two tests on one core take up to
twice the time of one, and a fit that tests share is counted with the test that happens to be first.
"""

import os
import subprocess
import sys
import time
import timeit
from collections import Counter
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

LIST = Path(__file__).with_name("slow.txt")
SLOW_S, LEAST_S, MOST_S = 0.5, 0.2, 1.0
REFERENCE_S = 0.17  # of `reference_s` on the machine of the list


def listed() -> set[str]:
    return set(LIST.read_text(encoding="utf-8").split("\n"))


def is_listed(name: str, names: set[str]) -> bool:
    """Whether a test, or the function of which it is a case, is in the list."""
    return name in names or name.split("[")[0] in names


def pytest_configure(config: pytest.Config) -> None:
    """Let xdist take files in the order of the tests."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests; files with many come first, so that at the end no worker has long ones."""
    names = listed()
    slow = [item for item in items if is_listed(item.nodeid, names)]
    for item in slow:
        item.add_marker("slow")
    count = Counter(item.path for item in slow)
    items.sort(key=lambda item: -count[item.path])


def cpu_s() -> float:
    """CPU time of this process and of those that have ended, s."""
    return sum(os.times()[:4])


def reference_s() -> float:
    """CPU time of a loop, s: the least of five."""
    loop = "sum(k * k for k in range(3_000_000))"
    return min(timeit.repeat(loop, timer=time.process_time, number=1, repeat=5))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, Any, Any]:
    began = cpu_s()
    try:
        return (yield)
    finally:
        item.user_properties.append(("cpu_s", cpu_s() - began))


def wrongly_listed(found: dict[str, float], speed: float) -> dict[str, str]:
    """Lines by test on those that the list has and should not, or the reverse; `speed`
    is that of this machine.
    """
    names, lines = listed(), {}
    for name, seconds in sorted(found.items(), key=lambda one: -one[1]):
        here = is_listed(name, names)
        if seconds * speed < LEAST_S if here else seconds * speed > MOST_S:
            lines[name] = (
                f"{seconds * speed:.2f} s of CPU {'and' if here else 'but not'} in slow.txt: {name}"
            )
    return lines


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if config.getoption("markexpr") == "not slow":
        terminalreporter.write_line(
            f"slow tests are left to .ci/run: {len(listed()) - 1} lines of tests/slow.txt"
        )
    if (path := os.environ.get("TEST_CPU")) is None:
        return
    stats = terminalreporter.stats
    lines = [
        f"{dict(one.user_properties)['cpu_s']:.3f} {one.nodeid}\n"
        for name in ("passed", "failed")
        for one in stats.get(name, [])
        if one.when == "call"
    ]
    Path(path).write_text("".join(lines))


def lines_of(found: dict[str, float], before: set[str]) -> list[str]:
    """The list for measured times; of functions whose cases are all slow the function.

    Tests not measured stay as they were.
    """
    cases: dict[str, dict[str, float]] = {}
    for name, seconds in found.items():
        cases.setdefault(name.split("[")[0], {})[name] = seconds
    lines = {name for name in before if name and name.split("[")[0] not in cases}
    for function, times in cases.items():
        slow = {name for name, seconds in times.items() if seconds > SLOW_S}
        lines |= {function} if len(slow) == len(times) else slow
    return sorted(lines)


def times_in(*files: str) -> dict[str, float]:
    """CPU time by test, s, of files of TEST_CPU."""
    lines = (line.split(" ", 1) for file in files for line in Path(file).read_text().splitlines())
    return {name: float(seconds) for seconds, name in lines}


def confirmed(file: str) -> dict[str, str]:
    """Return lines on tests that are wrongly listed by a file of TEST_CPU, which is written anew,
    and are so again: each in a process of its own, and in two runs of these tests alone.
    """
    lines = wrongly_listed(times_in(file), REFERENCE_S / reference_s())
    os.environ["TEST_CPU"] = file

    def alone(test: tuple[int, str]) -> dict[str, float]:
        # A test that shared the fit of another has to make it here, so that it is slow again.
        own = f"{file}.{test[0]}"
        run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test[1]]
        subprocess.run(run, check=True, env=os.environ | {"TEST_CPU": own})
        return times_in(own)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = [item for times in pool.map(alone, enumerate(lines)) for item in times.items()]
    lines = wrongly_listed(dict(found), REFERENCE_S / reference_s())
    for _ in range(2):
        if not lines:
            break
        if status := pytest.main(["-q", "-p", "no:cacheprovider", *lines]):
            sys.exit(status)
        lines = wrongly_listed(times_in(file), REFERENCE_S / reference_s())
    return lines


if __name__ == "__main__" and sys.argv[1] == "--check":
    if lines := confirmed(sys.argv[2]):
        sys.exit("\n".join(lines.values()))
elif __name__ == "__main__":
    lines = lines_of(times_in(*sys.argv[1:]), listed() if LIST.exists() else set())
    LIST.write_text("\n".join(lines) + "\n", encoding="utf-8")
