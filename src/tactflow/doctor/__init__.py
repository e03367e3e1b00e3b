"""Diagnose a sensor from its pictures alone: `tactflow doctor`."""

from tactflow.doctor.checks import CHECKS, Finding, examine, worst
from tactflow.doctor.observation import Observation, observe

__all__ = ["CHECKS", "Finding", "Observation", "examine", "observe", "worst"]
