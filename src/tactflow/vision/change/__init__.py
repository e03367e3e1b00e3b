"""Is anything different from the last frame that was worked on, and is the light of a camera steady yet?

`probe` compares frames by the sums over `tiles`, with what `noise` makes of them; `hold` decides by that
which frames are worked on. `settling` looks at the first frames of a source for the untouched gel in steady
light.
"""

from tactflow.vision.change.hold import ChangeHold
from tactflow.vision.change.probe import ChangeProbe
from tactflow.vision.change.settling import Settling

__all__ = ["ChangeHold", "ChangeProbe", "Settling"]
