"""Diagnose a sensor from its pictures alone: `tactflow doctor`."""

from tactflow.recording.verdict import Finding
from tactflow.tools.doctor.checks import examine, worst
from tactflow.tools.doctor.observation import Observation, observe

__all__ = ["Finding", "Observation", "examine", "observe", "worst"]
