"""Contact detection.

`detector` passes each frame through the other modules, in this order:

1. `background` compares cells of 4 x 4 px with those of the untouched gel under the frame's light, which
   `illumination` fits: a `Change`.
2. `components` decides whether connected changes are contacts, without those that `dirt` explains.
3. `heights` integrates the change to the shape of the gel, up to a factor, and `level_lines` (on the tree of
   `level_tree`) finds the regions where it climbs to an object.
4. `contact_outline` finds the outline of each of these in the change at half resolution.

`fusion` combines the mask with the contact that the markers show, `reference` detects a reference that was
touched, and `certainty` gives the probability of a contact.
"""

from tactflow.vision.contact.detector import ContactDetector, ContactResult, chi_square_threshold

__all__ = ["ContactDetector", "ContactResult", "chi_square_threshold"]
