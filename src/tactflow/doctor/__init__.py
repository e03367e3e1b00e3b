"""Diagnose a sensor from its pictures alone: `tactflow doctor`."""

from tactflow.doctor.checks import Finding, examine, worst
from tactflow.doctor.observation import Observation, observe

__all__ = ["Finding", "Observation", "examine", "observe", "worst"]
