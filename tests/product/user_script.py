"""What a user writes: arrays, a fit, its report, a model for MuJoCo.

Runs in a folder with a robot.toml.
"""

import numpy as np

import identification

log = identification.simulate_recording("robot.toml", "log.mcap")
fit = identification.fit(
    log.q, log.effort, log.sample_rate_hz, "robot.toml", log.q_ref, method="iv", cutoff_hz=None
)
rms = np.sqrt(np.mean(fit.residuals() ** 2, axis=0))
widest = max((p for p in fit.parameters if p.essential), key=lambda p: p.half / abs(p.value))
print(
    fit.verdict,
    [one.what for one in fit.assumed],
    rms.round(4),
    f"{widest.name}: {widest.low:.3g} to {widest.high:.3g}",
)
if fit.verdict != "do not use":
    fit.save("fit.json")
    fit.write_report("report.html")
    print(fit.consistent().export(mjcf="robot.xml"))
    print([change.off for change in fit.compare(identification.load("fit.json"))])
    print(identification.validate(fit, log).relative_error_percent)
