"""Stage `network`: a neural network of your own, from an ONNX file, as a part of the graph."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

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
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import Depth, Features, Force, Markers

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

log = logging.getLogger("tactflow")

Floats = NDArray[np.float32]
Side = int | None
"""Length of an axis; None if any is valid, or only a frame tells."""

KNOWN_PORTS: Final[dict[str, tuple[Any, int]]] = {
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
"""Port -> type and number of channels; those of markers are x and y in the reference, dx and dy."""
DTYPES: Final = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
"""Valid number types of inputs, by onnxruntime's names."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")]


class InputParams(StageParams):
    """One input of the network: the value of a port, resized, then (value - background) * scale, then
    (value - mean) / std."""

    port: Name = Field("image", description="the output of another stage, by name")
    background: Literal["none", "subtract", "subtract_half", "concat"] = Field(
        "none",
        description="use of the untouched gel: subtract it; subtract_half also adds 0.5 and clips to 0..1; "
        "concat appends it to the channels of the picture",
    )
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = Field(
        None,
        description="width and height, px; null: those of the network's input, else those of the port",
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
    frames: int = Field(
        1,
        ge=1,
        le=64,
        description="number of frames, joined as channels, newest last; the first one fills in",
    )
    stride: int = Field(1, ge=1, le=1000, description="distance of these frames, in processed frames")
    layout: Literal["chw", "hwc", "pixels"] = Field(
        "chw",
        description="order of the axes; pixels: a row of channels for each pixel or marker",
    )

    @model_validator(mode="after")
    def _fits(self) -> InputParams:
        if self.frames > 1 and self.layout != "chw":
            raise ValueError("several frames need the layout chw")
        if self.background != "none" and KNOWN_PORTS.get(self.port, (None, 3))[1] != 3:
            raise ValueError(f"background: {self.port} is not a picture, so it has none")
        return self

    @property
    def channels(self) -> Side:
        """Channels of one frame; None if only a frame tells."""
        known = KNOWN_PORTS.get(self.port)
        if known is None:
            return None
        channels = 1 if self.colour == "grey" and known[1] == 3 else known[1]
        return channels * (2 if self.background == "concat" else 1) + 2 * self.coordinates

    def shape(self, channels: Side, height: Side, width: Side) -> tuple[Side, ...]:
        """Shape of the input, without the batch."""
        if self.layout == "pixels":
            return (None if height is None or width is None else height * width, channels)
        channels = None if channels is None else channels * self.frames
        return (channels, height, width) if self.layout == "chw" else (height, width, channels)


class OutputParams(StageParams):
    """One output. The name of its port defines its meaning: other stages and the message know `force`,
    `gradients`, `contact_mask` and `features`; all others are arrays."""

    output: str | None = Field(
        None, description="its name in the file; null: that of the port, or the only one"
    )
    scale: float = Field(1.0, description="factor on the values, for instance -1 or 0.001")
    unit: str = Field("1", description="of the values; for features and arrays")
    shape: tuple[int | Name, ...] = Field(
        ("N",), description="of an array, without the batch: a number, or a name for any length"
    )
    threshold: float = Field(0.5, description="for contact_mask: larger values are contact")


class Network(Stage):
    """Runs an ONNX file of your own on values of other stages, on the CPU or with another provider.

    The file is read as data: neither libraries of custom operators nor weights from other files are loaded.
    """

    memory = "pure"

    class Params(StageParams):
        """The file, its inputs and its outputs."""

        file: str = Field(min_length=1, description="the ONNX file; relative to the pipeline file")
        inputs: dict[str, InputParams] = Field(min_length=1, description="name in the file -> its settings")
        outputs: dict[Name, OutputParams] = Field(min_length=1, description="name of a port -> its output")
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
        """The inputs are the ports that `inputs` names, the outputs those of `outputs`."""
        names = [value.port for value in params.inputs.values()]
        if any(value.background != "none" for value in params.inputs.values()):
            names.append("untouched")
        inputs = [
            Port(name, KNOWN_PORTS[name][0] if name in KNOWN_PORTS else Any) for name in dict.fromkeys(names)
        ]
        stateful = any(value.frames > 1 for value in params.inputs.values())
        outputs = [port for name, value in params.outputs.items() for port in _ports(name, value)]
        return Declared(inputs, outputs, "stateful" if stateful else "pure")

    def __init__(self, params: Params, directory: Path = Path()) -> None:
        """Prepare; nothing is read yet. directory : for a relative path."""
        super().__init__(params)
        found = directory / expanded(params.file)
        self._file = found if found.exists() else expanded(params.file)
        self.description = str(self._file)
        self._session: InferenceSession | None = None
        self._feeds = {name: _Feed(value) for name, value in params.inputs.items()}
        self._names = [port.name for port in self.declare(params).inputs]
        self._wanted: list[str] = []

    def open(self) -> None:
        """Read the file, and compare its inputs with the parameters.

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
        # Errors are raised as well.
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
            name = value.output or (next(iter(outputs)) if len(outputs) == 1 else port)
            if name not in outputs:
                raise StageError(
                    f"{self._file}: there is no output {name}; there are {', '.join(outputs)}: name one by "
                    f"outputs.{port}.output"
                )
            self._wanted.append(name)

    @property
    def _first(self) -> _Feed:
        """The input whose pixels the outputs of a picture's size have."""
        return next(iter(self._feeds.values()))

    def close(self) -> None:
        """Free the network."""
        self._session = None

    def reset(self) -> None:
        """Discard earlier frames."""
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
        """The values of the ports made from an output."""
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


class _Feed:
    """Prepares one input of the network."""

    def __init__(self, params: InputParams) -> None:
        self.params = params
        self._past: deque[Floats] = deque(maxlen=(params.frames - 1) * params.stride + 1)
        self._where = ""
        self._sides: tuple[Side, ...] = ()
        self._size = params.size
        self._dtype: type[Any] = np.float32

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
        self._check_shape(p.shape(p.channels, height, width))

    def _check_shape(self, shape: tuple[Side, ...]) -> None:
        if not _agree(self._sides, shape):
            raise StageError(
                f"{self._where} takes {_shown(self._sides)}, but the settings give {_shown(shape)} "
                "(without a batch); see port, size, frames and layout of this input"
            )

    def reset(self) -> None:
        """Discard earlier frames."""
        self._past.clear()

    def __call__(self, value: Any, background: Untouched | None) -> NDArray[Any]:
        """The input tensor for this frame. value : of the port. background : the untouched gel."""
        p, array = self.params, _array(value)
        self._port_size = (array.shape[1], array.shape[0])
        self._input_size = self._size or self._port_size
        self._past.append(self._arranged(self._planes(array, background)))
        newest = len(self._past) - 1
        frames = [self._past[max(0, newest - back * p.stride)] for back in reversed(range(p.frames))]
        tensor = np.concatenate(frames)
        self._check_shape(tensor.shape)
        if len(self._sides) > tensor.ndim:
            tensor = tensor[None]
        if self._dtype is np.uint8:
            tensor = np.clip(np.rint(tensor), 0, 255)
        return tensor.astype(self._dtype, copy=False)

    def _planes(self, array: NDArray[Any], background: Untouched | None) -> list[Floats]:
        """The channels of the input, (h, w) float32 each, normalised."""
        p, picture = self.params, self._resized(array)
        parts = [picture]
        if p.background != "none":
            if background is None or background.shape != array.shape:
                shape = None if background is None else background.shape
                raise StageError(f"{self._where}: required an untouched gel of {array.shape}, got {shape}")
            rest = self._resized(background)
            is_added = p.background == "concat"
            parts = [picture, rest] if is_added else [cv2.subtract(picture, rest, dtype=cv2.CV_32F)]
        planes = [plane for part in parts for plane in cv2.split(part)]
        for name, numbers in (("mean", p.mean), ("std", p.std)):
            if len(numbers) not in (1, len(planes)):
                raise StageError(
                    f"{self._where}: {name} has {len(numbers)} numbers for {len(planes)} channels"
                )
        scale = p.scale
        if p.background == "subtract_half":
            planes = [np.clip(_linear(plane, scale, 0.5), 0, 1) for plane in planes]
            scale = 1.0
        mean, std = np.resize(p.mean, len(planes)), np.resize(p.std, len(planes))
        return [_linear(plane, scale / s, -m / s) for plane, m, s in zip(planes, mean, std, strict=True)]

    def _arranged(self, planes: list[Floats]) -> Floats:
        """The channels, optionally with coordinates, along the axes of `layout`."""
        height, width = planes[0].shape
        if self.params.coordinates:
            across = np.arange(width, dtype=np.float32) / np.float32(width)
            down = np.arange(height, dtype=np.float32) / np.float32(height)
            planes = [*planes, *np.meshgrid(across, down)]
        if self.params.layout == "chw":
            return np.stack(planes)
        values = np.dstack(planes)
        return values.reshape(height * width, -1) if self.params.layout == "pixels" else values

    def _resized(self, array: NDArray[Any]) -> NDArray[Any]:
        """The array at the size of the input, with its order of colours."""
        colour = self.params.colour
        if array.ndim == 3 and array.shape[2] == 3 and colour != "bgr":
            array = cv2.cvtColor(array, cv2.COLOR_BGR2GRAY if colour == "grey" else cv2.COLOR_BGR2RGB)
        if self._input_size != self._port_size:
            array = cv2.resize(array, self._input_size, interpolation=cv2.INTER_LINEAR)
        return array

    def picture(self, array: Floats, channels: int) -> Floats:
        """(H, W, channels) float32: an output of the size of the input, resized to that of the port."""
        width, height = self._input_size
        shape = (channels, height, width) if self.params.layout == "chw" else (height, width, channels)
        if array.size != channels * height * width:
            raise StageError(f"required an output of the size of the input, {shape}, got {array.shape}")
        array = array.reshape(shape)
        if self.params.layout == "chw":
            array = np.moveaxis(array, 0, -1)
        array = np.ascontiguousarray(array)
        if self._input_size != self._port_size:
            array = np.asarray(cv2.resize(array, self._port_size, interpolation=cv2.INTER_LINEAR), np.float32)
        return array.reshape(*self._port_size[::-1], channels)


def _linear(plane: NDArray[Any], factor: float, offset: float) -> Floats:
    """plane * factor + offset as float32."""
    return np.asarray(cv2.addWeighted(plane, factor, plane, 0.0, offset, dtype=cv2.CV_32F), np.float32)


def _ports(name: str, params: OutputParams) -> list[Port]:
    """The ports made from an output."""
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
    """A force of (z) or (x, y, z), N. Its errors and range are unknown."""
    if len(numbers) not in (1, 3):
        raise StageError(f"force: required 1 number (z) or 3 (x, y, z), got {len(numbers)}")
    x, y = numbers[:-1] or (None, None)
    unknown = None if x is None else np.nan
    return Force((x, y, max(numbers[-1], 0.0)), (unknown, unknown, np.nan), False)


def _sides(shape: Sequence[Any]) -> tuple[Side, ...]:
    """A shape of onnxruntime, where axes of any length have names or None."""
    return tuple(side if isinstance(side, int) else None for side in shape)


def _agree(network: tuple[Side, ...], ours: tuple[Side, ...]) -> bool:
    """Whether shapes agree; that of the network may begin with a batch of one."""
    if len(network) == len(ours) + 1 and network[0] in (1, None):
        network = network[1:]
    pairs = zip(network, ours, strict=False)
    return len(network) == len(ours) and all(a == b or a is None or b is None for a, b in pairs)


def _shown(shape: Sequence[Any]) -> str:
    return f"({', '.join('any' if side is None else str(side) for side in shape)})"
