"""Simulated robots with known parameters, and fits of several robots over time.

It has simulated recordings, Monte-Carlo studies, and the demo. It owns everything that makes or
repeats many fits, and the tables of these; it alone imports pyarrow. It may use fits, their
regression, the simulation and the model. Only `simulated_cell` uses the bus and sessions of
`acquisition`, to record simulated drives.
"""

from .fleet import FleetRow, fleet_document, found_recordings, run_fleet, with_changes, write_table
from .sensitivity import Variant, VariedFit, changes_of, fit_variant, sensitivity_document, vary
from .simulated_cell import (
    CATALOGUE,
    PAYLOAD,
    TRUE_FACTORS,
    Noise,
    closed_loop,
    description,
    random_reference,
    record_gain_pair,
    record_simulated_session,
    study_truth,
    write_signals,
)
from .study import (
    FALSE_TRUST,
    Run,
    RunFit,
    Study,
    base_document,
    base_file,
    border_line,
    false_trust,
    gains_document,
    one_run,
    run_study,
    simulate_recording,
    study_document,
    study_file,
    summaries,
    truth_document,
)
