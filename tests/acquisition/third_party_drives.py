"""npm's CANopen stack, and its drive on a bus."""

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import ROOT
from session_processes import bus_at, end

THIRD_PARTY_DRIVE = ROOT.parent / "shared" / "tools" / "third_party_drive.js"
PACKAGES = ("canopen@6.2.1", "@msgpack/msgpack@3")


@pytest.fixture(scope="session")
def npm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the packages; skips where node or npm is missing or cannot fetch them."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not here: the third-party stack is npm's canopen")
    where = tmp_path_factory.mktemp("npm")
    # node-crc, which it depends on, is compiled on the spot; newer versions of
    # npm must be asked to.
    commands = (
        ["npm", "install", "--no-audit", "--no-fund", *PACKAGES],
        ["npm", "rebuild", "node-crc", "--foreground-scripts"],
        ["node", "-e", "require('canopen'); require('@msgpack/msgpack')"],
    )
    for command in commands:
        try:
            done = subprocess.run(
                command, cwd=where, capture_output=True, text=True, timeout=90, check=False
            )
        except subprocess.TimeoutExpired:
            pytest.skip(f"the third-party stack did not come in 90 s: {' '.join(command)}")
        if done.returncode:
            pytest.skip(
                f"the third-party stack is not to be had: {' '.join(command)}: "
                f"{done.stderr.strip()[-200:]}"
            )
    return where


def node(npm: Path, script: Path, *arguments: str) -> "subprocess.Popen[str]":
    environment = {**os.environ, "NODE_PATH": str(npm / "node_modules")}
    return subprocess.Popen(
        ["node", str(script), *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@contextmanager
def third_party_drive(folder: Path, npm: Path) -> Iterator["subprocess.Popen[str]"]:
    """npm's drive, node 7, on the bus of a folder, for 120 s at most."""
    if not THIRD_PARTY_DRIVE.exists():
        pytest.skip("the third-party drive is not here: ../shared/tools/third_party_drive.js")
    group, _, number = bus_at(folder).channel.partition(":")
    drive = node(npm, THIRD_PARTY_DRIVE, "7", group, number, "120")
    try:
        assert "node 7" in drive.stderr.readline()
        yield drive
    finally:
        end(drive, signal.SIGTERM)
