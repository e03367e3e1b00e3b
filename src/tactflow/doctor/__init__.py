"""What is wrong with a sensor's pictures, told from the pictures alone: `tactflow doctor`."""

from tactflow.doctor.checks import Finding, examine
from tactflow.doctor.observation import Observation, observe

__all__ = ["Finding", "Observation", "examine", "observe"]
