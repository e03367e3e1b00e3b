"""The calibration file of a sensor: readable YAML, and arrays beside it.

`left.yaml` has the sensor, its origin, and the fitted values with their errors; `left.npz` has the arrays: a
small picture of the untouched gel, and the coefficients of the slopes.
"""

from __future__ import annotations

import io
import zipfile
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    ValidationError,
)

from tactflow import __version__
from tactflow.engine.errors import ConfigError
from tactflow.recording.calibration import MAX_ARRAY_BYTES, stored_arrays, stored_text
from tactflow.system.files import completed
from tactflow.system.redaction import public_address
from tactflow.vision.depth.darkness import DarknessModel
from tactflow.vision.depth.slopes import COLOUR_TERMS, PLACE_TERMS, SlopeModel
from tactflow.vision.depth.surface import SurfaceErrors
from tactflow.vision.field_force import FieldForce
from tactflow.vision.force import Accuracy, DotsForce, ForceModel, LinearForce
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

LOOK: Final = (16, 12)
"""Columns and rows of the stored picture of the untouched gel. Chosen by hand."""
MOVED: Final = 1.0
"""Largest shift of a corner of the processed frame in the raw frame, raw px. Chosen by hand: rounding in a
pipeline file shifts it less."""
UNLIKE: Final = 0.1
"""Largest difference of the untouched gel, see `Calibration.unlikeness`. Chosen by hand: presses of one
session differ by 0.01."""
ASPECT: Final = 0.02
"""Largest relative difference of the aspect ratios of frames of the same shape. Chosen by hand."""
ALIGNED: Final = 0.9
"""Least cosine of the angle between the axes of frames with the same rotation."""
TERMS: Final = PLACE_TERMS * COLOUR_TERMS
"""Coefficients of one part of the normal."""

Pair = Annotated[tuple[float, float], BeforeValidator(tuple)]
Size = Annotated[tuple[int, int], BeforeValidator(tuple)]
AXES: Final[tuple[Literal["x", "y", "z"], ...]] = ("x", "y", "z")
"""Components of a force, in order."""
LeftOut = Literal["object", "recording", "press", "load"]


class _Entry(BaseModel):
    # Files of earlier versions have entries that nothing reads any more.
    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False, frozen=True)


class ScaleEntry(_Entry):
    """`scale` of the file: along x and y, mm per px, their standard errors, the origin (px), the method."""

    mm_per_pixel: Annotated[tuple[PositiveFloat, PositiveFloat], BeforeValidator(tuple)]
    stderr: Pair
    origin: Pair
    found_by: str

    @classmethod
    def of(cls, scale: Scale, found_by: str) -> Self:
        """The entry for a scale. found_by : how it was found, for people."""
        return cls(
            mm_per_pixel=(scale.x, scale.y), stderr=scale.stderr, origin=scale.origin, found_by=found_by
        )


class PhotometricEntry(_Entry):
    """`photometric` of the file: the presses that it was learned from, and its cross-validated errors.

    ball_radius : mm. presses, rejected : how many. normal_error : mean angle, degrees. depth_stderr : of
    balls, relative; for people, since the errors of a height map are those of `SurfaceErrors`. between : the
    part of it that is the difference of sensors of the kind. steepest : see `SurfaceErrors`. explained :
    share of the slopes of a ball that the fit explains, see `Misfit`; None in files of earlier versions.
    core_ratio : radius of a contact's core over that at which the gel leaves the ball; None where unknown.
    """

    ball_radius: float = Field(gt=0)
    presses: int
    rejected: int
    normal_error: float
    depth_stderr: float
    between: float = 0.0
    steepest: float | None = None
    explained: float | None = None
    core_ratio: float | None = None

    def errors(self) -> SurfaceErrors:
        """The basis of the standard errors of heights."""
        return SurfaceErrors(self.steepest, self.between)


class DarknessEntry(_Entry):
    """`darkness` of the file: depth of a gel that darkens with it, see `DarknessModel`.

    ball_radius : mm. presses : how many. darkening : relative. depth : of each darkening, mm. stderr : mm.
    """

    ball_radius: float = Field(gt=0)
    presses: int
    darkening: list[float]
    depth: list[float]
    stderr: float

    def model(self) -> DarknessModel:
        """The curve. Raises ValueError where its points are not increasing."""
        return DarknessModel(self.darkening, self.depth)


class LinearForceEntry(_Entry):
    """A force that is linear in features, and its cross-validated errors.

    stiffness, greatest, error : see `LinearForce`. range : least and largest force of the fit, N.
    rmse : RMS error, N. r2 : coefficient of determination.
    """

    stiffness: dict[str, float]
    greatest: dict[str, float]
    error: Pair
    range: Pair
    rmse: float
    r2: float

    def model(self) -> LinearForce:
        """The model that the stage `force` evaluates."""
        return LinearForce(self.stiffness, self.greatest, self.error)


class DotsForceEntry(_Entry):
    """One component of the force by the displacement of the dots, and its cross-validated errors.

    error : see `Accuracy`. range, rmse, r2 : as in `LinearForceEntry`.
    """

    error: Pair
    range: Pair
    rmse: float
    r2: float

    def model(self) -> Accuracy:
        """What the stage `force` states about this component."""
        return Accuracy(self.error, max(map(abs, self.range)))


class ForceEntry(_Entry):
    """`force` of the file.

    press : of z; None where the dots measure it better. drag : of x and y; None where the reference had no
    such columns, or the flow does not explain them. dots : component ("x", "y", "z") -> its errors; the terms
    are `field_force` of the `Calibration`. change_at_rest, least_change : see `ForceModel`. recordings :
    source -> offset of its frames' time against that of its CSV, s. presses : or loads, in all of them.
    left_out : what the errors are cross-validated over. drift : relative difference that known loads have
    shown since, beyond the errors.
    """

    press: LinearForceEntry | None
    drag: LinearForceEntry | None = None
    dots: dict[Literal["x", "y", "z"], DotsForceEntry] = Field(default_factory=dict)
    change_at_rest: float
    least_change: float | None = None
    recordings: dict[str, float]
    presses: int
    left_out: LeftOut
    drift: NonNegativeFloat = 0.0

    @property
    def pressing(self) -> LinearForceEntry | DotsForceEntry:
        """Errors of the component z."""
        return self.dots["z"] if self.press is None else self.press

    def model(self, field: FieldForce | None = None) -> ForceModel:
        """The model that the stage `force` evaluates. field : None without dots."""
        press, drag = (None if part is None else part.model() for part in (self.press, self.drag))
        x, y, z = (None if (entry := self.dots.get(axis)) is None else entry.model() for axis in AXES)
        dots = None if field is None or not self.dots else DotsForce(field, (x, y, z))
        return ForceModel(press, drag, self.change_at_rest, self.least_change, dots)


class Calibration(_Entry):
    """What is known about one sensor.

    sensor, made, made_from, tactflow : its name, when (UTC), from which source, by which version.
    raw_size, size : (width, height) of the raw and of the processed frame, px.
    corners : (4, 2), where the corner pixels of the processed frame lie in the raw one, px.
    scale_entry : millimetres per pixel. photometric, slopes : slopes from colours, and their errors.
    darkness : depth from darkening, for gels in white light. force : from contacts. None if not known.
    kind : of sensor that it is the default of, for frames of the same shape and any size; else None.
    gel_thickness : mm, which no depth exceeds; None where it is not known.
    dot_pitch : spacing of the dots of the gels with dots of that kind, mm; None where not known.
    look : (12, 16, 3) float32, the untouched gel without markers, grey levels, BGR.
    recorded : whether it comes from a recording, which was made with it.
    information : (114, 114) float64, `Photometry.information`, to refine it for another sensor; None without
    slopes. field_force : of the force by dots; None without.
    """

    model_config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, populate_by_name=True)

    format: Literal["tactflow.calibration/1"] = "tactflow.calibration/1"
    sensor: str
    kind: str | None = None
    dot_pitch: PositiveFloat | None = None
    made: str = Field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    made_from: str
    tactflow: str = __version__
    raw_size: Size
    size: Size
    corners: Annotated[list[Pair], Field(min_length=4, max_length=4)]
    scale_entry: ScaleEntry = Field(alias="scale")
    gel_thickness: PositiveFloat | None = None
    photometric: PhotometricEntry | None = None
    darkness: DarknessEntry | None = None
    force: ForceEntry | None = None
    look: NDArray[np.float32] = Field(exclude=True, repr=False)
    recorded: bool = Field(False, exclude=True, repr=False)
    slopes: SlopeModel | None = Field(None, exclude=True, repr=False)
    information: NDArray[np.float64] | None = Field(None, exclude=True, repr=False)
    field_force: FieldForce | None = Field(None, exclude=True, repr=False)

    @cached_property
    def scale(self) -> Scale:
        """Millimetres per pixel."""
        entry = self.scale_entry
        return Scale(*entry.mm_per_pixel, entry.stderr, entry.origin)

    def scale_at(self, size: tuple[int, int]) -> Scale:
        """Millimetres per pixel of processed frames (width, height), px, that `misfit` accepts."""
        if size == self.size:
            return self.scale
        across, down = self.size[0] / size[0], self.size[1] / size[1]
        (x, y), (x_error, y_error) = self.scale_entry.mm_per_pixel, self.scale_entry.stderr
        center = (size[0] - 1) / 2, (size[1] - 1) / 2
        return Scale(x * across, y * down, (x_error * across, y_error * down), center)

    def at(self, scale: Scale, size: tuple[int, int]) -> Self:
        """The same for processed frames (width, height), px, that show another part of the gel around the
        same middle. scale : mm per px of these frames."""
        usual = self.scale_at(size)
        zoom = scale.x / usual.x, scale.y / usual.y
        if zoom == (1, 1):
            return self
        known = self.scale_entry
        (x, y), (across, down) = known.mm_per_pixel, zoom
        error = scale.stderr[0] / scale.x * x * across, scale.stderr[1] / scale.y * y * down
        entry = known.model_copy(update={"mm_per_pixel": (x * across, y * down), "stderr": error})
        slopes = None if self.slopes is None else self.slopes.zoomed(*zoom)
        # `cached_property` keeps the scale in the instance.
        copy = self.model_copy(update={"scale_entry": entry, "slopes": slopes})
        copy.__dict__.pop("scale", None)
        return copy

    def save(self, path: Path) -> None:
        """Write the YAML file, and beside it the arrays in a `.npz` of the same name.

        Raises ConfigError if the name does not end in .yaml, or the files cannot be written.
        """
        if path.suffix != ".yaml":
            raise ConfigError(f"calibration: required a file whose name ends in .yaml, got {path}")
        text = self.model_dump(by_alias=True) | {"made_from": public_address(self.made_from)}
        arrays: dict[str, Any] = {"look": self.look}
        if self.slopes is not None:
            arrays["slopes"] = self.slopes.coefficients
        if self.information is not None:
            # It is symmetric.
            arrays["information"] = self.information[np.tril_indices(TERMS)].astype(np.float32)
        if self.field_force is not None:
            arrays["force_modes"], arrays["force_weights"] = self.field_force.modes, self.field_force.weights
        try:
            # Both are complete before either replaces an earlier calibration.
            with completed(path) as unfinished, completed(path.with_suffix(".npz")) as unfinished_arrays:
                np.savez(unfinished_arrays, **arrays)
                unfinished.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"calibration: cannot write {path}: {error.strerror or error}") from None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a calibration file, or the one that a recording (`.mcap`) was made with.

        Raises ConfigError if it or its arrays are missing, damaged, or not a calibration.
        """
        try:
            document = yaml.safe_load(stored_text(path).decode("utf-8"))
            if not isinstance(document, dict) or "format" not in document:
                raise ValueError("is not a calibration file")
            arrays = _arrays(stored_arrays(path))
            if arrays["look"].shape != (LOOK[1], LOOK[0], 3) or not np.isfinite(arrays["look"]).all():
                raise ValueError("its .npz is of another file")
            slopes = SlopeModel(arrays["slopes"]) if "slopes" in arrays else None
            information = _symmetric(arrays["information"]) if "information" in arrays else None
            field = (
                FieldForce(arrays["force_modes"], arrays["force_weights"])
                if "force_modes" in arrays
                else None
            )
            loaded = cls(
                **document,
                look=arrays["look"].astype(np.float32),
                slopes=slopes,
                information=information,
                field_force=field,
                recorded=path.suffix == ".mcap",
            )
            by_dots = loaded.force is not None and bool(loaded.force.dots)
            if loaded.force is not None and loaded.force.press is None and "z" not in loaded.force.dots:
                raise ValueError("its force does not say how hard something presses")
            if (slopes is None) != (loaded.photometric is None) or (field is None) == by_dots:
                raise ValueError("its .npz is of another file")
            if loaded.darkness is not None:
                loaded.darkness.model()
            return loaded
        except OSError as error:
            raise ConfigError(f"calibration {path}: {error.filename}: {error.strerror}") from None
        except ValidationError as error:
            first = error.errors()[0]
            reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        except Exception as error:
            # YAML, ZIP and numpy raise many kinds of errors about damaged data.
            reason = str(error)
        raise ConfigError(f"calibration {path}: {reason}; make a new one with `tactflow calibrate`")

    def misfit(self, mapping: PixelMapping) -> str | None:
        """Why it does not fit frames of this geometry; None if it does."""
        if self.kind is not None:
            return self._misfit_of_kind(mapping)
        origin = f"the calibration was made {self.made} from {self.made_from}"
        if mapping.raw_size != self.raw_size:
            return f"{origin}, with frames of {_by(self.raw_size)}; these have {_by(mapping.raw_size)}"
        if mapping.size != self.size:
            return f"{origin}, where preprocess gave {_by(self.size)}; here it gives {_by(mapping.size)}"
        moved = float(np.linalg.norm(np.subtract(raw_corners(mapping), self.corners), axis=1).max())
        if moved > MOVED:
            return f"{origin}, with another preprocess: a corner lies {moved:.1f} raw px elsewhere"
        return None

    def _misfit_of_kind(self, mapping: PixelMapping) -> str | None:
        wide, expected = mapping.size[0] / mapping.size[1], self.size[0] / self.size[1]
        if abs(wide / expected - 1) > ASPECT:
            return f"frames of {_by(mapping.size)} have another shape than its {_by(self.size)}"
        here, there = (_axes(corners) for corners in (raw_corners(mapping), self.corners))
        if (np.sum(here * there, axis=1) < ALIGNED).any():
            return "the frames are turned or mirrored otherwise; it is for frames as the sensor gives them"
        return None

    def unlikeness(self, untouched: NDArray[np.uint8]) -> float:
        """RMS difference of an untouched gel without markers, (H, W, 3) uint8, from the one of the file.

        It is relative to the brightness, after each channel was scaled to the stored mean; see `UNLIKE`.
        """
        now = small_picture(untouched)
        level = np.maximum(self.look.mean(axis=(0, 1)), 1)
        gain = level / np.maximum(now.mean(axis=(0, 1)), 1)
        return float(np.sqrt(np.mean(((now * gain - self.look) / level) ** 2)))


def small_picture(untouched: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(12, 16, 3) float32: means over blocks of a picture (H, W, 3) uint8, grey levels."""
    return np.asarray(
        cv2.resize(untouched.astype(np.float32), LOOK, interpolation=cv2.INTER_AREA), np.float32
    )


def raw_corners(mapping: PixelMapping) -> list[tuple[float, float]]:
    """Where the four corner pixels of the processed frame lie in the raw one, px.

    >>> raw_corners(PixelMapping.identity((3, 2)))
    [(0.0, 0.0), (2.0, 0.0), (0.0, 1.0), (2.0, 1.0)]
    """
    width, height = mapping.size
    right, low = width - 1, height - 1
    corners = np.asarray(mapping.to_raw([[0, 0], [right, 0], [0, low], [right, low]]), np.float64)
    return [(float(x), float(y)) for x, y in corners]


def _axes(corners: list[tuple[float, float]]) -> NDArray[np.float64]:
    """(2, 2): unit vectors along x and y of a frame, from its corners."""
    first, right, below, _ = np.asarray(corners, np.float64)
    axes = np.stack([right - first, below - first])
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def _symmetric(lower: NDArray[np.floating]) -> NDArray[np.float64]:
    """(114, 114) from its lower triangle. Raises ValueError on another length, NaN or infinity."""
    if lower.shape != (TERMS * (TERMS + 1) // 2,) or not np.isfinite(lower).all():
        raise ValueError("its .npz is of another file")
    whole = np.zeros((TERMS, TERMS))
    whole[np.tril_indices(TERMS)] = lower
    return np.tril(whole, -1).T + whole


def _arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of a `.npz` file, unless they unpack to more than they may."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > MAX_ARRAY_BYTES:
            raise ValueError(f"its arrays unpack to more than {MAX_ARRAY_BYTES >> 20} MiB")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} px"
