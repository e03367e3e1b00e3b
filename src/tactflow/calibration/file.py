"""The calibration file: what is known about one sensor, as YAML that people read, with arrays beside it.

`left.yaml` says which sensor, when, from what, by which version, what was found and with which errors;
`left.npz` has the arrays: what the untouched gel looked like, and the coefficients of the slopes.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tactflow import __version__
from tactflow.engine.errors import ConfigError
from tactflow.system.files import completed, is_device
from tactflow.system.redaction import public_address
from tactflow.system.signals import ending_held_back
from tactflow.vision.depth.slopes import SlopeModel
from tactflow.vision.depth.surface import SurfaceErrors
from tactflow.vision.force import BY_CHANGE, BY_DEPTH, BY_SHEAR, ForceModel, LinearForce
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

FORMAT: Final = "tactflow.calibration/1"
LOOK: Final = (16, 12)
"""Columns and rows of the small picture of the untouched gel that is kept. Chosen by hand."""
MOVED: Final = 1.0
"""How far a corner of the processed frame may lie from where it was in the raw frame, raw px. Chosen by hand:
what rounding in a pipeline file does is less."""
UNLIKE: Final = 0.1
"""Difference of the untouched gel, relative to its brightness and after its light was scaled channel by
channel, from which on it is said to look unlike. Chosen by hand: presses of one session differ by 0.01."""


LARGEST: Final = 1 << 20
"""Bytes of the arrays at most, packed and unpacked; ours have some thousands."""
LONGEST: Final = 1 << 17
"""Bytes of the YAML file at most; ours have some thousands. PyYAML takes 4 s for so many."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class ScaleEntry(_Strict):
    """`scale` of the file."""

    mm_per_pixel: list[float] = Field(min_length=2, max_length=2)
    stderr: list[float] = Field(min_length=2, max_length=2)
    origin: list[float] = Field(min_length=2, max_length=2)
    found_by: str


class PhotometricEntry(_Strict):
    """`photometric` of the file: what it was learned from, and its errors on presses it was not learned from.

    ball_radius : mm. presses, rejected : how many. normal_error : mean angle, degrees. radius_error : median
    of the fitted radius over the true one, less 1. sphere_rms : of the heights from the fitted ball, mm.
    depth_stderr, volume_stderr : of balls, relative to the value. steepest : see `SurfaceErrors`.
    """

    ball_radius: float = Field(gt=0)
    presses: int
    rejected: int
    normal_error: float
    radius_error: float
    sphere_rms: float
    depth_stderr: float
    volume_stderr: float
    steepest: float | None = None

    def errors(self) -> SurfaceErrors:
        """What the standard errors of heights come from."""
        return SurfaceErrors(self.depth_stderr, self.volume_stderr, self.steepest)


class LinearForceEntry(_Strict):
    """A force that is linear in features, and how right it is on what it was not fitted to.

    stiffness, greatest, error : see `LinearForce`. range : least and largest force of the fit, N.
    rmse : RMS error, N. r2 : share of the variance that is explained. hysteresis : mean distance between the
    force while it grows and while it falls at the same prediction, over the largest of its press; None where
    no press shows both.
    """

    stiffness: dict[str, float]
    greatest: dict[str, float]
    error: list[float] = Field(min_length=2, max_length=2)
    range: list[float] = Field(min_length=2, max_length=2)
    rmse: float
    r2: float
    hysteresis: float | None = None

    def model(self) -> LinearForce:
        """What the stage `force` computes with."""
        return LinearForce(self.stiffness, self.greatest, (self.error[0], self.error[1]))


class ForceEntry(_Strict):
    """`force` of the file.

    press : of z. drag : of x and y; None where the reference had no such columns. change_at_rest : see
    `ForceModel`. recordings : source -> by how much its frames' time is ahead of that of its CSV, s.
    presses : in all of them. left_out : whether `rmse` is of whole recordings or of single presses that the
    fit has not seen.
    """

    press: LinearForceEntry
    drag: LinearForceEntry | None = None
    change_at_rest: float
    recordings: dict[str, float]
    presses: int
    left_out: Literal["recording", "press"]

    @model_validator(mode="after")
    def _known_features(self) -> ForceEntry:
        for part, known in ((self.press, {*BY_DEPTH, *BY_CHANGE}), (self.drag, {*BY_SHEAR})):
            if part is not None and not (part.stiffness.keys() == part.greatest.keys() <= known):
                raise ValueError(
                    f"required features from {sorted(known)}, each with its stiffness and greatest"
                )
        return self

    def model(self) -> ForceModel:
        """What the stage `force` computes with."""
        drag = None if self.drag is None else self.drag.model()
        return ForceModel(self.press.model(), drag, self.change_at_rest)


class _File(_Strict):
    format: Literal["tactflow.calibration/1"]
    sensor: str
    made: str
    made_from: str
    tactflow: str
    raw_size: list[int] = Field(min_length=2, max_length=2)
    size: list[int] = Field(min_length=2, max_length=2)
    corners: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(
        min_length=4, max_length=4
    )
    scale: ScaleEntry
    photometric: PhotometricEntry | None = None
    force: ForceEntry | None = None


@dataclass(frozen=True, slots=True)
class Calibration:
    """What is known about one sensor.

    sensor, made, made_from : its name, when (UTC), from which source.
    raw_size, size : (width, height) of the raw and of the processed frame, px.
    corners : (4, 2) float64, where the corner pixels of the processed frame lie in the raw one, px.
    look : (12, 16, 3) float32, the untouched gel without markers, grey levels, BGR.
    scale, scale_by : millimetres per pixel, and how they were found. version : of tactflow.
    slopes, photometric : which slope has which colour, and how well; None where that is not known.
    force : how the force follows from a contact; None where that is not known.
    """

    sensor: str
    made_from: str
    raw_size: tuple[int, int]
    size: tuple[int, int]
    corners: NDArray[np.float64]
    look: NDArray[np.float32]
    scale: Scale
    scale_by: str
    slopes: SlopeModel | None = None
    photometric: PhotometricEntry | None = None
    force: ForceEntry | None = None
    made: str = ""
    version: str = __version__

    def save(self, path: Path) -> None:
        """Write the YAML file, and beside it the arrays in a `.npz` of the same name.

        Raises ConfigError if the name does not end in .yaml, or the files cannot be written.
        """
        if path.suffix != ".yaml":
            raise ConfigError(f"calibration: required a file whose name ends in .yaml, got {path}")
        text = _File(
            format=FORMAT,
            sensor=self.sensor,
            made=self.made or datetime.now(UTC).isoformat(timespec="seconds"),
            made_from=public_address(self.made_from),
            tactflow=self.version,
            raw_size=list(self.raw_size),
            size=list(self.size),
            corners=self.corners.tolist(),
            scale=ScaleEntry(
                mm_per_pixel=[self.scale.x, self.scale.y],
                stderr=list(self.scale.stderr),
                origin=list(self.scale.origin),
                found_by=self.scale_by,
            ),
            photometric=self.photometric,
            force=self.force,
        ).model_dump()
        arrays: dict[str, Any] = {"look": self.look}
        if self.slopes is not None:
            arrays["slopes"] = self.slopes.coefficients
        try:
            # Both are whole before one takes the place of an earlier calibration, and then both do.
            with (
                ending_held_back(),
                completed(path) as unfinished,
                completed(path.with_suffix(".npz")) as unfinished_arrays,
            ):
                np.savez(unfinished_arrays, **arrays)
                unfinished.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"calibration: cannot write {path}: {error.strerror or error}") from None

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Read a calibration file, or the one that a recording (`.mcap`) was made with.

        Raises ConfigError if it or its arrays are not there, or are no calibration.
        """
        try:
            said = _File.model_validate(yaml.safe_load(stored_text(path).decode("utf-8")))
            arrays = _arrays(stored_arrays(path))
            look = np.asarray(arrays["look"], np.float32)
            slopes = SlopeModel(arrays["slopes"]) if "slopes" in arrays else None
        except OSError as error:
            raise ConfigError(f"calibration {path}: {error.filename}: {error.strerror}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            other = not where or (where, first["type"]) == ("format", "missing")
            told = "is no calibration file" if other else f"{where}: {first['msg']}"
            raise ConfigError(f"calibration {path}: {told}; {_REMEDY}") from None
        except Exception as error:
            # What YAML, ZIP and numpy raise about damaged data is many things.
            raise ConfigError(f"calibration {path}: cannot be read: {error}; {_REMEDY}") from None
        if look.shape != (LOOK[1], LOOK[0], 3) or not np.isfinite(look).all():
            raise ConfigError(f"calibration {path}: its .npz is of another file; {_REMEDY}")
        if (slopes is None) != (said.photometric is None):
            raise ConfigError(f"calibration {path}: its .npz is of another file; {_REMEDY}")
        x, y = said.scale.mm_per_pixel
        if not (x > 0 and y > 0):
            raise ConfigError(f"calibration {path}: scale.mm_per_pixel: required > 0, got {x:g}, {y:g}")
        return cls(
            sensor=said.sensor,
            made=said.made,
            made_from=said.made_from,
            version=said.tactflow,
            raw_size=_pair(said.raw_size),
            size=_pair(said.size),
            corners=np.array(said.corners, np.float64).reshape(4, 2),
            look=look,
            scale=Scale(x, y, _pair(said.scale.stderr), _pair(said.scale.origin)),
            scale_by=said.scale.found_by,
            slopes=slopes,
            photometric=said.photometric,
            force=said.force,
        )

    def misfit(self, mapping: PixelMapping) -> str | None:
        """Why it cannot be used for frames of this geometry; None if it can."""
        made = f"the calibration was made {self.made} from {self.made_from}"
        if mapping.raw_size != self.raw_size:
            return f"{made}, with frames of {_by(self.raw_size)}; these have {_by(mapping.raw_size)}"
        if mapping.size != self.size:
            return f"{made}, where preprocess gave {_by(self.size)}; here it gives {_by(mapping.size)}"
        moved = float(np.linalg.norm(raw_corners(mapping) - self.corners, axis=1).max())
        if moved > MOVED:
            return (
                f"{made}, with another preprocess: a corner of the picture lies {moved:.1f} raw px elsewhere"
            )
        return None

    def unlikeness(self, untouched: NDArray[np.uint8]) -> float:
        """How much an untouched gel without markers, (H, W, 3) uint8, differs from the one of the file.

        RMS, relative to the brightness, after each channel was scaled to its own mean: 0 is the same, see
        `UNLIKE`.
        """
        now = small_picture(untouched)
        level = np.maximum(self.look.mean(axis=(0, 1)), 1)
        gain = level / np.maximum(now.mean(axis=(0, 1)), 1)
        return float(np.sqrt(np.mean(((now * gain - self.look) / level) ** 2)))


_REMEDY = "make it anew with `tactflow calibrate`"


def small_picture(untouched: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(12, 16, 3) float32: means over blocks of a picture (H, W, 3) uint8, grey levels."""
    return np.asarray(
        cv2.resize(untouched.astype(np.float32), LOOK, interpolation=cv2.INTER_AREA), np.float32
    )


def raw_corners(mapping: PixelMapping) -> NDArray[np.float64]:
    """(4, 2) float64: where the corner pixels of the processed frame lie in the raw one, px.

    >>> raw_corners(PixelMapping.identity((3, 2))).tolist()
    [[0.0, 0.0], [2.0, 0.0], [0.0, 1.0], [2.0, 1.0]]
    """
    width, height = mapping.size
    right, low = width - 1, height - 1
    return np.asarray(mapping.to_raw([[0, 0], [right, 0], [0, low], [right, low]]), np.float64)


def _bounded(path: Path, most: int) -> bytes:
    """The bytes of a file, unless they are more than any calibration has: a device has no end."""
    if is_device(str(path)):
        raise ValueError(f"{path} is a pipe or a device, not a file")
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"{path} is larger than {most >> 10} KiB")
    return data


def stored_text(path: Path) -> bytes:
    """The YAML file of a calibration: the file itself, or what is attached to a recording.

    Raises OSError or ValueError if it is not there, or larger than any calibration.
    """
    if path.suffix != ".mcap":
        return _bounded(path, LONGEST)
    text = _recorded(path, "calibration.yaml")
    if len(text) > LONGEST:
        raise ValueError(f"its calibration is larger than {LONGEST >> 10} KiB")
    return text


def stored_arrays(path: Path) -> bytes:
    """The `.npz` file of a calibration; as `stored_text`."""
    if path.suffix == ".mcap":
        return _recorded(path, "calibration.npz")
    return _bounded(path.with_suffix(".npz"), LARGEST)


def _recorded(path: Path, name: str) -> bytes:
    from tactflow.recording import CALIBRATION
    from tactflow.recording.reader import attachments

    found = attachments(path)
    if not found.keys() >= CALIBRATION:
        raise ValueError("the recording was made without a calibration")
    return found[name]


def _arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of a `.npz` file, unless they unpack to more than they may."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > LARGEST:
            raise ValueError(f"its arrays unpack to more than {LARGEST >> 20} MiB")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def _pair(values: list[Any]) -> Any:
    return (values[0], values[1])


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} px"
