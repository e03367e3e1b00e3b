"""One file to attach to a bug report: versions, source, pipeline, checks, and a picture where wanted."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import orjson

from tactflow.doctor.checks import Finding
from tactflow.doctor.observation import Observation
from tactflow.recording.provenance import facts
from tactflow.system.files import completed
from tactflow.system.redaction import public_address, without_secrets


def write_bug_report(
    path: Path, observation: Observation, findings: Sequence[Finding], pipeline: str, *, picture: bool = False
) -> None:
    """Write the file, JSON; what is there is replaced.

    observation, findings : of `observe` and `examine`. pipeline : text of the pipeline file; tokens
    and passwords are removed from it, and from the address of the source. picture : include the first frame,
    as PNG in base64.

    Raises
    ------
    OSError : the file cannot be written.
    """
    report = {
        "versions": facts("", None),
        "source": public_address(observation.description),
        "frames": {
            "count": observation.frames,
            "repeated": observation.repeated,
            "missing": observation.missing,
            "nominal_rate": observation.nominal,
            "size": list(observation.pairs[0].image.shape),
            "stopped": public_address(observation.stopped),
        },
        "checks": findings,
        "pipeline": without_secrets(pipeline),
        "picture": None,
    }
    if picture:
        _, png = cv2.imencode(".png", observation.pairs[0].image)
        report["picture"] = base64.b64encode(png.tobytes()).decode()
    options = orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS
    with completed(path) as partial:
        partial.write_bytes(orjson.dumps(report, option=options) + b"\n")
