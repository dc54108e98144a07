"""The story of the paper as a script with cells."""

# %% [markdown]
# # Least squares and instrumental variables, on the records of the paper
#
# A. Janot, P.-O. Vandanjon, M. Gautier, *An instrumental variable approach for rigid industrial
# robots identification*, Control Engineering Practice 25 (2014) 85-101. Run the cells one by one in
# an editor that knows `# %%`, or all of them:
#
#     python replay_data/paper.py [DATA_EMPS.mat]
#
# The recordings in this folder are simulated, so the true values are known. With the real record of
# the EMPS axis the last cell compares with the digits that its authors published.

# %%
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import identification as idim
from acquisition.importing import import_tables
from acquisition.robot import load_robot

HERE = Path(__file__).resolve().parent
emps = idim.load_signals(HERE / "emps" / "session.mcap")


def mass(fit: idim.Fit) -> str:
    """The mass of the axis with the half-width of its 95 % interval."""
    value, half = fit.parameters[0].value, fit.parameters[0].half_width
    return f"{value:8.3f} ± {half:6.3f} kg"


# %% [markdown]
# ## Noise of the position
# Least squares has the noise of the position in W, twice differentiated: it is biased. The
# instruments come from a simulated robot and contain none. The true mass is 95.1089 kg.

# %%
print("position noise      LS                     IV")
for noise_m in (0.0, 5e-6, 1e-5, 2e-5):
    noise = noise_m * np.random.default_rng(0).standard_normal(emps.q.shape)
    noisy = replace(emps, q=emps.q + noise)
    ls, iv = (
        idim.identify_ls(noisy, idim.Overrides()),
        idim.identify_iv(noisy, idim.Overrides(), idim.Iteration()),
    )
    print(f"{1e6 * noise_m:8.0f} µm   {mass(ls)}   {mass(iv)}   {iv.status}")

# %% [markdown]
# ## The filter of the position
# The paper's rule is five times the bandwidth of the position loop, 100 Hz here. Torque and
# regressor go through the same filters: from 5 Hz to no filter at all both estimates of this clean
# recording move by less than their intervals.

# %%
print("cut-off             LS                     IV")
for cutoff_hz in (5.0, 20.0, 100.0, 0.0):
    rules = idim.Overrides(cutoff_hz=cutoff_hz)
    ls, iv = idim.identify_ls(emps, rules), idim.identify_iv(emps, rules, idim.Iteration())
    print(f"{f'{cutoff_hz:g} Hz' if cutoff_hz else 'none':>11}   {mass(ls)}   {mass(iv)}")

# %% [markdown]
# ## The start, and the gain update
# The paper's passes begin with a regular inertia matrix and nothing else known; without
# `start="regular"` they begin with least squares. With the gain update, equation (E) of the method,
# the simulated loop keeps the bandwidth of the real one: any start can be simulated, and leads to
# the same estimate. Without it the last pass still moves a parameter by several deviations, and an
# axis of 1 t leaves its reference: the first instruments are along the motion that this predicts.

# %%
print("start, gain update   first instruments   last change   IV")
for start_kg, gain_update in ((1e-3, True), (1.0, True), (1e3, True), (1.0, False), (1e3, False)):
    iteration = idim.Iteration(
        start="regular", inertias=np.array([start_kg]), gain_update=gain_update
    )
    iv = idim.identify_iv(emps, idim.Overrides(), iteration)
    first, last = iv.evidence.passes[0], iv.evidence.passes[-1]
    print(
        f"{start_kg:8g} kg  {'on' if gain_update else 'off':>5}   {first.kind:>17}   "
        f"{last.change_sigma:5.2f} sigma   {mass(iv)}"
    )

# %% [markdown]
# ## Six joints, 60 parameters

# %%
tx40 = idim.identify_iv(
    idim.load_signals(HERE / "tx40" / "session.mcap"), idim.Overrides(), idim.Iteration()
)
true = idim.load(HERE / "tx40" / "truth.json")
inside = sum(p.low <= true.parameters[k].value <= p.high for k, p in enumerate(tx40.parameters))
print(
    f"TX40: {len(tx40.beta)} parameters, {tx40.status} in {len(tx40.evidence.passes)} passes; "
    f"{inside} true values inside"
)

# %% [markdown]
# ## Published digits
# LS of the real EMPS record with MATLAB's edge rules, as its authors published it: 95.1089,
# 203.5034, 20.3935, -3.1648, 4.0834 %.

# %%
if len(sys.argv) > 1:
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "emps.mcap"
        import_tables(
            [Path(sys.argv[1])],
            load_robot(HERE / "emps" / "robot.toml"),
            HERE / "emps" / "map.toml",
            recording,
        )
        published = load_robot(HERE / "emps" / "robot_published.toml")
        fit = idim.identify_ls(idim.load_signals(recording, published), idim.Overrides())
    digits = ", ".join(f"{value:.4f}" for value in fit.beta)
    tau = fit.evidence.data.observed.tau  # all rows, behind the filters of the fit
    error = 100 * np.linalg.norm(tau - fit.evidence.data.predicted) / np.linalg.norm(tau)
    print(f"real EMPS: {digits}, {error:.4f} %")
