"""Recordings: MCAP files that hold every frame without loss, the results, and how they were made.

One file holds the frames of one sensor. Its channels, with `/main` for the sensor's name:

    /main/frames       every accepted frame, lossless       protobuf tactflow.RawFrame
    /main/references   those that show the untouched gel     the same
    /main/results      the result messages                   JSON tactflow.frame
    /main/image        pictures for people, at a low rate    protobuf foxglove.CompressedImage
    /main/annotations  contact, dots, arrows on those        protobuf foxglove.ImageAnnotations

Attachments: `pipeline.yaml` (with every override, so that it can be run as it is), `pipeline.original.yaml`
(the file as it was written), `message.schema.json`. Metadata `tactflow`: versions and the source.

Every frame ends a chunk of the file, so that a process that is killed loses the frame it was writing and
nothing else. What it lacks then is the index at the end: the frames can be played, and `tactflow repair`
adds it for programs that insist on one.
"""

from __future__ import annotations

from tactflow.system.extras import missing

NEEDED = ("mcap", "zstandard", "mcap_protobuf", "foxglove_schemas_protobuf")


CALIBRATION = frozenset({"calibration.yaml", "calibration.npz"})
"""Attachments of a recording that was made with a calibration."""


def missing_packages() -> str | None:
    """Why recordings can be neither written nor read here and what to do about it, or None."""
    return missing("recordings", "record", NEEDED)
