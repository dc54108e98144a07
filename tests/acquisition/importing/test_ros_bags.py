"""ROS 2 bags: those that the package rosbags writes are read sample by sample."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from controller_bags import CONTROLLER, HUMBLE, OLD, STORES, controller_bag
from made_up_bags import (
    DQ,
    EFFORT,
    FIRST_NS,
    NAMES,
    RATE_HZ,
    STATE,
    STORE,
    TEXT,
    N,
    Q,
    T,
    bag,
    message,
)
from made_up_recordings import header, written_again
from mcap.writer import CompressionType
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer

from acquisition.commands import main
from acquisition.errors import BadInputError
from acquisition.files import on_disk
from acquisition.importing import BagOptions, import_bag, time_base
from acquisition.recording import RecordingWriter, read_recording
from acquisition.robot import robot_from_files

TOML = REPLAY / "scara" / "robot.toml"
OPTIONS = BagOptions(topic="/joint_states", effort_unit=["N m"])


def run(path, out):
    where = ["--robot", str(TOML), "--topic", "/joint_states", "-o", str(out)]
    return main(["import", str(path), *where, "--effort-unit", "N m"])


def imported(path, out):
    assert run(path, out) == 0
    return read_recording(out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return bag(tmp_path_factory.mktemp("bag") / "whole", map(message, range(N)))


STORAGES = {
    "mcap": (StoragePlugin.MCAP, None),
    "mcap, zstd": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "mcap, zstd by message": (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    "db3": (StoragePlugin.SQLITE3, None),
    "db3, zstd by file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
}


# of the others the folder's metadata.yaml alone says how they are compressed
BARE = ("mcap", "mcap, zstd", "db3")


@pytest.mark.parametrize(
    ("kind", "whole_folder"), [*((k, True) for k in STORAGES), *((k, False) for k in BARE)]
)
def test_bags_are_read_sample_by_sample(tmp_path, kind, whole_folder):
    storage, compression = STORAGES[kind]
    path = bag(tmp_path / "a_bag", map(message, range(N)), storage=storage, compression=compression)
    if not whole_folder:
        (path,) = (file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    recording = imported(path, tmp_path / "out.mcap")
    samples = recording.samples
    for name, true in (("position", Q), ("velocity", DQ), ("effort", EFFORT)):
        assert samples[name] == pytest.approx(true, abs=1e-12)
    assert samples["stamp_ns"].tolist() == [FIRST_NS + k * 10_000_000 for k in range(N)]
    assert recording.sample_rate_hz == RATE_HZ
    told = (
        f"effort of {path}: /joint_states: N m at the joint, as given; joint effort = value in N m"
    )
    assert recording.metadata["effort_provenance"] == told
    assert recording.metadata["effort_timing"] == "measured at the instant of the sample"
    assert recording.metadata["times"].startswith(
        f"header timestamps of {N} rows: steps 10 to 10 ms, median 10 ms"
    )


def test_joints_by_name_and_times_by_header(tmp_path):
    received = FIRST_NS + np.cumsum(np.random.default_rng(0).integers(5_000_000, 15_000_000, N))
    with Writer(tmp_path / "a", version=9) as w:
        states = w.add_connection("/joint_states", STATE, typestore=STORE)
        for k, ns in enumerate(received.tolist()):
            m = message(k, names=("elbow", "gripper", "shoulder"), velocity=None)
            w.write(states, ns, STORE.serialize_cdr(m, STATE))
            if k % 7 == 0:  # another publisher, of a gripper
                m = message(k, names=("gripper",), velocity=None)
                w.write(states, ns + 1, STORE.serialize_cdr(m, STATE))
    recording = imported(tmp_path / "a", tmp_path / "out.mcap")
    assert recording.samples["position"] == pytest.approx(Q, abs=1e-12)
    assert "velocity" not in recording.samples.dtype.names
    assert [event.text for event in recording.events] == [
        "29 messages without any of the joints are ignored"
    ]


def test_repeated_states_count_once(tmp_path, capsys):
    stamps = (FIRST_NS + 10_000_000 * k for k in range(N))
    states = (message(k // 3 * 3, stamp_ns=ns) for k, ns in enumerate(stamps))
    recording = imported(bag(tmp_path / "a", states), tmp_path / "out.mcap")
    assert recording.sample_rate_hz == pytest.approx(RATE_HZ / 3)
    for name, true in (("position", Q), ("velocity", DQ), ("effort", EFFORT)):
        np.testing.assert_allclose(recording.samples[name], true[::3], atol=1e-9)
    assert "it repeats each position 3 times" in capsys.readouterr().out


def test_times_are_header_or_reception_timestamps(tmp_path, capsys):
    path = bag(tmp_path / "a", (message(k, stamp_ns=0) for k in range(N)))
    assert imported(path, tmp_path / "a.mcap").samples["stamp_ns"][0] == FIRST_NS + 3_000_000
    assert (
        "warning: the headers have no timestamps: reception times are used"
        in capsys.readouterr().out
    )
    # of simulated time
    path = bag(tmp_path / "b", (message(k, stamp_ns=k * 10_000_000) for k in range(N)))
    np.testing.assert_array_equal(
        imported(path, tmp_path / "b.mcap").samples["stamp_ns"], np.arange(N) * 10_000_000
    )


RATIOS = "ratio = 2\n", "ratio = 5\n"


def with_motors(*keys):
    """The description with these keys of its motors."""
    left_out = ("effort_unit", "drive_gain", "ratio")
    text = "\n".join(
        line for line in TOML.read_text().splitlines() if not line.startswith(left_out)
    )
    head, *motors = text.split("[[motor]]")
    return head + "".join(
        f"[[motor]]\n{own}{motor}" for own, motor in zip(keys, motors, strict=True)
    )


@pytest.mark.parametrize(
    ("recorded", "given", "ratios", "factor"),
    [
        ("A", "A", RATIOS, (2, 5)),
        ("A", "mA", RATIOS, (0.002, 0.005)),
        ("%", "per mille", RATIOS, (0.2, 0.5)),
        ("V", "V", ("ratio = -2\n", "ratio = 5\n"), (-2, 5)),
        ("A", "A", ("", ""), (1, 1)),
        ("N m", "N m", RATIOS, (1, 1)),
    ],
)
def test_effort_side_without_drive_gains(tmp_path, whole, capsys, recorded, given, ratios, factor):
    """The unit alone would fit both sides; the ratios say what is of the motors."""
    toml, out = tmp_path / "robot.toml", tmp_path / "out.mcap"
    toml.write_text(with_motors(*(f'{x}effort_unit = "{recorded}"\n' for x in ratios)))
    command = ["import", str(whole), "--robot", str(toml), "-o", str(out)]
    assert main([*command, "--effort-unit", given]) == 0, capsys.readouterr().err
    assert read_recording(out).samples["effort"] == pytest.approx(EFFORT * factor, abs=1e-12)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_joint_state_topic_choice(tmp_path, capsys, storage):
    path, out = bag(tmp_path / "a", map(message, range(N)), storage=storage), tmp_path / "out.mcap"
    (file,) = (x for x in path.iterdir() if x.suffix in (".mcap", ".db3"))
    options = ["--robot", str(TOML), "-o", str(out), "--effort-unit", "N m", "--overwrite"]
    for place in (path, file):
        assert main(["import", str(place), *options]) == 0
        said = "topic: /joint_states, the only one of sensor_msgs/msg/JointState"
        assert capsys.readouterr().out.splitlines()[1] == said
        assert read_recording(out).samples["position"] == pytest.approx(Q, abs=1e-12)
    out.unlink()
    with Writer(tmp_path / "two", version=9, storage_plugin=storage) as writer:
        for topic in ("/arm/joint_states", "/gripper/joint_states"):
            states = writer.add_connection(topic, STATE, typestore=STORE)
            for k in range(N):
                ns = FIRST_NS + k * 10_000_000
                writer.write(states, ns, STORE.serialize_cdr(message(k), STATE))
    with Writer(tmp_path / "none", version=9, storage_plugin=storage) as writer:
        texts = writer.add_connection("/rosout", TEXT, typestore=STORE)
        writer.write(texts, FIRST_NS, STORE.serialize_cdr(STORE.types[TEXT]("hello"), TEXT))
    for name, count, topics in (
        ("two", 2, "/arm/joint_states, /gripper/joint_states"),
        ("none", 0, "/rosout"),
    ):
        assert main(["import", str(tmp_path / name), *options]) == 1
        assert capsys.readouterr().err == (
            f"robot-acquire: {tmp_path / name}: the bag has {count} topics of joint states "
            f"({topics}). Choose a topic of type {STATE} (--topic).\n"
        )
    assert not out.exists()
    assert main(["import", str(tmp_path / "two"), *options, "--topic", "/arm/joint_states"]) == 0
    assert "topic: " not in capsys.readouterr().out


def test_motor_currents_become_joint_effort(tmp_path, whole):
    """3 N m/A at motors of ratios 2 and 5 are 6 and 15 N m at the joints for an
    ampere; N m is of the joints.
    """
    text = with_motors(*(f'{x}drive_gain = 3\ndrive_gain_unit = "N m/A"\n' for x in RATIOS))
    robot, out = (
        robot_from_files({"robot.toml": text.encode()}, "amperes.toml"),
        tmp_path / "out.mcap",
    )
    for unit, factor in (("mA", [0.006, 0.015]), ("N m", [1, 1])):
        import_bag(whole, robot, out, replace(OPTIONS, effort_unit=[unit]))
        assert read_recording(out).samples["effort"] == pytest.approx(EFFORT * factor, abs=1e-12)
        out.unlink()
    with pytest.raises(BadInputError) as refused:
        import_bag(whole, robot, out, replace(OPTIONS, effort_unit=["V"]))
    assert (refused.value.key, refused.value.expected) == ("effort_unit", "A")


def edited(count=40, **change):
    """Messages with `change`: a part for all of them, or what makes it of a message's number."""
    for k in range(count):
        yield message(
            k, **{name: part(k) if callable(part) else part for name, part in change.items()}
        )


def unread(x, rows):
    """As a driver publishes values that it has not read."""
    return np.where(np.isin(np.arange(N), rows)[:, None], np.nan, x)


def with_value(x, row, value):
    return x * np.where(np.arange(N) == row, value, 1)[:, None]


ONE_PUBLISHER = "Record the topic of the arm's own driver, or stop the other publisher"


@pytest.mark.parametrize(
    ("change", "place", "key", "value", "expected"),
    [
        ({"count": 0}, "", "", None, "the topic has no messages"),
        ({"effort": None}, "", "", None, "the messages contain no efforts"),
        ({"effort": 0 * EFFORT}, "", "effort", None, "all values are 0"),
        ({"effort": with_value(EFFORT, 3, np.nan)}, ": state 4", "effort of joint shoulder",
         np.nan, "a finite number"),
        ({"position": with_value(Q, 2, np.inf)}, ": state 3", "position of joint shoulder", np.inf,
         "a finite number"),
        ({"names": ("elbow", "wrist")}, ": message 1", "", None,
         "the joints shoulder are missing; it has elbow, wrist"),
        ({"velocity": lambda k: None if k == 5 else DQ}, "", "", None,
         "only 39 of 40 messages have values of velocity"),
        ({"frame": lambda k: "" if k % 2 else "left"}, ": message 2", "", None,
         "several publishers sent messages: frame '' after 'left'"),
        ({"names": lambda k: NAMES if k % 2 else NAMES[::-1]}, "", "", None,
         "the joint names or their order change 39 times"),
        ({"names": lambda k: NAMES if k % 20 else (*NAMES, "finger")}, "", "", None,
         "the joint names or their order change 3 times"),
        ({"effort": EFFORT * [1, np.nan]}, "", "effort of joint elbow", None,
         "no row has a number"),
        ({"position": np.where(T < 0.05, np.inf, Q.T).T}, ": state 1",
         "position of joint shoulder", np.inf, "a finite number"),
        ({"effort": unread(EFFORT, [*range(5), 7])}, ": state 8", "effort of joint shoulder",
         np.nan, "a finite number"),
        ({"stamp_ns": lambda k: FIRST_NS + (k - 30 * (k % 2)) * 10**7}, "", "row 2", None,
         "time runs backwards"),
        ({"stamp_ns": lambda k: FIRST_NS + (k // 2) * 10**7}, "", "row 2", None,
         "position differs from the row before at the same time"),
    ],
)  # fmt: skip
def test_bag_errors(tmp_path, robot, change, place, key, value, expected):
    folder, out = bag(tmp_path / "bag", edited(**change)), tmp_path / "out.mcap"
    with pytest.raises(BadInputError) as caught:
        import_bag(folder, robot, out, OPTIONS)
    assert not out.exists()
    error = caught.value
    assert (error.place, error.key, repr(error.value)) == (
        f"{folder}: /joint_states{place}",
        key,
        repr(value),
    )
    assert (error.text or error.expected).startswith(expected)


@pytest.mark.parametrize("names", [NAMES[::-1], ("finger", *NAMES), ("elbow", "f", "shoulder")])
def test_restarted_controller_may_reorder_names(tmp_path, names):
    states = edited(N, names=lambda k: NAMES if k < 90 else names)
    recording = imported(bag(tmp_path / "a", states), tmp_path / "out.mcap")
    for name, true in (("position", Q), ("velocity", DQ), ("effort", EFFORT)):
        assert recording.samples[name] == pytest.approx(true, abs=1e-12)
    told = [event.text for event in recording.events]
    assert told == [
        "the joint names or their order change 1 times: values are assigned to joints by name"
    ]


@pytest.mark.parametrize(
    ("rows", "change"),
    [
        (5, {"effort": unread(EFFORT, range(5))}),
        (1, {"position": unread(Q, [0])}),
        (30, {"effort": np.stack([EFFORT[:, 0], unread(EFFORT, range(30))[:, 1]], axis=1)}),
        (7, {"position": unread(Q, range(3)), "effort": unread(EFFORT, range(7)),
             "velocity": unread(DQ, range(6))}),
    ],
)  # fmt: skip
def test_states_not_yet_read_are_skipped(tmp_path, rows, change):
    recording = imported(bag(tmp_path / "a", edited(N, **change)), tmp_path / "out.mcap")
    for name, true in (("position", Q), ("velocity", DQ), ("effort", EFFORT)):
        assert recording.samples[name] == pytest.approx(true[rows:], abs=1e-12)
    assert recording.samples["stamp_ns"][0] == FIRST_NS + rows * 10_000_000
    told = f"the first {rows} states are left out, because a position or an effort is nan"
    assert [event.text for event in recording.events] == [told]


def in_turns(every=1, **other):
    """The states of the driver, and 5 ms after each one of a second node with the same
    names and `other` parts.
    """
    for k in range(N):
        yield message(k)
        if k % every == 0:
            yield message(k, stamp_ns=FIRST_NS + k * 10_000_000 + 5_000_000, **other)


@pytest.mark.parametrize(
    ("key", "other"),
    [
        ("position", {"position": np.roll(Q, 3, axis=0)}),  # late copies
        ("effort", {"effort": 0 * EFFORT, "every": 7}),
        ("effort", {"effort": 0.9 * EFFORT}),
    ],
)
def test_two_publishers_of_same_names_are_refused(tmp_path, key, other):
    path = bag(tmp_path / "two", in_turns(**other))
    with pytest.raises(BadInputError) as refused:
        import_bag(path, robot_named("scara"), tmp_path / "out.mcap", OPTIONS)
    assert refused.value.key.startswith(key)
    assert refused.value.advice == ONE_PUBLISHER
    assert not (tmp_path / "out.mcap").exists()


def test_true_states_count_as_one_publisher(tmp_path):
    """In coarse numbers; with drives that are off at first and at the end; with a
    current that passes zero.
    """
    off = ((T < 0.3) | (T > 1.7))[:, None]
    cases = [
        (np.round(Q, 2), np.round(EFFORT, 1)),
        (Q, np.where(off, 0.0, EFFORT)),
        # steps of one and two digits in turns
        (np.round(np.outer(np.arange(N), [0.015, 0.01]), 2), EFFORT),
        (Q, np.rint(EFFORT * [5.0, 0.0])),
    ]
    for k, (q, effort) in enumerate(cases):
        states = (message(i, position=q, effort=effort, velocity=None) for i in range(N))
        imported(bag(tmp_path / str(k), states), tmp_path / f"{k}.mcap")


def test_several_publishers_are_reported(tmp_path):
    none, kinds = QosTime(0, 0), (QosHistory, int, QosReliability, QosDurability)
    qos = Qos(*(kind(1) for kind in kinds), none, none, QosLiveliness(1), none, False)
    with Writer(tmp_path / "a", version=9) as w:
        states = w.add_connection(
            "/joint_states", STATE, typestore=STORE, offered_qos_profiles=[qos, qos]
        )
        for k in range(N):
            w.write(states, FIRST_NS + k * 10_000_000, STORE.serialize_cdr(message(k), STATE))
    found = import_bag(tmp_path / "a", robot_named("scara"), tmp_path / "out.mcap", OPTIONS)
    assert any(text.startswith("/joint_states has 2 publishers") for text in found.warnings)


def test_doubts_about_bag_are_reported_and_kept(tmp_path):
    late_ns = np.random.default_rng(4).integers(0, 4_000_000, N).tolist()
    unknown = DQ * np.where(np.arange(N) == 7, np.nan, 1)[:, None]
    messages = [
        message(k, stamp_ns=FIRST_NS + k * 10_000_000 + late, velocity=unknown)
        for k, late in enumerate(late_ns)
    ]
    messages.insert(50, messages[49])
    recording = imported(bag(tmp_path / "late", messages), tmp_path / "out.mcap")
    assert "velocity" not in recording.samples.dtype.names
    texts = [event.text for event in recording.events]
    assert texts[0] == "some velocities are not finite, so no velocities are imported"
    assert texts[1].startswith("timestamps jitter by 1.71 ms, but the motion does not: ")
    assert texts[1].endswith("import a table whose map gives sample_rate_hz")
    assert ", 1 duplicate rows left out" in recording.metadata["times"]


# Every 12.5 ms, from 103 ms after the first joint state to 98 ms before the last.
OWN_NS = 103_000_000 + 12_500_000 * np.arange(144)


def states_of(q, own_ns=OWN_NS, names=NAMES[::-1]):
    return [(FIRST_NS + int(ns), names, q(1e-9 * ns)[: len(names)]) for ns in own_ns]


def reversed_reference(t):
    return np.array([0.4 * np.sin(3 * t), 0.6 * np.sin(2 * t)])


def with_controllers(path, topics, version=HUMBLE, storage=StoragePlugin.MCAP):
    return controller_bag(
        path, [(FIRST_NS + k * 10_000_000, message(k)) for k in range(N)], topics, version, storage
    )


@pytest.mark.parametrize("storage", ["mcap", "db3 without definitions"])
@pytest.mark.parametrize("version", STORES)
def test_controller_reference_at_joint_state_times(tmp_path, version, storage, capsys):
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    path = with_controllers(
        tmp_path / "a", {CONTROLLER: states_of(reversed_reference)}, version, plugin
    )
    for file in path.glob("*.db3"):
        with closing(sqlite3.connect(file)) as database, database:
            database.execute("DELETE FROM message_definitions")
    samples = imported(path, tmp_path / "out.mcap").samples
    at_s = 1e-9 * (samples["stamp_ns"] - FIRST_NS).astype(float)
    np.testing.assert_allclose(samples["reference"], reversed_reference(at_s).T[:, ::-1], atol=2e-7)
    np.testing.assert_allclose(samples["position"], Q[11:190], atol=1e-12)
    assert at_s[0] == pytest.approx(0.11)
    told = (
        f"reference: {CONTROLLER}, 144 rows at 80 Hz, interpolated; 21 samples before and "
        "after it left out\n"
    )
    assert told in capsys.readouterr().out


def test_unset_reference_is_skipped(tmp_path, robot):
    """Up to 1 s; the samples begin with the reference, at 1.003 s."""

    def reference(t):
        return reversed_reference(t) if t > 1 else np.full(2, np.nan)

    path = with_controllers(tmp_path / "a", {CONTROLLER: states_of(reference)})
    samples = read_recording(import_bag(path, robot, tmp_path / "out.mcap", OPTIONS).out).samples
    assert ("reference" in samples.dtype.names, len(samples)) == (True, 89)
    at_s = 1e-9 * (samples["stamp_ns"] - FIRST_NS).astype(float)
    assert at_s[0] == pytest.approx(1.01)
    np.testing.assert_allclose(samples["reference"], reversed_reference(at_s).T[:, ::-1], atol=2e-6)


def test_controller_choice_ignores_other_joints(tmp_path, robot):
    gripper = {"/gripper/controller_state": states_of(reversed_reference, names=("finger",))}
    two = {
        CONTROLLER: states_of(reversed_reference),
        "/other/state": states_of(lambda t: 0.5 * reversed_reference(t)),
    }
    path, out = with_controllers(tmp_path / "a", gripper | two), tmp_path / "out.mcap"
    with pytest.raises(BadInputError, match=f"publish a reference: {CONTROLLER}, /other/state"):
        import_bag(path, robot, out, OPTIONS)
    import_bag(path, robot, out, replace(OPTIONS, reference_topic="/other/state"))
    recording = read_recording(out)
    assert recording.metadata["reference"].startswith("/other/state, ")
    assert np.abs(recording.samples["reference"][:, 0]).max() == pytest.approx(0.3, abs=1e-3)
    alone = with_controllers(tmp_path / "b", gripper | {CONTROLLER: states_of(reversed_reference)})
    found = read_recording(import_bag(alone, robot, tmp_path / "2.mcap", OPTIONS).out)
    assert found.metadata["reference"].startswith(CONTROLLER)


def test_rows_in_reference_gap_are_skipped(tmp_path, robot):
    states = states_of(reversed_reference, np.delete(OWN_NS, slice(50, 60)))
    path = with_controllers(tmp_path / "a", {CONTROLLER: states})
    samples = read_recording(import_bag(path, robot, tmp_path / "out.mcap", OPTIONS).out).samples
    at_ns = samples["stamp_ns"]
    assert "reference" in samples.dtype.names
    assert not ((at_ns > OWN_NS[49] + FIRST_NS) & (at_ns < OWN_NS[60] + FIRST_NS)).any()
    at_s = 1e-9 * (at_ns - FIRST_NS).astype(float)
    np.testing.assert_allclose(samples["reference"], reversed_reference(at_s).T[:, ::-1], atol=2e-6)


@pytest.mark.parametrize(
    ("states", "problem"),
    [
        (states_of(reversed_reference, names=("elbow", "wrist")),
         "message 1: the joints shoulder are missing; it has elbow, wrist"),
        (states_of(lambda t: np.array([np.nan if t > 1 else 0.0, 0.0])),
         "state 73: position of joint elbow = nan"),
        (states_of(reversed_reference, OWN_NS + 10**10),
         "time: the reference lasts from 10.103 s to 11.8905 s after the first joint state"),
        ([], "the topic has no messages"),
        (states_of(reversed_reference, np.full(9, -FIRST_NS)),
         "time: only one of the two topics has timestamps"),
    ],
)  # fmt: skip
def test_unusable_reference_warns_or_is_refused(tmp_path, robot, states, problem):
    path = with_controllers(tmp_path / "a", {CONTROLLER: states}, OLD)
    found = import_bag(path, robot, tmp_path / "out.mcap", OPTIONS)
    assert "reference" not in read_recording(found.out).samples.dtype.names
    (warning,) = found.warnings
    assert warning.startswith(f"no reference is imported: {path}: {CONTROLLER}: {problem}")
    with pytest.raises(BadInputError) as refused:
        import_bag(
            path, robot, tmp_path / "asked.mcap", replace(OPTIONS, reference_topic=CONTROLLER)
        )
    assert f"no reference is imported: {refused.value}" == warning
    assert not (tmp_path / "asked.mcap").exists()


def test_wrong_or_missing_topic_is_reported(tmp_path, robot, whole):
    for part, topic, problem in (
        ("reference_topic", "/rosout", f"has the type {TEXT}"),
        ("reference_topic", "/away", "does not exist"),
        ("topic", "/away", r"does not exist \(/joint_.*Choose .* sensor_msgs/msg/JointState"),
    ):
        with pytest.raises(BadInputError, match=f"topic {topic} {problem}"):
            import_bag(whole, robot, tmp_path / "out.mcap", replace(OPTIONS, **{part: topic}))


def test_incompatible_options(tmp_path, whole, capsys):
    topic, unit = ("--topic", "/joint_states"), "--effort-unit"
    for options, told in (
        ((), "--effort-unit is missing: a bag does not contain the unit. Pass"),
        (topic, "--effort-unit is missing: a bag does not contain the unit. Pass"),
        ((*topic, unit, "Nm"), "--effort-unit = 'Nm': expected one of A, mA"),
        ((*topic, unit, "A,A,A"), "--effort-unit: 3 units are given for 2 joints"),
        (
            (*topic, unit, "N m", "--resample-hz", "-1"),
            "--resample-hz = -1.0: expected a finite number greater than 0",
        ),
        (
            (unit, "N m", "--map", str(TOML)),
            "--effort-unit = 'N m': this option is only for ROS 2 bags",
        ),
        ((*topic, "--map", str(TOML)), "this option is only for tables, not for bags. Remove it"),
    ):
        assert (
            main(
                [
                    "import",
                    str(whole),
                    "--robot",
                    str(TOML),
                    "-o",
                    str(tmp_path / "out.mcap"),
                    *options,
                ]
            )
            == 1
        )
        assert told in capsys.readouterr().err


def test_files_that_are_no_bags(tmp_path, robot, capsys):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.mcap").write_text("no bag")
    (tmp_path / "text.db3").write_text("no bag")
    with RecordingWriter(tmp_path / "own.mcap", header(robot)):
        pass
    (cut,) = bag(tmp_path / "cut", map(message, range(N))).glob("*.mcap")
    cut.write_bytes(cut.read_bytes()[:20_000])
    (spoilt,) = bag(
        tmp_path / "spoilt", map(message, range(20)), storage=StoragePlugin.SQLITE3
    ).glob("*.db3")
    with closing(sqlite3.connect(spoilt)) as database, database:
        database.execute("UPDATE messages SET data = x'00' WHERE id > 10")
    for name, way_out in (
        ("folder", "ros2 bag reindex"),
        ("text.mcap", "Import a ROS 2 bag: a folder"),
        ("text.db3", "sqlite3 CUT.db3 .recover"),
        ("own.mcap", "--profile ros2"),
        ("cut", "mcap recover CUT.mcap"),
        ("missing.mcap", "a ROS 2 bag: a folder"),
        ("spoilt", "a ROS 2 bag: a folder"),
    ):
        assert run(tmp_path / name, tmp_path / "out.mcap") == 1
        err = capsys.readouterr().err
        assert way_out in err
        assert (
            f"{tmp_path / name}: the bag cannot be read"
            f"{' after 9 messages' * (name == 'spoilt')}: " in err
        )
        assert err.count("\n") == 1
        assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_only_file_without_metadata_is_read(tmp_path, storage):
    path = bag(tmp_path / "a", map(message, range(N)), storage=storage)
    (path / "metadata.yaml").unlink()
    assert imported(path, tmp_path / "out.mcap").samples["position"] == pytest.approx(Q, abs=1e-12)


def test_incomplete_folder_is_refused_with_remedy(tmp_path, capsys):
    """Of several files, cut in the only one, at its end, in its head and of nothing, without
    one, and with other metadata.
    """
    made = {name: bag(tmp_path / name, map(message, range(N))) for name in "abcdefg"}
    files = {name: path / f"{name}.mcap" for name, path in made.items()}
    for name in "abcde":
        (made[name] / "metadata.yaml").unlink()
    (made["a"] / "a_2.mcap").write_bytes(files["a"].read_bytes())
    for name, size in (("b", 20_000), ("c", -1), ("d", 20), ("e", 0)):
        files[name].write_bytes(files[name].read_bytes()[:size])
    files["f"].unlink()
    (made["g"] / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    ways_out = {"a": f"`ros2 bag reindex {made['a']}` first", "f": "reindex", "g": "reindex"}
    for name, path in made.items():
        assert run(path, tmp_path / "out.mcap") == 1
        err = capsys.readouterr().err
        assert ways_out.get(name, "`mcap recover CUT.mcap -o WHOLE.mcap`") in err, err
        assert err.count("\n") == 1
    cut = bag(tmp_path / "h", map(message, range(N)), storage=StoragePlugin.SQLITE3) / "h.db3"
    cut.write_bytes(cut.read_bytes()[:20_000])
    assert run(cut, tmp_path / "out.mcap") == 1
    assert "sqlite3 CUT.db3 .recover" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("compression", [*CompressionType])
@pytest.mark.parametrize("chunked", [True, False])
def test_rewritten_bags_are_read(tmp_path, whole, compression, chunked):
    (file,) = whole.glob("*.mcap")
    path = written_again(
        file, tmp_path / "a.mcap", compression=compression, use_chunking=chunked, chunk_size=3000
    )
    assert imported(path, tmp_path / "out.mcap").samples["position"] == pytest.approx(Q, abs=1e-12)


def test_long_bag_is_read_in_blocks(tmp_path, monkeypatch, whole):
    """Its states lie on disk, and those beside a block count as in one."""
    monkeypatch.setattr(on_disk, "MAX_BYTES_IN_MEMORY", 100)
    monkeypatch.setattr(on_disk, "BLOCK_ROWS", 61)
    monkeypatch.setattr(time_base, "BLOCK_ROWS", 61)
    monkeypatch.setattr("acquisition.recording.writer.BLOCK_ROWS", 61)
    late = np.zeros(N, int)
    late[[17, 61, 122, 150]] = 3_000_000  # which the motion contradicts
    uneven = np.random.default_rng(4).integers(0, 100_000, N)
    stamps = FIRST_NS + np.arange(N) * 10_000_000
    states = (message(k, stamp_ns=int(s)) for k, s in enumerate(stamps + uneven + late))
    recording = imported(bag(tmp_path / "a", states), tmp_path / "out.mcap")
    assert (
        "4 rows left out whose header timestamps do not fit the motion"
        in recording.metadata["times"]
    )
    at_s = 1e-9 * (recording.samples["stamp_ns"] - FIRST_NS).astype(float)
    true = np.stack([0.5 * np.sin(2 * at_s), 0.3 * np.sin(3 * at_s)], axis=1)
    # by a clock that is uneven by 0.1 ms
    np.testing.assert_allclose(recording.samples["position"], true, atol=3e-4)
    assert np.abs(np.diff(recording.samples["position"], n=2, axis=0)).max() < 5e-4
    for key, other in (
        ("position", {"position": np.roll(Q, 3, axis=0)}),
        ("effort", {"effort": 0.9 * EFFORT}),
    ):
        path = bag(tmp_path / f"two_{key}", in_turns(**other))
        with pytest.raises(BadInputError) as refused:
            import_bag(path, robot_named("scara"), tmp_path / "two.mcap", OPTIONS)
        assert refused.value.key.startswith(key)
