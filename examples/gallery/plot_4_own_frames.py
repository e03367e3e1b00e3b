"""
Your own frames
===============

Anything that yields pictures is a source: an array, a list, a generator around your camera's own driver. The
first picture shows the untouched gel.
"""

import matplotlib.pyplot as plt

import tactflow

scene = tactflow.open_scene("cable?frames=40")


def pictures():
    """Pictures, (H, W, 3) uint8 BGR, as your driver would give them."""
    for index in range(40):
        yield scene.frame(index)


centers = [
    result.contact.center for result in tactflow.stream(source=pictures()) if result.contact is not None
]
x, y = zip(*centers, strict=True)

figure, ax = plt.subplots(figsize=(5, 5))
ax.plot(x, y, ".-")
ax.set_xlim(0, 300)
ax.set_ylim(400, 0)
ax.set_aspect("equal")
ax.set_xlabel("x, px")
ax.set_ylabel("y, px")
ax.set_title(f"centre of the contact in {len(centers)} frames")
figure.tight_layout()
