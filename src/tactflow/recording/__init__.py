"""Recordings: MCAP files with lossless frames, results and provenance.

A file has the frames of one sensor. Its channels, with `/main` for the sensor's name:

    /main/frames       every accepted frame, lossless       protobuf tactflow.RawFrame
    /main/references   frames of the untouched gel           the same
    /main/results      the result messages                   JSON tactflow.frame
    /main/image        previews at a low rate                protobuf foxglove.CompressedImage
    /main/annotations  contacts, markers, arrows on those    protobuf foxglove.ImageAnnotations

Attachments: `pipeline.yaml` (with all overrides, so that it can be run), `message.schema.json`. Metadata
`tactflow`: versions and the source.

A chunk of the file ends with every frame, so that a killed process loses only the frame that it was writing.
The file then has no index at the end: its frames can be played, and `tactflow repair` adds the index for
programs that require it.
"""

from __future__ import annotations

from tactflow.system.extras import missing

REQUIRED_PACKAGES = ("mcap", "zstandard", "mcap_protobuf", "foxglove_schemas_protobuf")


CALIBRATION_ATTACHMENTS = frozenset({"calibration.yaml", "calibration.npz"})
"""Attachments of a recording with a calibration."""


def missing_packages() -> str | None:
    """A message about missing packages for recordings, with the remedy, or None."""
    return missing("recordings", "record", REQUIRED_PACKAGES)
