"""Rerun files of recordings, fits and fleets. The only room that imports rerun."""

from .sensitivity import write_sensitivity_rrd
from .viewer import (
    write_comparison_rrd,
    write_excitation_rrd,
    write_fit_rrd,
    write_fleet_rrd,
    write_friction_rrd,
    write_recording_rrd,
    write_study_rrd,
)
