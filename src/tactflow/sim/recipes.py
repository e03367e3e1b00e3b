"""The named scenes: their contacts, and the defects of their sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from tactflow.sim import shapes
from tactflow.sim.motion import Programme


class Recipe(NamedTuple):
    """A scene: description, programme of contacts (None: no contact), and settings that are no defaults."""

    description: str
    programme: Programme | None
    settings: Mapping[str, Any] = {}


_SPHERE = (shapes.sphere,)
_PRESS = Programme(_SPHERE)
_CABLE = Programme((shapes.cable,), wander=(60.0, 60.0), angles=(-75.0, 75.0), dilation=0.25)
_MEDAL = Programme(
    (shapes.medal,), wander=(0.0, 0.0), contacts=1, period=280, rise=20, hold=240, depths=(1.0,),
    path=((300.0, 0.0), (300.0, 200.0), (-300.0, 200.0), (-300.0, 0.0), (300.0, 0.0),
          (300.0, -200.0), (-300.0, -200.0), (-300.0, 0.0), (0.0, 0.0)),
    dilation=0.01,
)  # fmt: skip
"""Programmes shared by several scenes; lengths in raw px, angles in degrees."""
SCENES: dict[str, Recipe] = {
    "press": Recipe("a ball is pressed in several places, at several depths", _PRESS),
    "ball": Recipe(
        "a ball of radius 2.375 mm is pressed all over the gel, for calibration: 0.025 mm per raw pixel",
        Programme(
            (shapes.ball,), wander=(300.0, 210.0), period=20, rise=4, hold=10,
            depths=(1.0, 0.8, 0.9, 0.6),
        ),
        {"shear": 0.0},
    ),
    "cable": Recipe("a straight cable is pressed at several angles", _CABLE),
    "slide": Recipe(
        "a ball drags the gel along until it slips, and slides over it",
        Programme(_SPHERE, wander=(210.0, 130.0), travel=260.0, hold=50, period=90, depths=(1.0, 0.6, 0.85)),
        {"shear": 0.9},
    ),
    "stick_slip": Recipe(
        "a ball is dragged until the gel slips, at the edge of the contact first",
        Programme(
            _SPHERE, wander=(100.0, 60.0), travel=260.0, hold=80, period=120, depths=(1.0, 0.8), partial=True
        ),
        {"shear": 0.5},
    ),
    "roll": Recipe(
        "a ball rolls over the gel without dragging it",
        Programme(
            _SPHERE, wander=(210.0, 130.0), travel=320.0, hold=60, period=100, depths=(1.0, 0.7), rolls=True
        ),
        {"shear": 0.0},
    ),
    "tumble": Recipe(
        "a ball with bumps rolls over the gel without dragging it",
        Programme(
            (shapes.bumpy_ball,), wander=(210.0, 130.0), travel=320.0, hold=60, period=100,
            depths=(1.0, 0.7), rolls=True, dilation=0.01,
        ),
        {"shear": 0.0},
    ),
    "orbit": Recipe(
        "a ball with bumps rolls over the gel, all around",
        Programme(
            (shapes.bumpy_ball,), place=(0.14, 0.5), wander=(0.0, 0.0), contacts=1, period=280, rise=20,
            hold=240, depths=(1.0,), rolls=True, path=((576.0, 0.0),), dilation=0.01,
        ),
        {"shear": 0.0},
    ),
    "thread": Recipe(
        "a threaded rod rolls over the gel, all around",
        Programme(
            (shapes.rod,), place=(0.5, 0.1), wander=(0.0, 0.0), contacts=1, period=280, rise=20,
            hold=240, depths=(1.0,), rolls=True, path=((0.0, 480.0),), dilation=0.01,
        ),
        {"shear": 0.0},
    ),
    "medal": Recipe(
        "a medal larger than the gel slides round over it, and back to where it began", _MEDAL,
        {"shear": 0.0, "markers": (0, 0)},
    ),
    "lifts": Recipe(
        "the same medal, lifted and turned three times on its way",
        replace(_MEDAL, contacts=4, angles=(-90.0, 90.0)),
        {"shear": 0.0, "markers": (0, 0)},
    ),
    "rock": Recipe(
        "a coin is pressed, dragged, turned and tilted to either side",
        Programme(
            (shapes.coin,), wander=(60.0, 40.0), angles=(-90.0, 90.0), hold=50, period=90,
            depths=(1.0, 0.8), dilation=0.1, tilts=(2.0, 1.5),
        ),
        {"twist": 12.0, "shear": 0.4},
    ),
    "scrape": Recipe(
        "a coin drags the gel along until it slips, and slides over it",
        Programme(
            (shapes.coin,), wander=(120.0, 80.0), angles=(-90.0, 90.0), travel=120.0, hold=50, period=90,
            dilation=0.1, depths=(1.0, 0.8),
        ),
        {"shear": 0.4},
    ),
    "idle": Recipe("nothing touches the gel", None),
    "twist": Recipe(
        "a flat punch is pressed and turned by 20 degrees to either side",
        Programme(
            (shapes.box,), wander=(120.0, 80.0), angles=(-40.0, 40.0), hold=50, period=90,
            depths=(1.0, 0.6, 0.8), dilation=0.12,
        ),
        {"twist": 20.0, "shear": 0.0},
    ),
    "spin": Recipe(
        "a flat punch is pressed and turned; the gel follows for 8 degrees, then slips",
        Programme(
            (shapes.box,), wander=(120.0, 80.0), angles=(-40.0, 40.0), hold=50, period=90,
            depths=(1.0, 0.6, 0.8), dilation=0.12, holds=8.0,
        ),
        {"twist": 40.0, "shear": 0.0},
    ),
    "edge": Recipe(
        "a knife edge at several angles",
        Programme((shapes.edge,), wander=(120.0, 90.0), angles=(-90.0, 90.0), dilation=0.2),
    ),
    "box": Recipe(
        "a flat rectangular punch at several angles",
        Programme((shapes.box,), wander=(170.0, 110.0), angles=(-90.0, 90.0), dilation=0.15),
    ),
    "ring": Recipe(
        "a ring: a contact with a hole, and without a direction",
        Programme((shapes.ring,), wander=(150.0, 90.0), dilation=0.15),
    ),
    "screw": Recipe(
        "a threaded rod: a contact in many pieces",
        Programme((shapes.screw,), wander=(120.0, 90.0), angles=(-90.0, 90.0), dilation=0.25),
    ),
    "two": Recipe(
        "a ball and a small flat punch at once",
        Programme(
            (
                partial(shapes.sphere, radius=70.0, depth=22.0),
                partial(shapes.box, half_width=48.0, half_height=36.0, depth=11.0),
            ),
            offsets=((-150.0, -40.0), (150.0, 50.0)), wander=(90.0, 90.0), dilation=0.2),
    ),
    "border": Recipe(
        "a contact cut off by the border of the frame",
        Programme(_SPHERE, place=(0.965, 0.5), wander=(25.0, 180.0)),
    ),
    "tap": Recipe(
        "contacts of a single frame",
        Programme(_SPHERE, period=30, rise=0, hold=1, depths=(1.0, 0.6)),
    ),
    "creep": Recipe(
        "one long contact that drags the gel by 0.02 px per frame",
        Programme(_SPHERE, contacts=1, period=300, rise=15, hold=225, depths=(0.9,), creep=0.02),
    ),
    "drift": Recipe("presses while the lights warm up", _PRESS, {"drift": 0.18}),
    "flicker": Recipe("presses under flickering light", _PRESS, {"flicker": 0.06, "gain": 0.03}),
    "jumps": Recipe(
        "a contact that drags the markers by up to 0.9 pitch between two frames",
        Programme((shapes.box,), wander=(120.0, 80.0), jumps=True, hold=36, period=72, dilation=0.1),
    ),
    "worn": Recipe(
        "faded, missing and vanishing markers, and dirt",
        _PRESS,
        {"worn": 0.3, "missing": 0.08, "dirty": 0.3, "vanish": 0.15, "shear": 0.4},
    ),
    "dense": Recipe("520 small markers", _PRESS, {"markers": (26, 20), "shear": 0.6}),
    "bright_dots": Recipe("bright markers on a darker gel", _PRESS, {"polarity": "bright"}),
    "square_dots": Recipe("square markers", _PRESS, {"shape": "square"}),
    "doubled_dots": Recipe("each marker is a pair of dots", _PRESS, {"shape": "doubled"}),
    "irregular": Recipe("markers without a regular grid", _PRESS, {"jitter": 0.14}),
    "unmarked": Recipe("a gel without markers", _PRESS, {"markers": (0, 0)}),
    "bright": Recipe("a gel whose pressed area brightens in all channels", _PRESS, {"light": "bright"}),
    "bright_cable": Recipe("a cable on a gel that brightens", _CABLE, {"light": "bright"}),
    "mixed": Recipe("a gel that responds with colour and brightness", _PRESS, {"light": "mixed"}),
    "tilted": Recipe("a tilted camera with a wide lens", _PRESS, {"perspective": 0.22, "distortion": 0.12}),
    "noisy": Recipe(
        "a poor camera: noise, shot noise, hot pixels, JPEG, blur",
        _PRESS,
        {"noise": 6.0, "shot": 3.0, "hot": 40, "jpeg": 70, "blur": 1.0},
    ),
    "strong_shear": Recipe(
        "a ball that moves markers by up to 1.5 pitches",
        Programme(_SPHERE, wander=(120.0, 80.0), hold=50, period=90, depths=(1.0, 0.8), dilation=0.2),
        {"shear": 1.3},
    ),
    "lamp": Recipe(
        "a lamp is switched on between two presses",
        Programme(_SPHERE, contacts=2, rise=5, depths=(1.0, 0.7)),
        {"lamp": 0.25},
    ),
    "round_gel": Recipe(
        "a round gel in a black frame, darker towards its border, under lights that warm up",
        _PRESS,
        {"aperture": 0.95, "vignette": 0.7, "drift": 0.18},
    ),
    "block": Recipe(
        "a grooved block that covers a quarter of the gel",
        Programme((shapes.block,), wander=(60.0, 50.0), angles=(-40.0, 40.0), dilation=0.1),
    ),
    "coin": Recipe(
        "a coin: a large disc with a raised rim and figures",
        Programme((shapes.coin,), wander=(120.0, 80.0), angles=(-90.0, 90.0), dilation=0.1),
    ),
    "long_edge": Recipe(
        "the edge of a box, one flank steep and one flat, at several angles",
        Programme(
            (partial(shapes.edge, half_length=250.0, lean=0.5),), wander=(80.0, 80.0), angles=(-90.0, 90.0),
            dilation=0.15,
        ),
    ),
    "finger": Recipe(
        "a fingertip at the border of the frame, in a gel without a crease at the edge of a contact",
        Programme(
            (shapes.finger,), place=(0.93, 0.5), wander=(40.0, 150.0), angles=(-40.0, 40.0)
        ),
        {"sink": 0.5, "rim": 1.0},
    ),
    "dark_channel": Recipe(
        "a gel that is nearly dark in red until it is touched", _PRESS, {"light": "dark_channel"}
    ),
    "halo": Recipe(
        "a gel without markers that a contact darkens, with a bright halo around it",
        _PRESS,
        {"light": "darkening", "markers": (0, 0)},
    ),
    "painted": Recipe(
        "markers of many sizes without a regular grid, seen by a tilted camera",
        _PRESS,
        {"markers": (13, 10), "sizes": 0.7, "jitter": 0.06, "perspective": 0.12},
    ),
    "stray": Recipe("presses that cause a reflection on the far side of the gel", _PRESS, {"stray": 0.8}),
}  # fmt: skip
