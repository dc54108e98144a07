"""EtherCAT captures whose packets are out of order, or whose clock was set."""

import made_up_ethercat as made_up
import numpy as np
import pytest
from ethercat_robots import robot_text
from made_up_buses import robot_of

from acquisition.errors import BadInputError
from acquisition.importing import import_log
from acquisition.recording import read_recording

SCALE = 524_288 / (2 * np.pi)


def rows_of(tmp_path, packets):
    """Samples of a capture, and its summary."""
    path, out = tmp_path / "a.pcap", tmp_path / "a.mcap"
    path.write_bytes(made_up.pcap(packets))
    out.unlink(missing_ok=True)
    found = import_log(path, out, robot_of(robot_text()), "robot.toml")
    return read_recording(out).samples, found


def check(samples, bus) -> None:
    """Position of the row's cycle, and the target of the one before, by the truth."""
    begin_ns = made_up.CLOCK_NS if bus.clock else made_up.BEGIN_NS
    cycles = ((samples["stamp_ns"] - begin_ns) // bus.period_ns).tolist()
    for i in range(2):
        for field, true, by in (("position", bus.position, 0), ("reference", bus.target, 1)):
            found = np.rint(samples[field][:, i] * SCALE).astype(int).tolist()
            assert found == [true(k - by, i) for k in cycles]


@pytest.mark.parametrize("image", ["lrd_lwr", "lrw"])
@pytest.mark.parametrize("cycles", [1, 4])
def test_packets_are_sorted_by_time(tmp_path, monkeypatch, image, cycles):
    """Of so many cycles each, what came back stands before what went out."""
    bus = made_up.Bus(image=image)
    start, packets = bus.start(), bus.packets(200, start=False)
    ordered, _ = rows_of(tmp_path, start + packets)
    order = np.arange(len(packets)).reshape(-1, cycles, 2)[:, :, ::-1].swapaxes(1, 2).ravel()
    swapped = start + [packets[k] for k in order]
    for at_once in (2**21, 5000):
        monkeypatch.setattr("acquisition.importing.captures._AT_ONCE", at_once)
        samples, _ = rows_of(tmp_path, swapped)
        check(samples, bus)
        assert samples.tobytes() == ordered.tobytes()
        assert (len(samples), "reference" in samples.dtype.names) == (199, True)


@pytest.mark.parametrize("back_ms", [6, 20, 400, 100_000])
@pytest.mark.parametrize("at_once", [2**21, 800])
def test_clock_set_back(tmp_path, monkeypatch, back_ms, at_once):
    """By the stamps alone it is unknown when the later rows came; distributed clocks tell it."""
    monkeypatch.setattr("acquisition.importing.captures._AT_ONCE", at_once)
    for clock in (0, 8):
        bus = made_up.Bus(clock=clock)
        packets = bus.packets(400)
        half = len(packets) // 2
        packets[half:] = [(t - back_ms * 1_000_000, f) for t, f in packets[half:]]
        if clock:
            samples, _ = rows_of(tmp_path, packets)
            check(samples, bus)
            assert len(samples) > 365
        else:
            with pytest.raises(BadInputError, match=r"times step back by .*set back") as caught:
                rows_of(tmp_path, packets)
            assert caught.value.place == str(tmp_path / "a.pcap")
            assert [path.name for path in tmp_path.iterdir()] == ["a.pcap"]


@pytest.mark.parametrize("off_ms", [-300, 300])
def test_one_wrong_timestamp_is_no_clock_step(tmp_path, off_ms):
    bus = made_up.Bus()
    packets = bus.packets(200)
    time_ns, frame = packets[-151]
    packets[-151] = (time_ns + off_ms * 1_000_000, frame)
    samples, _ = rows_of(tmp_path, packets)
    check(samples, bus)
    assert 180 < len(samples) < 199
