"""Robots whose parameters are known, Monte-Carlo studies, the demo; many recordings, fitted one by one."""

from .demo import description, rehearse
from .draws import Study
from .noise import Noise
from .results import ControlChart, Drift, control_limits, drifts, fleet_document, write_table
from .rows import FleetSettings, Row, Value
from .run import found_recordings, method_of, run_fleet
from .study import Judged, Run, run_study, study_truth
from .study_report import base_document, base_file, study_document, study_file, truth_document
from .summary import FALSE_ERROR, FALSE_TRUST, INSIDE, false_trust, summaries
from .synthetic import closed_loop, random_reference, write_signals
