"""Where something touches the gel.

`detector` passes each frame through the other files, in this order:

1. `background` compares its cells, 4 x 4 px, with those of the untouched gel, under the frame's light, which
   `illumination` fits: a `Change`.
2. `components` tells which connected changes are contacts: `Component`s, in cells.
3. `background` again, for the window of each of them, at half resolution or pixel by pixel: a `WindowChange`,
   in which `response` makes slopes of all directions count alike.
4. `contact_outline` finds the outline, a level set, with `nearby` and `filling`.
5. `resolution` draws it into the mask of the frame.

`fusion` joins that mask with what the markers show.

`reference` tells whether the reference was touched, `certainty` how probable a contact is.
"""

from tactflow.vision.contact.detector import ContactDetector, ContactResult, chi_square_threshold

__all__ = ["ContactDetector", "ContactResult", "chi_square_threshold"]
