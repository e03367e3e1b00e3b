"""What a frame at rest looks like, and whether the light of a camera is steady yet.

`rest` tells from a raw frame which results could differ from those before. `settling` looks at the first
frames of a source for the untouched gel in steady light.
"""

from tactflow.vision.change.rest import RestTest
from tactflow.vision.change.settling import Settling

__all__ = ["RestTest", "Settling"]
