"""Where something touches the gel.

`detector` passes each frame through the other files, in this order:

1. `background` compares its cells, 4 x 4 px, with those of the untouched gel, under the frame's light, which
   `illumination` fits: a `Change`.
2. `components` tells whether connected changes are contacts.
3. `heights` integrates the change to the shape of the gel, up to a factor, and `level_lines` finds the
   regions where it climbs to an object.
4. `contact_outline` finds the outline of each of these in the change at half resolution.

`fusion` joins that mask with what the markers show.

`reference` tells whether the reference was touched, `certainty` how probable a contact is.
"""

from tactflow.vision.contact.detector import ContactDetector, ContactResult, chi_square_threshold

__all__ = ["ContactDetector", "ContactResult", "chi_square_threshold"]
