"""Make the calibrations of kinds of sensors that the package ships.

    python -m lab.default_calibrations [--data ../shared/data] [--keep FOLDER]

Each is learned from all presses of one sensor whose licence allows it: `gelslam` (GelSight Mini,
rpl-cmu/gelslam, MIT) and FOTS (DIGIT, Rancho-zhao/FOTS, MIT). Recordings of other Minis, which nothing is
learned from, show how much larger its errors are there: `KIND_ERRORS`, which also widen those of the DIGIT.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path

from lab.depth import SETS, radii_of, scale_of, sessions_of
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration, ScaleEntry, raw_corners, small_picture
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.samples import press_errors, summary

TRAINING_SETS = {
    "mini": (
        "gelslam",
        "GelSight Mini",
        "github.com/rpl-cmu/gelslam (MIT): presses of balls of 6.3 and 9.5 mm",
    ),
    "digit": ("digit_fots", "DIGIT", "github.com/Rancho-zhao/FOTS (MIT): presses of a ball of 4.7 mm"),
}
"""File -> set, kind of sensor, source and licence."""
KIND_SCALE = 0.05
"""Relative standard error of the scale on another sensor of the kind: the authors of FOTS measured 19.6 and
21.1 pixels per mm on two DIGITs."""
KIND_ERRORS = {"normal_error": 2.6, "depth_stderr": 0.102}
"""Additional errors on another sensor of the kind, measured on two other Minis by this program."""
OTHER_SETS = {"mini": ("mini_ball", "mini_ball_9mm")}
"""File -> sets of other sensors of the kind."""


def main() -> None:
    """Write the files, and print their errors."""
    parser = argparse.ArgumentParser(description="make the default calibrations")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder with the presses of an earlier run")
    args = parser.parse_args()
    names = [learned for learned, _, _ in TRAINING_SETS.values()] + [
        name for sets in OTHER_SETS.values() for name in sets
    ]
    sessions = sessions_of(names, args.data, args.keep)
    for file, (learned, kind, origin) in TRAINING_SETS.items():
        session, pictures = sessions[learned]
        scale = scale_of(SETS[learned], session)
        fitted = fit_photometry(session, scale, radii_of(SETS[learned], pictures))
        made = Calibration(
            sensor=file,
            made_from=origin,
            raw_size=session.mapping.raw_size,
            size=session.mapping.size,
            corners=raw_corners(session.mapping),
            scale=ScaleEntry.of(scale, "the authors of the recordings"),
            photometric=fitted.found,
            look=small_picture(session.untouched),
            slopes=fitted.model,
            information=fitted.information,
        )
        for_kind(made, kind).save(KINDS / f"{file}.yaml")
        own = fitted.found.model_dump()
        print(f"{file}: {words(own)} on its own sensor")
        if others := OTHER_SETS.get(file, ()):
            errors = []
            for other in others:
                presses, pictures = sessions[other]
                scale, radii = scale_of(SETS[other], presses), radii_of(SETS[other], pictures)
                errors += press_errors(presses, fitted.model, scale, radii)
            there = summary(errors)
            more = {name: max(there[name] ** 2 - own[name] ** 2, 0) ** 0.5 for name in KIND_ERRORS}
            print(f"{file}: {words(there)} on {', '.join(others)}: {words(more)} more")


def for_kind(own: Calibration, kind: str) -> Calibration:
    """The same as the default of a kind of sensor, with the errors that it has on others of the kind."""
    photometric, entry = own.photometric, own.scale_entry
    assert photometric is not None
    wider = {name: math.hypot(getattr(photometric, name), more) for name, more in KIND_ERRORS.items()}
    wider["between"] = math.hypot(photometric.between, KIND_ERRORS["depth_stderr"])
    pairs = zip(entry.mm_per_pixel, entry.stderr, strict=True)
    stderr = tuple(math.hypot(error, KIND_SCALE * value) for value, error in pairs)
    update = {
        "kind": kind,
        "scale_entry": entry.model_copy(update={"stderr": stderr}),
        "photometric": photometric.model_copy(update=wider),
    }
    return own.model_copy(update=update)


def words(errors: Mapping[str, float]) -> str:
    """Errors, for people."""
    return ", ".join(f"{name} {errors[name]:.3f}" for name in KIND_ERRORS)


if __name__ == "__main__":
    main()
