"""Settings of a simulated scene, parsed from its query: `press?noise=4&light=bright`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from tactflow.sim.gel import RIM_SLOPE_RATIO, SINK_IN_RATIO
from tactflow.system.spelling import closest, did_you_mean


def _grid(text: Any) -> Any:
    """Parse `10x8` to (columns, rows); `none` is (0, 0)."""
    if not isinstance(text, str):
        return text
    columns, times, rows = text.partition("x")
    return (0, 0) if text == "none" else (columns, rows) if times else text


def _number(default: float, low: float, high: float, meaning: str) -> Any:
    return Field(default, ge=low, le=high, description=f"{meaning} ({low:g} to {high:.10g})")


Side = Annotated[int, Field(ge=0, le=60)]


class Settings(BaseModel):
    """All settings of a query."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    frames: int = _number(300, 1, 10_000_000, "length of the recording, frames")
    seed: int = _number(7, 0, 2**31 - 1, "seed of all random numbers")
    noise: float = _number(2, 0, 60, "standard deviation of the sensor noise, grey levels")
    shot: float = _number(
        0, 0, 30, "standard deviation of shot noise, which grows with the light, at level 128, grey levels"
    )
    markers: Annotated[tuple[Side, Side], BeforeValidator(_grid)] = Field(
        (10, 8), description="COLUMNSxROWS of markers, as in 10x8 (at most 60 each), or none"
    )
    dot: float = _number(0, 0, 60, "radius of a marker, px; 0 fits it to the pitch")
    pitch: float = _number(0, 0, 400, "distance between markers, px; 0 fits the grid to the frame")
    sizes: float = _number(0, 0, 0.8, "largest deviation of a marker's radius from the mean, relative")
    shape: Literal["round", "square", "doubled"] = Field(
        "round", description="shape of a marker (round|square|doubled)"
    )
    polarity: Literal["dark", "bright"] = Field("dark", description="markers against the gel (dark|bright)")
    jitter: float = _number(0, 0, 0.3, "standard deviation of each marker's coordinates, pitches")
    worn: float = _number(0, 0, 1, "fraction of markers that have faded")
    missing: float = _number(0, 0, 0.9, "fraction of markers that were never printed")
    dirty: float = _number(0, 0, 2, "specks of dirt per marker")
    vanish: float = _number(0, 0, 0.9, "fraction of markers that are invisible during a contact")
    light: Literal["photometric", "bright", "mixed", "dark_channel", "darkening", "absorbing"] = Field(
        "photometric",
        description="type of sensor (photometric|bright|mixed|dark_channel|darkening|absorbing)",
    )
    drift: float = _number(
        0, -0.5, 0.5, "rise of the brightness while the lights warm up (time constant 5 s), relative"
    )
    flicker: float = _number(
        0, 0, 0.5, "amplitude of the flicker of mains light (100 Hz seen at 60 Hz), relative"
    )
    lamp: float = _number(0, -0.5, 0.5, "light of a lamp that comes on before the second half, relative")
    vignette: float = _number(0.2, 0, 1, "loss of light in the corners, relative")
    stray: float = _number(0, 0, 1, "strength of the reflection of a contact on the far side of the gel")
    texture: float = _number(1, 0, 10, "grain of the gel's coating, % of the light")
    blur: float = _number(0, 0, 20, "standard deviation of a Gaussian blur in addition to the lens's own, px")
    jpeg: int = _number(0, 0, 100, "quality of a JPEG round trip; 0 for none")
    gain: float = _number(0, 0, 0.5, "amplitude of bands of gain that roll over the frame, relative")
    hot: int = _number(0, 0, 10_000, "number of hot pixels")
    first: Literal["gel", "black", "green", "leftover", "half", "exposure"] = Field(
        "gel",
        description="what the camera's first pictures show: empty buffers, a picture of another session, "
        "half a picture, settling exposure (gel|black|green|leftover|half|exposure)",
    )
    late: int = _number(3, 1, 1000, "number of these first pictures")
    damaged: int = _number(
        0, 0, 1_000_000, "every so many frames, one is damaged: half gray, half noise, or displaced; 0: none"
    )
    perspective: float = _number(
        0, 0, 0.4, "tilt of the camera: how far the lower corners move in, of half the width"
    )
    distortion: float = _number(0, -0.2, 0.4, "radial distortion, positive for a wide lens")
    aperture: float = _number(
        0, 0, 2, "radius of the round picture in a black frame, in half heights of the frame; 0 for none"
    )
    lost: float = _number(0, 0, 0.9, "fraction of frames that the camera loses")
    frozen: int = _number(0, 0, 10_000_000, "frames in the middle that all show the picture before them")
    lag: int = _number(0, 0, 1000, "frames by which pictures are late, as behind a long queue")
    depth: float = _number(1, 0, 1.5, "factor on the depth of all contacts")
    shear: float = _number(0.12, 0, 1.5, "largest drag of the gel by a contact, pitches")
    twist: float = _number(0, -60, 60, "largest turn of the gel by a contact, degrees")
    sink: float = _number(
        SINK_IN_RATIO, 0.1, 0.6, "depth of the gel at a contact's edge, relative to full depth; 0.5: deep gel"
    )
    rim: float = _number(
        RIM_SLOPE_RATIO, 0.4, 1, "slope just outside a contact relative to just inside; 1: no crease"
    )


def setting_descriptions() -> dict[str, str]:
    """Setting -> one-line description with its range."""
    return {name: str(field.description) for name, field in Settings.model_fields.items()}


def parse_query(query: str, defaults: Mapping[str, Any]) -> Settings:
    """Parse settings from `key=value&key=value`.

    defaults : of the scene, overridden by the query.

    Raises
    ------
    ValueError : an unknown or repeated key, or an invalid value; the message states the valid ones.
    """
    values: dict[str, str] = {}
    for part in query.split("&") if query else []:
        key, _, value = part.partition("=")
        if key not in Settings.model_fields:
            hint = did_you_mean(key, sorted(Settings.model_fields))
            raise ValueError(f"simulated sensor: unknown key {key!r}{hint}")
        if key in values:
            raise ValueError(f"simulated sensor: duplicate key {key!r}")
        if not value:
            raise ValueError(f"simulated sensor: required {key}=VALUE, got {part!r}")
        values[key] = value
    try:
        return Settings.model_validate({**defaults, **values})
    except ValidationError as error:
        key = str(error.errors()[0]["loc"][0])
    choices = [str(choice) for choice in get_args(Settings.model_fields[key].annotation)]
    guess = closest(values[key], choices)
    hint = f"; did you mean {guess}?" if guess else ""
    wanted = f"required {key}: {setting_descriptions()[key]}"
    raise ValueError(f"simulated sensor: {wanted}, got {values[key]!r}{hint}")
