"""The query part of a scene's name: keys, their ranges, and what is wrong with a wrong one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from tactflow.sim.gel import RIM, SINK_IN
from tactflow.sim.light import LIGHTS
from tactflow.sim.markers import SHAPES
from tactflow.system.spelling import did_you_mean


@dataclass(frozen=True)
class Settings:
    """Everything a query can set; 0 for pitch and dot means that they are fitted to the frame."""

    frames: int = 300
    seed: int = 7
    noise: float = 2.0
    shot: float = 0.0
    markers: tuple[int, int] = (10, 8)
    dot: float = 0.0
    pitch: float = 0.0
    sizes: float = 0.0
    shape: str = "round"
    polarity: str = "dark"
    jitter: float = 0.0
    worn: float = 0.0
    missing: float = 0.0
    dirty: float = 0.0
    vanish: float = 0.0
    speckle: float = 0.0
    light: str = "photometric"
    drift: float = 0.0
    flicker: float = 0.0
    settle: int = 0
    stale: int = 0
    lamp: float = 0.0
    vignette: float = 0.2
    specular: float = 0.0
    stray: float = 0.0
    leds: int = 0
    texture: float = 1.0
    blur: float = 0.0
    jpeg: int = 0
    gain: float = 0.0
    hot: int = 0
    dropped: float = 0.0
    repeated: float = 0.0
    perspective: float = 0.0
    distortion: float = 0.0
    aperture: float = 0.0
    depth: float = 1.0
    shear: float = 0.12
    twist: float = 0.0
    bend: float = 0.0
    sink: float = SINK_IN
    rim: float = RIM


@dataclass(frozen=True)
class Key:
    """One key: its range (or its choices), unit and meaning."""

    meaning: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    choices: tuple[str, ...] = ()


KEYS: dict[str, Key] = {
    "frames": Key("length of the recording", "frames", 1, 10_000_000),
    "seed": Key("of everything random", "", 0, 2**31 - 1),
    "noise": Key("standard deviation of the sensor's noise", "grey levels", 0, 60),
    "shot": Key(
        "additional noise that grows with the light: its deviation at level 128", "grey levels", 0, 30
    ),
    "markers": Key("columns x rows, as in 10x8, or none", "", 0, 60),
    "dot": Key("radius of a marker; 0 fits it to the pitch", "px", 0, 60),
    "pitch": Key("distance between markers; 0 fits the grid to the frame", "px", 0, 400),
    "sizes": Key("spread of the markers' radii to either side of the mean, relative", "", 0, 0.8),
    "shape": Key("shape of a marker", choices=SHAPES),
    "polarity": Key("whether markers are darker or brighter than the gel", choices=("dark", "bright")),
    "jitter": Key("irregularity of the grid, standard deviation of each coordinate", "pitches", 0, 0.3),
    "worn": Key("fraction of markers that have faded", "", 0, 1),
    "missing": Key("fraction of markers that were never printed", "", 0, 0.9),
    "dirty": Key("specks of dirt per marker", "", 0, 2),
    "vanish": Key("fraction of markers that cannot be seen while the gel is touched", "", 0, 0.9),
    "speckle": Key("contrast of random blotches all over the gel, which move with it", "", 0, 1),
    "light": Key("the kind of sensor", choices=tuple(LIGHTS)),
    "drift": Key(
        "rise of the brightness while the lights warm up (time constant 5 s), relative", "", -0.5, 0.5
    ),
    "flicker": Key("amplitude of the flicker of mains light (100 Hz seen at 60 Hz), relative", "", 0, 0.5),
    "settle": Key("time until the camera has set exposure and white balance", "frames", 0, 10_000),
    "stale": Key("frames at the start that a camera had kept from an earlier contact", "frames", 0, 10_000),
    "lamp": Key("light of a lamp that is switched on before the second half, relative", "", -0.5, 0.5),
    "vignette": Key("loss of light in the corners, relative", "", 0, 1),
    "specular": Key("strength of mirror-like highlights", "", 0, 1),
    "stray": Key("strength of a reflection that a contact throws on the far side of the gel", "", 0, 1),
    "leds": Key("number of glaring LEDs at the upper and lower border of the frame", "", 0, 40),
    "texture": Key("grain of the gel's coating", "% of the light", 0, 10),
    "blur": Key("standard deviation of a Gaussian blur on top of the lens's own", "px", 0, 20),
    "jpeg": Key("quality of a JPEG round trip; 0 is none", "", 0, 100),
    "gain": Key("amplitude of bands of gain that roll over the frame, relative", "", 0, 0.5),
    "hot": Key("number of hot pixels", "pixels", 0, 10_000),
    "dropped": Key("fraction of moments the camera misses", "", 0, 0.9),
    "repeated": Key("fraction of frames that are delivered twice", "", 0, 0.9),
    "perspective": Key(
        "tilt of the camera: by how much of half the width the lower corners move in", "", 0, 0.4
    ),
    "distortion": Key("radial distortion, positive for a wide lens", "", -0.2, 0.4),
    "aperture": Key(
        "radius of the round picture in a black frame, in half heights of the frame; 0 is none", "", 0, 2
    ),
    "depth": Key("scales the depth of every contact", "", 0, 1.5),
    "shear": Key("largest drag of the gel by a contact", "pitches", 0, 1.5),
    "twist": Key("largest turn of the gel by a contact", "degrees", -60, 60),
    "bend": Key("turn of a cable's direction from end to end", "degrees", -150, 150),
    "sink": Key(
        "share of the depth by which the gel has sunk at a contact's edge: 0.5 is a deep gel", "", 0.1, 0.6
    ),
    "rim": Key("slope just outside a contact relative to just inside: 1 is no crease", "", 0.4, 1),
}


def parse_query(query: str, defaults: Mapping[str, Any]) -> Settings:
    """Settings from `key=value&key=value`.

    defaults : the scene's own values, which the query overrides.

    Raises
    ------
    ValueError : an unknown or repeated key, or a value out of its range, with what was expected.
    """
    values = dict(defaults)
    seen: set[str] = set()
    for part in query.split("&") if query else []:
        key, equals, value = part.partition("=")
        if key not in KEYS:
            raise ValueError(f"simulated sensor: unknown key {key!r}{did_you_mean(key, sorted(KEYS))}")
        if key in seen:
            raise ValueError(f"simulated sensor: {key} is given twice")
        if not equals or not value:
            raise ValueError(f"simulated sensor: required {key}=VALUE, got {part!r}")
        seen.add(key)
        values[key] = _value(key, value)
    return Settings(**values)


def _value(key: str, value: str) -> Any:
    rule = KEYS[key]
    if rule.choices:
        if value not in rule.choices:
            hint = did_you_mean(value, rule.choices)
            raise ValueError(
                f"simulated sensor: required {key} from {list(rule.choices)}, got {value!r}{hint}"
            )
        return value
    if key == "markers":
        return _grid(value)
    kind = {field.name: field.type for field in fields(Settings)}[key]
    unit = f" {rule.unit}" if rule.unit else ""
    wanted = f"required {key} as {'an integer' if kind == 'int' else 'a number'} in "
    wanted += f"[{rule.low:g}, {rule.high:g}]{unit} ({rule.meaning})"
    try:
        number: float = int(value) if kind == "int" else float(value)
    except ValueError:
        raise ValueError(f"simulated sensor: {wanted}, got {value!r}") from None
    if not math.isfinite(number) or not rule.low <= number <= rule.high:
        raise ValueError(f"simulated sensor: {wanted}, got {value!r}")
    return number


def _grid(value: str) -> tuple[int, int]:
    if value == "none":
        return (0, 0)
    columns, times, rows = value.partition("x")
    if times and columns.isdecimal() and rows.isdecimal():
        grid = int(columns), int(rows)
        if all(1 <= side <= KEYS["markers"].high for side in grid):
            return grid
    raise ValueError(
        "simulated sensor: required markers as columns x rows, like 10x8 (1 to 60 each), or none, "
        f"got {value!r}"
    )
