"""Diagnose a sensor from its pictures alone: `tactflow doctor`."""

from tactflow.doctor.checks import CHECKS, Finding, examine, worst
from tactflow.doctor.observation import Observation, observe
from tactflow.doctor.rates import Rate, Sensor, Together, measure_together

__all__ = [
    "CHECKS",
    "Finding",
    "Observation",
    "Rate",
    "Sensor",
    "Together",
    "examine",
    "measure_together",
    "observe",
    "worst",
]
