"""Where something touches the gel: background model, illumination, contact detection and its outline."""

from tactflow.vision.contact.detector import ContactDetector, ContactResult, chi_square_threshold

__all__ = ["ContactDetector", "ContactResult", "chi_square_threshold"]
