"""Models drawn from the intervals of a fit: their spread, and where a bound narrows it."""

import json

import msgspec
import numpy as np
import pytest
from conftest import REPLAY

from identification.export import model_of_fit
from identification.model import link_columns
from identification.report import Covariance, FitFile, LeftOut, read_fit
from identification.results import draw_consistent, stored_estimate

WITHIN = 0.1  # of the interval
NORMAL = 1.96  # half a 95 % interval in standard deviations


def stored_fit(name):
    return read_fit(REPLAY / name / "fit.json")


def drawn(stored, draws, seed=1):
    """The draws of a fit, and errors (N, b) of their base parameters from the model's."""
    m, _ = model_of_fit(stored, "fit.json")
    base, known, C = stored_estimate(stored, m.model, "fit.json")
    found = draw_consistent(m.model, base, known, C, m.chi, (draws, seed))
    return found, (found.chi - m.chi) @ base.K.T, base.names, m.model


def spread_of(errors, stored, names):
    """Half a 95 % interval of the draws over that of the fit, (b,)."""
    half = {p.name: p.half for p in stored.parameters}
    return NORMAL * errors.std(axis=0) / [half[name] for name in names]


def are_bodies(links):
    """Whether links (N, L, 10) have positive mass and, about their centres of mass, positive second
    moments: no principal moment of inertia above the sum of both others.
    """
    mass, com = links[..., 9], links[..., 6:9] / links[..., 9:]
    inertia = np.empty((*mass.shape, 3, 3))
    for entry, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        inertia[..., i, j] = inertia[..., j, i] = (
            links[..., entry]
            - mass * (com**2).sum(axis=-1) * (i == j)
            + mass * com[..., i] * com[..., j]
        )
    moments = np.linalg.eigvalsh(inertia)
    return (mass > 0) & (moments[..., 0] > 0) & (moments[..., 2] < moments[..., :2].sum(axis=-1))


def test_spread_and_correlations_are_those_of_fit():
    """No bound is near: 95 % of the draws are in each interval."""
    stored = stored_fit("scara")
    found, errors, names, _ = drawn(stored, 2000)
    assert (found.at_bound, found.regular.all(), errors.shape) == ({}, True, (2000, len(names)))
    assert np.abs(spread_of(errors, stored, names) - 1).max() < WITHIN
    half = np.array([p.half for p in stored.parameters])
    assert (np.abs(errors) < half).mean(axis=0) == pytest.approx(0.95, abs=0.02)
    C = np.array(stored.covariance.values)
    sigma = np.sqrt(np.diag(C))
    np.testing.assert_allclose(np.corrcoef(errors.T), C / sigma[:, None] / sigma, atol=0.08)
    assert min(found.narrowed.values()) == pytest.approx(1.0, abs=1e-3)
    assert found.changes.max() < 1e-3


def test_spread_of_arm_narrowed_only_by_bounds():
    """Of the TX40 the recording does not show the inertia of link 6, which a bound keeps positive;
    parameters that no eigenvalue at its bound restricts have their intervals.
    """
    stored = stored_fit("tx40")
    found, errors, names, model = drawn(stored, 600)
    spread = spread_of(errors, stored, names)
    assert np.abs(spread[found.regular] - 1).max() < WITHIN
    assert 15 < found.regular.sum() < len(names)
    assert found.at_bound["link 6"] > 0.2
    narrow = {name for name, share in found.narrowed.items() if share < 1 - WITHIN}
    assert "XY6" in narrow
    assert narrow.isdisjoint(np.array(names)[found.regular])
    assert spread.min() > 0.7
    assert are_bodies(found.chi[:, link_columns(model)]).all()


def test_values_without_torque_stay_those_of_model():
    """Also where the a priori values are others; without errors a draw is the model itself."""
    stored = stored_fit("scara")
    m, _ = model_of_fit(stored, "fit.json")
    base, known, C = stored_estimate(stored, m.model, "fit.json")
    chi, at = m.chi.copy(), m.model.names.index("M1")
    assert not base.K[:, at].any()
    chi[at] *= 3.0
    for errors in (0 * C, C):
        found = draw_consistent(m.model, base, known, errors, chi, (3, 1))
        np.testing.assert_allclose(found.chi[:, at], chi[at], rtol=1e-3)
        assert np.allclose(found.chi, chi, rtol=1e-5) != errors.any()


def near_zero(stored, name, share):
    """The fit with a parameter at a share of a standard deviation above zero."""
    (p,) = [p for p in stored.parameters if p.name == name]
    value = share * p.spread
    moved = msgspec.structs.replace(p, value=value, low=value - p.half, high=value + p.half)
    return msgspec.structs.replace(
        stored, parameters=[moved if x is p else x for x in stored.parameters]
    )


def test_friction_near_zero_reported_narrow():
    """Viscous friction at 0.3 standard deviations: draws below zero become zero. Dry friction of
    the joint follows it, by a correlation of -0.87.
    """
    stored = near_zero(stored_fit("scara"), "Fv1", 0.3)
    found, errors, names, model = drawn(stored, 1000)
    at = names.index("Fv1")
    assert set(found.at_bound) == {"Fv1"}
    assert set(np.array(names)[~found.regular]) == {"Fv1", "Fc1"}
    assert (found.chi[:, model.names.index("Fv1")] > 0).all()
    free = np.random.default_rng(3).standard_normal(100_000)
    kept = np.maximum(free, -0.3)
    assert found.at_bound["Fv1"] == pytest.approx((free < -0.3).mean(), abs=0.05)
    assert found.narrowed["Fv1"] == pytest.approx(np.sqrt(np.mean(kept**2)), abs=0.04)
    spread = spread_of(errors, stored, names)
    assert spread[at] == pytest.approx(kept.std(), abs=0.05)
    assert np.abs(spread[found.regular] - 1).max() < WITHIN


def test_left_out_parameters_not_drawn():
    stored = stored_fit("scara")
    names, C = stored.covariance.names, np.array(stored.covariance.values)
    at = names.index("Fv1")
    few = msgspec.structs.replace(
        stored,
        parameters=[p for p in stored.parameters if p.name != "Fv1"],
        covariance=Covariance(
            names=[*names[:at], *names[at + 1 :]],
            values=np.delete(np.delete(C, at, axis=0), at, axis=1).tolist(),
        ),
        left_out=[LeftOut(name="Fv1", sigma=0.02)],
    )
    found, errors, names, _ = drawn(few, 50)
    assert np.abs(errors[:, names.index("Fv1")]).max() < 1e-3 * 0.02
    assert "Fv1" not in found.narrowed


@pytest.mark.parametrize(("consistent", "variance"), [(False, (1 + 4 + 2 * 0.5) / 4), (True, 1.0)])
def test_per_recording_parameters_vary_as_exported(consistent, variance):
    """Their mean, or, of a physically consistent set, that of the first recording."""
    content = json.loads((REPLAY / "scara" / "fit.json").read_text())
    (p,) = [p for p in content["parameters"] if p["name"] == "Fv1"]
    others = [x for x in content["parameters"] if x is not p]
    content["parameters"] = [*others, *({**p, "name": f"Fv1@{log}"} for log in "ab")]
    content["covariance"] = {
        "names": [x["name"] for x in content["parameters"]],
        "values": np.eye(len(others) + 2).tolist(),
    }
    values = content["covariance"]["values"]
    values[-1][-1], values[-1][-2], values[-2][-1] = 4.0, 0.5, 0.5
    stored = msgspec.convert(content, FitFile)
    m, _ = model_of_fit(stored_fit("scara"), "fit.json")
    if consistent:
        stored = msgspec.structs.replace(stored, standard_parameters=[p])
    base, _, C = stored_estimate(stored, m.model, "fit.json")
    at = base.names.index("Fv1")
    assert C[at, at] == pytest.approx(variance)
