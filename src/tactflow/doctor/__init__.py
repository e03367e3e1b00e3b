"""What is wrong with a sensor's pictures, from the pictures alone: `tactflow doctor`."""

from tactflow.doctor.checks import CHECKS, Finding, examine, worst
from tactflow.doctor.observation import Observation, observe

__all__ = ["CHECKS", "Finding", "Observation", "examine", "observe", "worst"]
