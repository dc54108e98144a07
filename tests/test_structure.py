"""The house: imports run one way, heavy packages have one owner each, files stay small."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

# What each file may import of the project. A file that is not here fails the test: put it where it belongs.
ACQUISITION = {
    "__init__": set(),
    "whole_file": {"__init__"},
    "command_line": {"__init__"},
    "description": {"__init__"},
    "bus_description": {"__init__", "cia402", "description"},
    "robot": {"__init__", "bus_description", "description"},
    "object_dictionary": {"__init__", "cia402"},
    "sdo": {"__init__"},
    "error_frames": set(),
    "pdo": {"__init__", "cia402"},
    "sync_times": set(),
    "extra_objects": {"__init__", "bus_description", "cia402", "robot"},
    "drives": {"__init__", "bus_description", "cia402", "extra_objects", "object_dictionary", "pdo", "robot"},
    "association": {"blocks"},
    "decoding": {"__init__", "association", "blocks", "cia402", "drives", "pdo", "robot", "sdo", "sync_times"},
    "bus": {"__init__", "blocks", "bus_description"},
    "reference": {"__init__", "robot", "table_files"},
    "plants": {"__init__", "blocks", "robot"},
    "simulated_node": {"bus_description", "cia402", "drives", "object_dictionary", "pdo", "sdo"},
    "simulated_supervision": {"cia402", "simulated_node"},
    "simulated_drives": {"cia402", "drives", "plants", "robot", "simulated_node", "simulated_supervision"},
    "mechanism": {"__init__", "drives", "plants", "robot", "simulated_drives"},
    "dry_run": {"__init__", "bus", "drives", "mechanism", "robot", "simulated_drives"},
    "master": {"__init__", "blocks", "bus", "cia402", "drives", "error_frames", "object_dictionary", "pdo", "sdo"},
    "master_heartbeat": {"__init__", "bus_description", "cia402", "master"},
    "orders": {"cia402", "master"},
    "drive_reports": {"__init__", "cia402", "drives", "master"},
    "guards": {"cia402", "drive_reports", "master", "robot"},
    "pacing": {"__init__", "bus_description", "master"},
    "enabling": {"__init__", "cia402", "drive_reports", "master", "orders"},
    "following": {"robot"},
    "preparing": {"__init__", "cia402", "drives", "master"},
    "safe_stop": {"__init__", "cia402", "master", "orders", "sdo"},
    "homing": {"__init__", "bus_description", "drives", "master", "robot"},
    "scheduling": {"__init__", "master", "pacing"},
    "recorder": {"__init__", "blocks", "decoding", "drives", "recording", "robot"},
    "dead_man": {"__init__", "bus", "bus_description", "drives", "master", "safe_stop"},
    "disabling": {"bus", "drives", "master", "robot", "safe_stop"},
    "wall_clock": set(),
    "recorder_process": {
        "__init__",
        "blocks",
        "bus",
        "dead_man",
        "drives",
        "master_heartbeat",
        "recorder",
        "robot",
        "sdo",
        "wall_clock",
    },
    "listening": {"__init__", "blocks", "bus", "cia402", "drives", "master", "pdo"},
    "session": {
        "__init__",
        "cia402",
        "drive_reports",
        "drives",
        "enabling",
        "following",
        "guards",
        "listening",
        "master",
        "master_heartbeat",
        "orders",
        "pacing",
        "preparing",
        "recorder",
        "reference",
        "robot",
        "safe_stop",
    },
    "blocks": {"__init__"},
    "cia402": {"__init__"},
    "mcap_content": {"__init__"},
    "recording": {"__init__", "blocks", "extra_objects", "mcap_content", "robot", "whole_file"},
    "mat_files": {"__init__"},
    "table_files": {"__init__", "mat_files"},
    "limits": {"__init__", "robot"},
    "tables": {"__init__", "blocks", "description", "limits", "recording", "robot", "table_files", "whole_file"},
    "overview": {"__init__", "blocks", "extra_objects", "recording", "robot"},
    "record": {
        "__init__",
        "bus",
        "drives",
        "dry_run",
        "master",
        "mechanism",
        "recorder",
        "recorder_process",
        "reference",
        "robot",
        "session",
        "homing",
        "scheduling",
        "supervision",
    },
    "live_line": {"recorder", "robot"},
    "can_logs": {"__init__", "blocks", "bus"},
    "conversions": {
        "__init__",
        "blocks",
        "bus",
        "can_logs",
        "decoding",
        "drives",
        "extra_objects",
        "limits",
        "recording",
        "robot",
        "whole_file",
    },
    "supervision": {"__init__", "bus", "bus_description", "cia402", "drives", "master", "master_heartbeat"},
    "check": {
        "__init__",
        "bus",
        "cia402",
        "drives",
        "listening",
        "master",
        "pdo",
        "robot",
        "supervision",
        "homing",
        "scheduling",
    },
    "replay": {
        "__init__",
        "blocks",
        "bus",
        "bus_description",
        "decoding",
        "drives",
        "listening",
        "recording",
        "sdo",
        "session",
    },
    "__main__": {
        "__init__",
        "bus_description",
        "check",
        "command_line",
        "conversions",
        "disabling",
        "drives",
        "dry_run",
        "live_line",
        "mechanism",
        "overview",
        "plants",
        "record",
        "recording",
        "replay",
        "robot",
        "safe_stop",
        "session",
        "tables",
        "whole_file",
    },
}
IDENTIFICATION = {
    "__init__": {"acquisition.__init__"},
    "signals": {"__init__", "acquisition.recording", "acquisition.robot"},
    "filtering": {"__init__"},
    "joint_terms": {"acquisition.robot"},
    "dynamics": {"__init__", "joint_terms", "acquisition.robot"},
    "instruments": {
        "__init__",
        "base_parameters",
        "dynamics",
        "filtering",
        "fit",
        "low_speed",
        "plan",
        "plausibility",
        "regression",
        "signals",
        "simulation",
    },
    "simulation": {"__init__", "dynamics", "acquisition.robot"},
    "base_parameters": {"dynamics"},
    "plan": {"__init__", "filtering", "signals", "acquisition.__init__", "acquisition.limits", "acquisition.robot"},
    "low_speed": {"__init__", "dynamics", "filtering", "plan", "signals"},
    "plausibility": {"base_parameters", "dynamics", "estimators", "joint_terms", "plan", "signals"},
    "regression": {"base_parameters", "dynamics", "filtering", "low_speed", "plan", "signals"},
    "estimators": {"__init__"},
    "diagnostics": {"plan"},
    "fit": {"base_parameters", "diagnostics", "estimators", "filtering", "plan", "plausibility"},
    "judgement": {
        "diagnostics",
        "dynamics",
        "estimators",
        "filtering",
        "fit",
        "instruments",
        "plan",
        "plausibility",
        "regression",
        "signals",
    },
    "idim": {
        "__init__",
        "base_parameters",
        "diagnostics",
        "dynamics",
        "estimators",
        "fit",
        "instruments",
        "judgement",
        "low_speed",
        "plan",
        "regression",
        "signals",
    },
    "synthetic": {
        "__init__",
        "base_parameters",
        "dynamics",
        "filtering",
        "instruments",
        "signals",
        "simulation",
        "acquisition.blocks",
        "acquisition.recording",
        "acquisition.reference",
        "acquisition.robot",
        "acquisition.whole_file",
    },
    "study": {
        "__init__",
        "base_parameters",
        "dynamics",
        "idim",
        "instruments",
        "plan",
        "synthetic",
        "acquisition.robot",
    },
    "fit_file": {
        "__init__",
        "base_parameters",
        "diagnostics",
        "filtering",
        "fit",
        "plan",
        "plausibility",
        "signals",
        "acquisition.robot",
        "acquisition.whole_file",
    },
    "validation": {"base_parameters", "dynamics", "fit_file", "signals"},
    "plant": {
        "__init__",
        "base_parameters",
        "dynamics",
        "instruments",
        "simulation",
        "synthetic",
        "acquisition.__init__",
        "acquisition.plants",
        "acquisition.reference",
        "acquisition.robot",
        "acquisition.simulated_drives",
    },
    "demo": {
        "__init__",
        "base_parameters",
        "dynamics",
        "instruments",
        "plant",
        "simulation",
        "synthetic",
        "acquisition.drives",
        "acquisition.dry_run",
        "acquisition.master",
        "acquisition.mechanism",
        "acquisition.recorder",
        "acquisition.recorder_process",
        "acquisition.reference",
        "acquisition.robot",
        "acquisition.session",
        "acquisition.simulated_drives",
    },
    "printing": {"acquisition.__init__"},
    "report": {"base_parameters", "diagnostics", "filtering", "fit", "fit_file", "plan", "signals", "study"},
    "panels": set(),
    "comparison": {"__init__", "fit", "fit_file"},
    "curves": {"diagnostics", "dynamics", "filtering", "fit", "panels", "plan", "regression", "signals"},
    "charts": {"comparison", "fit", "panels", "plan", "signals", "study"},
    "session_panels": {"panels", "plan", "signals"},
    "robot_drawing": {"dynamics", "fit", "panels", "signals"},
    "fit_markdown": {
        "comparison",
        "curves",
        "fit",
        "fit_file",
        "plan",
        "report",
        "robot_drawing",
        "session_panels",
        "signals",
        "study",
    },
    "viewer": {
        "__init__",
        "charts",
        "comparison",
        "curves",
        "fit",
        "fit_markdown",
        "panels",
        "plan",
        "robot_drawing",
        "session_panels",
        "signals",
        "study",
        "acquisition.whole_file",
    },
    "options": {"__init__"},
    "__main__": {
        "__init__",
        "base_parameters",
        "comparison",
        "dynamics",
        "demo",
        "fit",
        "fit_file",
        "acquisition.whole_file",
        "idim",
        "options",
        "plan",
        "printing",
        "report",
        "signals",
        "study",
        "synthetic",
        "validation",
        "viewer",
        "acquisition.__init__",
        "acquisition.command_line",
        "acquisition.robot",
    },
}
# Packages that only one file may import.
OWNERS = {
    "pinocchio": {"identification/dynamics.py"},
    "rerun": {"identification/viewer.py"},
    "mcap": {"acquisition/recording.py", "acquisition/mcap_content.py"},
    "rosbags": {"acquisition/recording.py"},
    "can": {"acquisition/bus.py", "acquisition/can_logs.py"},
    "canopen": {"acquisition/object_dictionary.py"},
}
FILES = sorted((ROOT / "acquisition").glob("*.py")) + sorted((ROOT / "identification").glob("*.py"))


def imported(path: Path) -> set[str]:
    """Modules a file imports anywhere in it; relative ones in full."""
    found, package = set(), path.parent.name
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inside = f"{package}." if node.level else ""
            if node.module:
                found.add(inside + node.module)
            else:
                found |= {
                    f"{package}.{alias.name}" if (path.parent / f"{alias.name}.py").exists() else f"{package}.__init__"
                    for alias in node.names
                }
    return {f"{name}.__init__" if name in ("acquisition", "identification") else name for name in found}


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_imports_run_one_way(path):
    package, table = path.parent.name, ACQUISITION if path.parent.name == "acquisition" else IDENTIFICATION
    assert path.stem in table, "a new file: say in this table what it may import"
    allowed = {name if name.startswith("acquisition.") else f"{package}.{name}" for name in table[path.stem]}
    ours = {name for name in imported(path) if name.startswith(("acquisition.", "identification."))}
    assert ours <= allowed


@pytest.mark.parametrize("package", OWNERS)
def test_heavy_packages_have_one_owner(package):
    users = {
        f"{path.parent.name}/{path.name}" for path in FILES if package in {n.split(".")[0] for n in imported(path)}
    }
    assert users <= OWNERS[package]


def test_files_stay_small():
    lengths = sorted(len(path.read_text().splitlines()) for path in FILES)
    assert lengths[-1] <= 400
    assert lengths[len(lengths) // 2] < 200


@pytest.mark.parametrize("package", ["acquisition", "identification"])
def test_help_loads_nothing_heavy(package):
    code = (
        f"import sys\ntry:\n from {package}.__main__ import main\n main(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'pinocchio', 'rerun', 'mcap', 'rich', 'can', 'canopen'} & set(sys.modules)\n"
        "sys.exit(f'loaded: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "usage: robot-" in done.stdout
