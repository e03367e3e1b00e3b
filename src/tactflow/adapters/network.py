"""Stage `network`: a neural network of your own, from an ONNX file, as a part of the graph."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from tactflow.engine.contract import Declared, Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.ports import ArrayPort, Port, describe_type
from tactflow.ports import (
    ContactMask,
    Gradients,
    Image,
    MarkerMask,
    Picture,
    Touching,
    Unmarked,
    Untouched,
    Valid,
)
from tactflow.system.extras import missing
from tactflow.system.files import expanded
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import Depth, Features, Force, Markers

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

log = logging.getLogger("tactflow")

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
_READ: Final = "Array(uint8, 2, 'C', readonly=True)"
Side = int | None
"""Length of an axis; None where only a frame tells, or any will do."""

KNOWN: Final[dict[str, tuple[Any, int]]] = {
    "image": (Image, 3),
    "unmarked": (Unmarked, 3),
    "untouched": (Untouched, 3),
    "annotated": (Picture, 3),
    "contact_mask": (ContactMask, 1),
    "marker_mask": (MarkerMask, 1),
    "valid": (Valid, 1),
    "gradients": (Gradients, 2),
    "depth": (Depth, 1),
    "field": (DisplacementField, 2),
    "markers": (Markers, 4),
}
"""Port -> its type, and its channels: of markers x and y in the reference, then dx and dy."""
DTYPES: Final = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
"""Number types that inputs may have, by onnxruntime's names."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")]


class InputParams(StageParams):
    """What one input of the network gets: a port, resized, then (value - background) * scale, then
    (value - mean) / std."""

    port: Name = Field("image", description="the output of another stage, by name")
    background: Literal["none", "subtract", "subtract_half", "concat"] = Field(
        "none",
        description="what becomes of the untouched gel: subtract takes it off; subtract_half also adds 0.5 "
        "and clips to 0..1; concat puts it behind the channels of the picture",
    )
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = Field(
        None,
        description="width and height, px; null: those that the network asks for, else those of the port",
    )
    pad: bool = Field(False, description="keep the aspect when resizing, with black bars, and do not stretch")
    interpolation: Literal["linear", "area"] = Field(
        "linear", description="area averages when shrinking: smoother, but slower"
    )
    colour: Literal["bgr", "rgb", "grey"] = Field("bgr", description="order of the channels of a picture")
    scale: float = Field(1 / 255, description="factor on the values of the port; 1/255 brings bytes to 0..1")
    mean: tuple[float, ...] = Field((0.0,), min_length=1, description="one number, or one for each channel")
    std: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (1.0,), min_length=1, description="one number, or one for each channel"
    )
    coordinates: bool = Field(
        False, description="add two channels: column / width and row / height of each pixel"
    )
    frames: int = Field(1, ge=1, le=64, description="how many frames it sees; the first frame fills in")
    stride: int = Field(1, ge=1, le=1000, description="processed frames from one of these to the next")
    newest_first: bool = Field(False, description="order of these frames")
    join: Literal["channels", "time"] = Field(
        "channels", description="frames lie behind each other as channels, or along an axis of their own"
    )
    layout: Literal["chw", "hwc", "pixels"] = Field(
        "chw",
        description="order of the axes; pixels: one row of channels for each pixel (or marker), as a network "
        "for single pixels takes them",
    )

    @model_validator(mode="after")
    def _fits(self) -> InputParams:
        if self.frames > 1 and self.layout == "pixels":
            raise ValueError("several frames need the layout chw or hwc")
        if self.join == "time" and self.frames == 1:
            raise ValueError("join: time needs frames of 2 or more")
        if self.layout == "hwc" and self.join == "channels" and self.frames > 1:
            raise ValueError("with the layout hwc, several frames need join: time")
        if self.background != "none" and KNOWN.get(self.port, (None, 3))[1] != 3:
            raise ValueError(f"background: {self.port} is not a picture, so that it has none")
        return self

    @property
    def channels(self) -> Side:
        """Channels of one frame; None where the port does not tell before it comes."""
        known = KNOWN.get(self.port)
        if known is None:
            return None
        channels = 1 if self.colour == "grey" and known[1] == 3 else known[1]
        return channels * (2 if self.background == "concat" else 1) + 2 * self.coordinates

    def shape(self, channels: Side, height: Side, width: Side) -> tuple[Side, ...]:
        """Axes of what the network gets, without the batch."""
        if self.layout == "pixels":
            return (None if height is None or width is None else height * width, channels)
        if self.join == "channels":
            channels = None if channels is None else channels * self.frames
        axes = (channels, height, width) if self.layout == "chw" else (height, width, channels)
        return (self.frames, *axes) if self.join == "time" else axes


class OutputParams(StageParams):
    """One output. What it is follows from the name of its port: `force`, `gradients`, `contact_mask` and
    `features` are known to other stages and to the message, all others are arrays."""

    output: str | None = Field(
        None, description="its name in the file; null: that of the port, or the only one"
    )
    scale: float = Field(1.0, description="factor on the values, for instance -1 or 0.001")
    unit: str = Field("1", description="of the values; for features and arrays")
    shape: tuple[int | Name, ...] = Field(
        ("N",), description="of an array, without the batch: a number, or a name for any length"
    )
    threshold: float = Field(0.5, description="for contact_mask: what is larger is contact")


class Network(Stage):
    """Runs an ONNX file of your own on values of other stages, on the CPU or by another provider.

    The file is read as data: no library with operators of its own is loaded, nor weights from other files.
    """

    memory = "pure"

    class Params(StageParams):
        """The file, and what goes in and comes out."""

        file: str = Field(min_length=1, description="the ONNX file; relative to the pipeline file")
        inputs: dict[str, InputParams] = Field(min_length=1, description="name in the file -> what it gets")
        outputs: dict[Name, OutputParams] = Field(min_length=1, description="name of a port -> which output")
        provider: str = Field(
            "CPUExecutionProvider", description="of onnxruntime, such as CUDAExecutionProvider"
        )
        threads: int = Field(1, ge=1, le=1024, description="threads of the network's own, on the CPU")

        @field_validator("outputs")
        @classmethod
        def _no_port_twice(cls, outputs: dict[str, OutputParams]) -> dict[str, OutputParams]:
            if "contact_mask" in outputs and "touching" in outputs:
                raise ValueError("touching comes with contact_mask; give this output another name")
            return outputs

    params: Params

    @classmethod
    def declare(cls, params: Params) -> Declared:
        """Its inputs are the ports that `inputs` names, its outputs those of `outputs`."""
        names = [value.port for value in params.inputs.values()]
        if any(value.background != "none" for value in params.inputs.values()):
            names.append("untouched")
        inputs = [Port(name, KNOWN[name][0] if name in KNOWN else Any) for name in dict.fromkeys(names)]
        stateful = any(value.frames > 1 for value in params.inputs.values())
        outputs = [port for name, value in params.outputs.items() for port in _ports(name, value)]
        return Declared(inputs, outputs, "stateful" if stateful else "pure")

    def __init__(self, params: Params, directory: Path = Path()) -> None:
        """Prepare; nothing is read yet. directory : where a relative path is looked for."""
        super().__init__(params)
        found = directory / expanded(params.file)
        self._file = found if found.exists() else expanded(params.file)
        self.description = str(self._file)
        self._session: InferenceSession | None = None
        self._feeds = {name: _Feed(value) for name, value in params.inputs.items()}
        self._names = [port.name for port in self.declare(params).inputs]
        self._wanted: list[str] = []

    def open(self) -> None:
        """Read the file, and compare its inputs and outputs with the parameters.

        Raises StageError if onnxruntime or the provider is missing, or the file does not fit.
        """
        if (problem := missing("networks", "onnx", ["onnxruntime"])) is not None:
            raise StageError(problem)
        import onnxruntime

        p = self.params
        providers = onnxruntime.get_available_providers()
        if p.provider not in providers:
            raise StageError(f"there is no provider {p.provider} here; there are {', '.join(providers)}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = p.threads, 1
        # What goes wrong is raised, too.
        options.log_severity_level = 4
        try:
            # As bytes, so that the file cannot name others for its weights.
            content = self._file.read_bytes()
            session = onnxruntime.InferenceSession(content, options, providers=[p.provider])
        except OSError as error:
            raise StageError(f"cannot read the network {self._file}: {error.strerror}") from None
        except Exception as error:
            raise StageError(f"{self._file} cannot be used as an ONNX file: {error}") from error
        if session.get_providers()[0] != p.provider:
            raise StageError(
                f"the provider {p.provider} cannot be used here, for lack of a driver or library"
            )
        self._check(session)
        self._session = session

    def _check(self, session: InferenceSession) -> None:
        inputs = {value.name: value for value in session.get_inputs()}
        if inputs.keys() != self._feeds.keys():
            raise StageError(
                f"{self._file}: its inputs are {', '.join(inputs)}, but inputs: has {', '.join(self._feeds)}"
            )
        for name, feed in self._feeds.items():
            feed.fit(f"{self._file}: input {name}", inputs[name].shape, inputs[name].type)
        outputs = {value.name: value for value in session.get_outputs()}
        for port, value in self.params.outputs.items():
            only = next(iter(outputs)) if len(outputs) == 1 else port
            name = value.output or (port if port in outputs else only)
            if name not in outputs:
                raise StageError(
                    f"{self._file}: there is no output {name}; there are {', '.join(outputs)}: name one by "
                    f"outputs.{port}.output"
                )
            wanted = _wanted_shapes(port, value, self._first.params)
            if not any(_agree(_sides(outputs[name].shape), shape) for shape in wanted):
                raise StageError(
                    f"{self._file}: output {name} has the shape {_shown(outputs[name].shape)}, but the port "
                    f"{port} needs {' or '.join(map(_shown, wanted))}"
                )
            self._wanted.append(name)

    @property
    def _first(self) -> _Feed:
        """The input whose picture outputs of a picture's size belong to."""
        return next(iter(self._feeds.values()))

    def close(self) -> None:
        """Free the network."""
        self._session = None

    def reset(self) -> None:
        """Forget earlier frames."""
        for feed in self._feeds.values():
            feed.reset()

    def process(self, *inputs: Any) -> tuple[Any, ...]:
        """Run the network on the values of the ports that `declare` names, in this order."""
        assert self._session is not None, "open() was not called"
        values = dict(zip(self._names, inputs, strict=True))
        background = values.get("untouched")
        feeds = {name: feed(values[feed.params.port], background) for name, feed in self._feeds.items()}
        found = self._session.run(list(dict.fromkeys(self._wanted)), feeds)
        by_name = dict(zip(dict.fromkeys(self._wanted), found, strict=True))
        results: list[Any] = []
        for name, (port, value) in zip(self._wanted, self.params.outputs.items(), strict=True):
            array = np.asarray(by_name[name], np.float32)
            if value.scale != 1:
                array = array * np.float32(value.scale)
            if not np.isfinite(array).all():
                raise StageError(f"{self._file}: output {name} is not finite in this frame")
            results += self._result(port, value, array)
        return tuple(results)

    def _result(self, port: str, params: OutputParams, array: Floats) -> list[Any]:
        """The values of the ports that an output becomes."""
        if port == "force":
            return [_force(array.ravel().tolist())]
        if port == "features":
            return [Features(array.ravel(), params.unit)]
        if port == "gradients":
            return [self._first.picture(array, 2)]
        if port == "contact_mask":
            mask = (self._first.picture(array, 1)[..., 0] > params.threshold) * np.uint8(255)
            return [mask, bool(mask.any())]
        return [array[0] if array.ndim == len(params.shape) + 1 else array]


class _Geometry(NamedTuple):
    """Where a picture lies in what the network sees: its own size, and the part that it fills. px."""

    size: tuple[int, int]
    inner: tuple[int, int]
    corner: tuple[int, int]
    outer: tuple[int, int]


class _Feed:
    """Makes what one input of the network gets, in memory that the next frame uses again."""

    def __init__(self, params: InputParams) -> None:
        self.params = params
        self._past: deque[NDArray[Any]] = deque(maxlen=(params.frames - 1) * params.stride + 1)
        self._where = ""
        self._sides: tuple[Side, ...] = ()
        self._size = params.size
        self._dtype: type[Any] = np.float32
        self._shape: tuple[int, ...] = ()
        self._background: Untouched | None = None

    def fit(self, where: str, shape: Sequence[Any], dtype: str) -> None:
        """Compare with the input of the file. Raises StageError with both shapes if they do not fit."""
        if dtype not in DTYPES:
            raise StageError(f"{where}: required one of {', '.join(DTYPES)}, got {dtype}")
        self._where, self._sides, self._dtype = where, _sides(shape), DTYPES[dtype]
        p = self.params
        if self._dtype is np.uint8 and "scale" not in p.model_fields_set:
            raise StageError(f"{where} takes bytes, but scale brings them to 0..1: give scale: 1, or another")
        axes = p.shape(None, None, None)
        if p.size is None and p.layout != "pixels" and len(self._sides) - len(axes) in (0, 1):
            height, width = self._sides[-2:] if p.layout == "chw" else self._sides[-3:-1]
            self._size = None if height is None or width is None else (width, height)
        width, height = self._size or (None, None)
        self._compare(p.shape(p.channels, height, width))
        if p.channels is not None:
            self._coefficients(p.channels - 2 * p.coordinates)

    def _compare(self, shape: tuple[Side, ...]) -> None:
        if not _agree(self._sides, shape):
            raise StageError(
                f"{self._where} takes {_shown(self._sides)}, but the settings give {_shown(shape)} "
                "(without a batch); see port, size, frames and layout of this input"
            )

    def reset(self) -> None:
        """Forget earlier frames."""
        self._past.clear()

    def __call__(self, value: Any, background: Untouched | None) -> NDArray[Any]:
        """What the network gets of this frame."""
        p, array = self.params, _array(value)
        if array.shape != self._shape:
            self._prepare(array)
        if p.background != "none":
            if background is None or background.shape != array.shape:
                shape = None if background is None else background.shape
                raise StageError(f"{self._where}: required an untouched gel of {array.shape}, got {shape}")
            if background is not self._background:
                self._background, self._rest = background, self._resized(background)
        oldest = self._past[0] if len(self._past) == self._past.maxlen and self._owned else None
        self._past.append(self._resized(array, oldest))
        places = [max(0, len(self._past) - 1 - back * p.stride) for back in range(p.frames)]
        for place, part in zip(places if p.newest_first else places[::-1], self._parts, strict=True):
            self._write(self._past[place], part)
        if self._dtype is np.float32:
            return self._tensor
        if self._dtype is np.uint8:
            return np.clip(np.rint(self._tensor), 0, 255).astype(np.uint8)
        return self._tensor.astype(self._dtype)

    def _prepare(self, array: NDArray[Any]) -> None:
        """Make room for frames like this one."""
        p, (height, width) = self.params, array.shape[:2]
        self._geometry = _placed((width, height), self._size or (width, height), p.pad)
        self.reset()
        self._background, self._shape = None, array.shape
        resized = self._resized(array)
        # Whether resized pictures are ours to write to.
        self._owned = resized is not array
        height, width, count = np.atleast_3d(resized).shape
        channels = count * (2 if p.background == "concat" else 1)
        shape = p.shape(channels + 2 * p.coordinates, height, width)
        self._compare(shape)
        affine = self._coefficients(channels)
        groups = [affine[:, first : first + count] for first in range(0, channels, count)]
        # In the order of the picture, which is blue, green, red.
        self._is_reversed = p.colour == "rgb" and count == 3
        self._affines = [(group[:, ::-1] if self._is_reversed else group).copy() for group in groups]
        self._rest = self._nothing = np.zeros(resized.shape, resized.dtype)
        batch = (1,) if len(self._sides) > len(shape) else ()
        self._tensor = np.empty((*batch, *(side or 0 for side in shape)), np.float32)
        axes = (-1, height, width) if p.layout == "chw" else (height, width, -1)
        self._parts = self._tensor.reshape(p.frames, *axes)
        planes = np.empty((1, channels + 2 * p.coordinates, height, width), np.float32)
        self._planes = planes = self._parts if p.layout == "chw" else planes
        if p.coordinates:
            planes[:, -2] = np.arange(width, dtype=np.float32) / width
            planes[:, -1] = np.arange(height, dtype=np.float32)[:, None] / height

    def _coefficients(self, count: int) -> Floats:
        """(4, count) of the network's channels: factor, offset, least and greatest value."""
        p = self.params
        for name, numbers in (("mean", p.mean), ("std", p.std)):
            if len(numbers) not in (1, count):
                raise StageError(f"{self._where}: {name} has {len(numbers)} numbers for {count} channels")
        half = p.background == "subtract_half"
        bounds = (0.0, 1.0) if half else (-np.inf, np.inf)
        mean, std = np.resize(p.mean, count), np.resize(p.std, count)
        factor = np.full(count, p.scale) / std
        return np.array([factor, *((value - mean) / std for value in (0.5 * half, *bounds))], np.float32)

    def _resized(self, array: NDArray[Any], into: NDArray[Any] | None = None) -> NDArray[Any]:
        """A picture in the network's size, grey if asked for. into : memory that may be used."""
        p, geometry = self.params, self._geometry
        given = array
        if p.colour == "grey" and array.ndim == 3 and array.shape[2] == 3:
            array = cv2.cvtColor(array, cv2.COLOR_BGR2GRAY)
        if geometry.inner != geometry.size:
            method = cv2.INTER_AREA if p.interpolation == "area" else cv2.INTER_LINEAR
            array = cv2.resize(array, geometry.inner, into, interpolation=method)
        if geometry.inner != geometry.outer:
            (left, top), (width, height) = geometry.corner, geometry.inner
            right, bottom = geometry.outer[0] - left - width, geometry.outer[1] - top - height
            array = cv2.copyMakeBorder(array, top, bottom, left, right, cv2.BORDER_CONSTANT, into)
        # Others may write to theirs before it is needed again.
        return array.copy() if array is given and p.frames > 1 else array

    def _write(self, picture: NDArray[Any], part: Floats) -> None:
        """Fill the part of the tensor that belongs to one frame."""
        p = self.params
        if p.layout == "pixels" and part.shape[2] == 5 and p.coordinates and picture.dtype == np.uint8:
            _pixels(*_lines(picture, self._rest), self._is_reversed, self._affines[0], part)
            return
        planes = part if p.layout == "chw" else self._planes[0]
        rest = self._nothing if p.background == "concat" else self._rest
        for index, affine in enumerate(self._affines):
            count = affine.shape[1]
            own = planes[index * count : (index + 1) * count]
            self._convert(self._rest if index else picture, rest, affine, own)
        if p.layout != "chw":
            cv2.merge(list(planes), part)

    def _convert(self, picture: NDArray[Any], rest: NDArray[Any], affine: Floats, planes: Floats) -> None:
        """Fill planes (C, h, w) with (picture - rest) * factor + offset, within its limits."""
        if picture.dtype == np.uint8 and len(planes) == 3:
            _planes(*_lines(picture, rest), self._is_reversed, affine, planes)
            return
        planes = planes[::-1] if self._is_reversed else planes
        channels = zip(cv2.split(picture), cv2.split(rest), affine.T, strict=True)
        for plane, (channel, less, own) in zip(planes, channels, strict=True):
            factor, offset, least, greatest = map(float, own)
            cv2.addWeighted(channel, factor, less, -factor, offset, plane, cv2.CV_32F)
            if np.isfinite(least):
                np.clip(plane, least, greatest, plane)

    def picture(self, array: Floats, channels: int) -> Floats:
        """(H, W, channels) float32: an output of the size of the network's picture, at that of the port."""
        geometry = self._geometry
        width, height = geometry.outer
        shape = (channels, height, width) if self.params.layout == "chw" else (height, width, channels)
        if array.size != channels * height * width:
            raise StageError(f"required an output of the size of the input, {shape}, got {array.shape}")
        array = array.reshape(shape)
        if self.params.layout == "chw":
            array = np.moveaxis(array, 0, -1)
        (left, top), (width, height) = geometry.corner, geometry.inner
        inner = np.ascontiguousarray(array[top : top + height, left : left + width])
        if geometry.inner != geometry.size:
            inner = np.asarray(cv2.resize(inner, geometry.size, interpolation=cv2.INTER_LINEAR), np.float32)
        return inner.reshape(*geometry.size[::-1], channels)


def _lines(picture: NDArray[Any], rest: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """(h, 3 w) each."""
    return picture.reshape(len(picture), -1), rest.reshape(len(rest), -1)


def _placed(size: tuple[int, int], outer: tuple[int, int], pad: bool) -> _Geometry:
    """Where a picture of a size lies in what the network sees. pad : whether it keeps its aspect."""
    inner = outer
    if pad:
        ratio = min(outer[0] / size[0], outer[1] / size[1])
        inner = max(1, round(size[0] * ratio)), max(1, round(size[1] * ratio))
    return _Geometry(size, inner, ((outer[0] - inner[0]) // 2, (outer[1] - inner[1]) // 2), outer)


@kernel(f"void({_READ}, {_READ}, boolean, float32[:, ::1], float32[:, :, ::1])")
def _planes(picture: Bytes, rest: Bytes, rgb: bool, affine: Floats, planes: Floats) -> None:
    """Fill `planes`, (3, h, w), from `picture` and `rest`, (h, 3 w). affine : as of `_Feed._coefficients`."""
    change = np.empty(picture.shape[1], np.int16)
    first, last = (2, 0) if rgb else (0, 2)
    for y in range(picture.shape[0]):
        _line(picture[y], rest[y], affine, change, planes[first, y], planes[1, y], planes[last, y])


@kernel(f"void({_READ}, {_READ}, boolean, float32[:, ::1], float32[:, :, ::1])")
def _pixels(picture: Bytes, rest: Bytes, rgb: bool, affine: Floats, pixels: Floats) -> None:
    """Fill `pixels`, (h, w, 5): the three colors as in `_planes`, then x / w and y / h."""
    height, width, _ = pixels.shape
    change, line = np.empty(picture.shape[1], np.int16), np.empty((4, width), np.float32)
    first, last = (2, 0) if rgb else (0, 2)
    for x in range(width):
        line[3, x] = np.float32(x) / np.float32(width)
    for y in range(height):
        _line(picture[y], rest[y], affine, change, line[first], line[1], line[last])
        row, down = pixels[y].reshape(-1), np.float32(y) / np.float32(height)
        # All five, for a gap would keep whole vectors from being written.
        for x in range(width):
            row[5 * x] = line[0, x]
            row[5 * x + 1] = line[1, x]
            row[5 * x + 2] = line[2, x]
            row[5 * x + 3] = line[3, x]
            row[5 * x + 4] = down


@helper
def _line(
    picture: Bytes,
    rest: Bytes,
    affine: Floats,
    change: NDArray[np.int16],
    blue: Floats,
    green: Floats,
    red: Floats,
) -> None:
    """Fill one line, (w,), of each color. change : (3 w,), memory that stays in the cache."""
    for x in range(change.size):
        change[x] = np.int16(picture[x]) - np.int16(rest[x])
    factor, offset, least, greatest = affine[0], affine[1], affine[2], affine[3]
    f0, f1, f2 = factor[0], factor[1], factor[2]
    o0, o1, o2 = offset[0], offset[1], offset[2]
    l0, l1, l2 = least[0], least[1], least[2]
    g0, g1, g2 = greatest[0], greatest[1], greatest[2]
    for x in range(blue.size):
        blue[x] = min(max(np.float32(change[3 * x]) * f0 + o0, l0), g0)
        green[x] = min(max(np.float32(change[3 * x + 1]) * f1 + o1, l1), g1)
        red[x] = min(max(np.float32(change[3 * x + 2]) * f2 + o2, l2), g2)


def _ports(name: str, params: OutputParams) -> list[Port]:
    """The ports that an output becomes."""
    if name == "contact_mask":
        return [Port(name, ContactMask), Port("touching", Touching)]
    known: Mapping[str, Any] = {"force": Force, "features": Features, "gradients": Gradients}
    array = Annotated[NDArray[np.float32], ArrayPort(name, params.shape, "float32", params.unit)]
    return [Port(name, known.get(name, array))]


def _array(value: Any) -> NDArray[Any]:
    """The value of a port as (H, W) or (H, W, C), uint8 or float32; markers as (N, 1, 4)."""
    if isinstance(value, Depth):
        return value.heights
    if isinstance(value, Markers):
        value = np.hstack([value.origin, value.displacement])[:, None]
    elif isinstance(value, DisplacementField):
        value = value.displacement
    if not isinstance(value, np.ndarray) or value.ndim not in (2, 3) or not value.size:
        got = value.shape if isinstance(value, np.ndarray) else describe_type(type(value))
        raise StageError(f"required an array (H, W) or (H, W, C), got {got}")
    if value.dtype == np.uint8:
        return value
    return np.ascontiguousarray(value, np.float32)


def _force(numbers: Sequence[float]) -> Force:
    """A force of (z) or (x, y, z), N. A network tells neither its errors nor what it was trained on."""
    if len(numbers) not in (1, 3):
        raise StageError(f"force: required 1 number (z) or 3 (x, y, z), got {len(numbers)}")
    x, y = numbers[:-1] or (None, None)
    unknown = None if x is None else np.nan
    return Force((x, y, max(numbers[-1], 0.0)), (unknown, unknown, np.nan), False)


def _wanted_shapes(port: str, params: OutputParams, first: InputParams) -> list[tuple[Side, ...]]:
    """Shapes that an output may have, without the batch."""
    if port == "force":
        return [(1,), (3,)]
    if port == "features":
        return [(None,)]
    if port in ("gradients", "contact_mask"):
        channels = 2 if port == "gradients" else 1
        if first.layout == "pixels":
            return [(None, channels)]
        return [(channels, None, None) if first.layout == "chw" else (None, None, channels)]
    return [tuple(side if isinstance(side, int) else None for side in params.shape)]


def _sides(shape: Sequence[Any]) -> tuple[Side, ...]:
    """A shape of onnxruntime; axes of any length have names there, or None."""
    return tuple(side if isinstance(side, int) else None for side in shape)


def _agree(network: tuple[Side, ...], ours: tuple[Side, ...]) -> bool:
    """Whether shapes fit, the network's with or without a batch of one in front."""
    if len(network) == len(ours) + 1 and network[0] in (1, None):
        network = network[1:]
    pairs = zip(network, ours, strict=False)
    return len(network) == len(ours) and all(a == b or a is None or b is None for a, b in pairs)


def _shown(shape: Sequence[Any]) -> str:
    return f"({', '.join('any' if side is None else str(side) for side in shape)})"
