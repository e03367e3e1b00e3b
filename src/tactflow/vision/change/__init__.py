"""Is anything different from the last frame that was worked on, and is the light of a camera steady yet?"""

from tactflow.vision.change.hold import ChangeHold
from tactflow.vision.change.probe import ChangeProbe
from tactflow.vision.change.settling import Settling

__all__ = ["ChangeHold", "ChangeProbe", "Settling"]
