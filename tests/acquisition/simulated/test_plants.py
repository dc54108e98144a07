"""What simulated drives move, against closed forms."""

from importlib.metadata import EntryPoints

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import BadInputError
from acquisition.recording import sample_dtype
from acquisition.simulated import (
    JointwisePlant,
    TablePlant,
    driven_plant,
    middle_of_range,
    typical_inertia,
    typical_plant,
)

FREE, HELD = np.zeros(1, bool), np.ones(1, bool)
DEG = np.pi / 180


def joint(
    *, inertia=1.0, viscous=0.0, coulomb=0.0, load=0.0, slides=False, position=0.0
) -> JointwisePlant:
    a, b, c, d = (np.array([x]) for x in (inertia, viscous, coulomb, load))
    return JointwisePlant(a, b, c, d, slides=np.array([slides]), position=np.array([position]))


def after(
    plant: JointwisePlant, effort: float, seconds: float, held: np.ndarray = FREE, steps: int = 1000
):
    for _ in range(steps):
        plant.step(np.array([effort]), held, seconds / steps)
    q, dq = plant.state()
    return float(q[0]), float(dq[0])


QUARTER = -np.pi / 2  # where a load hangs straight down


@pytest.mark.parametrize(
    ("parts", "effort", "seconds", "q", "dq", "within"),
    [
        # 4 N m on 2 kg m²: after 1 s 2 rad/s and 1 rad, from where it began.
        ({"inertia": 2.0, "position": 0.5}, 4.0, 1.0, 1.5, 2.0, 2e-3),
        # Viscous friction: speed tends to effort / viscous with the time
        # constant inertia / viscous.
        ({"inertia": 2.0, "viscous": 4.0}, 6.0, 0.5, 0.75 * np.exp(-1), 1.5 * (1 - np.exp(-1)),
         1e-3),
        # Coulomb friction takes its share of either sign.
        *(({"coulomb": 1.0}, side * 3.0, 1.0, side * 1.0, side * 2.0, 2e-3) for side in (1, -1)),
        *(({"coulomb": 1.0}, side * 0.999, 1.0, 0.0, 0.0, 0.0) for side in (1, -1)),
        # load cos q: held, nothing to hold at 90°, free, and where it slides the same everywhere.
        ({"load": 5.0}, 5.0, 1.0, 0.0, 0.0, 1e-12),
        ({"load": 5.0}, 0.0, 0.01, -2.5e-4, -0.05, 5e-5),
        ({"load": 5.0, "slides": True, "position": 2.0}, 5.0, 1.0, 2.0, 0.0, 1e-12),
        # Small swings about -90° have the period 2 pi sqrt(inertia / load).
        ({"inertia": 2.0, "load": 5.0, "position": QUARTER + 0.01}, 0.0, 2 * np.pi * np.sqrt(0.4),
         QUARTER + 0.01, 0.0, 2e-4),
    ],
)  # fmt: skip
def test_joint_follows_closed_form(parts, effort, seconds, q, dq, within):
    assert after(joint(**parts), effort, seconds) == pytest.approx((q, dq), abs=within)


def test_friction_stops_joint_without_reversal():
    plant = joint(coulomb=2.0)
    assert after(plant, 1.9, 1.0, steps=100)[1] == 0.0
    assert after(plant, 3.0, 1.0, steps=100)[1] == pytest.approx(1.0)
    assert 0 <= after(plant, 0.0, 0.49, steps=49)[1] < 0.05
    assert after(plant, 0.0, 0.05, steps=5)[1] == 0.0


def test_brake_holds():
    plant = joint(load=5.0)
    q, _ = after(plant, 20.0, 0.1)
    assert after(plant, 20.0, 0.1, HELD) == (q, 0.0)


def test_typical_plant_by_hand():
    """0.42 N m at a ratio of 50 are 21 N m rated; 4000 deg/s² and 200 deg/s are the limits."""
    robot = robot_of(bus_text(2).replace("[-150, 150]", "[-150, 60]", 1))
    rated = np.array([0.42, 0.42])
    inertia = typical_inertia(robot, rated)
    assert inertia == pytest.approx([10.5 / (4000 * DEG)] * 2)
    assert middle_of_range(robot) == pytest.approx([-45 * DEG, 0.0])
    plant = typical_plant(robot, rated, load_share=0.0)
    assert plant.state()[0] == pytest.approx([-45 * DEG, 0.0])
    plant.step(np.array([0.05 * 21 + 1.0, 0.05 * 21]), np.zeros(2, bool), 1e-6)
    # Coulomb friction is a twentieth of 21 N m
    assert plant.state()[1] == pytest.approx([1e-6 / inertia[0], 0.0])
    for _ in range(500):
        plant.step(np.array([0.1 * 21, -0.1 * 21]), np.zeros(2, bool), 0.02)
    # another twentieth is viscous at 200 deg/s
    assert plant.state()[1] == pytest.approx([200 * DEG, -200 * DEG])
    loaded = typical_plant(robot, rated)
    loaded.step(np.zeros(2), np.zeros(2, bool), 1e-3)
    assert loaded.state()[1][1] == pytest.approx(-(0.3 - 0.05) * 21e-3 / inertia[1])


def test_table_follows_its_rate():
    """Rows every 10 ms; time is rounded to the nearest row; the last row stays."""
    samples = np.zeros(4, sample_dtype(1, reference=False))
    samples["position"][:, 0], samples["effort"][:, 0] = (
        [1.0, 3.0, 4.0, 4.5],
        [10.0, 20.0, 30.0, 40.0],
    )
    plant, seen = TablePlant(samples, 100.0), []
    with pytest.raises(BadInputError, match="contains no samples"):
        TablePlant(samples[:0], 100.0)
    for _ in range(10):
        (q, dq), effort = plant.state(), plant.prescribed_effort()
        seen.append((q[0], round(float(dq[0]), 9), effort[0]))
        q[0] = effort[0] = 7.0  # the table is not handed out
        plant.step(np.array([99.0]), HELD, 0.004)
    rows = [(1.0, 200.0, 10.0), (3.0, 100.0, 20.0), (4.0, 50.0, 30.0), (4.5, 0.0, 40.0)]
    assert seen == [rows[k] for k in (0, 0, 1, 1, 2, 2, 2, 3, 3, 3)]


def test_default_plant_has_weight(monkeypatch):
    robot = robot_of(bus_text(2))
    made = driven_plant(robot, bus_of(robot))
    assert made.warning.startswith("simulated as independent joints with a gravity-like load")
    assert "robot.toml has no [parameters]" in made.warning
    free = np.zeros(2, bool)
    for _ in range(50):
        made.plant.step(np.zeros(2), free, 0.001)
    # Level joints fall with (0.3 - 0.05) of the rated effort; half of that effort accelerates
    # them by 4000 deg/s².
    fallen = 0.5 * (0.25 / 0.5) * np.radians(4000) * 0.05**2
    assert made.plant.state()[0] == pytest.approx([-fallen] * 2, rel=0.05)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: EntryPoints())
    scara = robot_named("scara")
    alone = driven_plant(scara, bus_of(scara))
    assert (
        "no installed package provides the dynamics (entry point robot_idim.plants)"
        in alone.warning
    )


def test_implausible_parameters_are_refused():
    robot = robot_of(
        (REPLAY / "scara" / "robot.toml").read_text().replace("ZZ2 = 0.061", "ZZ2 = -1000.0")
    )
    with pytest.raises(
        BadInputError, match="cannot be simulated: the inertia matrix is not positive"
    ):
        driven_plant(robot, bus_of(robot))
