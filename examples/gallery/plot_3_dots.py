"""
Follow the dots, and compare with the truth
===========================================

`tactflow.MarkerTracker` works on plain arrays, without a pipeline. The simulated sensor knows where its dots
are, so the error of each is known, too.
"""

import matplotlib.pyplot as plt
import numpy as np

import tactflow

scene = tactflow.open_scene("press?frames=41")
tracker = tactflow.MarkerTracker(scene.frame(0))
for index in range(1, 41):
    markers = tracker.track(scene.frame(index))

x, y = markers.position.T
u, v = markers.displacement.T
figure, ax = plt.subplots(figsize=(7, 5))
ax.imshow(scene.frame(40)[..., ::-1])
ax.quiver(x, y, u, v, color="yellow", angles="xy", scale_units="xy", scale=1 / 4, width=0.003)
ax.set_axis_off()
ax.set_title("displacement, magnified four times")
figure.tight_layout()

# %%
# The tracker orders the dots by itself; each is compared with the true dot that was nearest in the reference.

truth = scene.truth(40)
nearest = np.linalg.norm(markers.origin[:, None] - truth.origin, axis=2).argmin(axis=1)
error = np.linalg.norm(markers.displacement - (truth.position - truth.origin)[nearest], axis=1)
print(f"{len(error)} dots, moved by up to {np.hypot(u, v).max():.2f} px")
print(f"error: {np.sqrt((error**2).mean()):.3f} px RMS, {error.max():.3f} px at most")
