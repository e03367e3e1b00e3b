"""The simulated sensor: a gel with markers, pressed by known shapes, seen by a known camera.

>>> from tactflow.sim import open_scene
>>> scene = open_scene("press?frames=300&seed=7")
>>> image, truth = scene.frame(100), scene.truth(100)
"""

from tactflow.sim.scenes import Scene, open_scene, scene_descriptions
from tactflow.sim.truth import Truth

__all__ = ["Scene", "Truth", "open_scene", "scene_descriptions"]
