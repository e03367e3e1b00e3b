"""
Where the gel is touched
========================

A ball is pressed into the gel. `tactflow.stream` yields a result for each frame, and `tactflow.draw` draws
it: the outline of the contact, its direction, and the displacement of the dots, magnified three times.
"""

import matplotlib.pyplot as plt

import tactflow

results = list(tactflow.stream(source="sim:press?frames=60", images=True))
touched = [result for result in results if result.contact is not None]
largest = max(touched, key=lambda result: result.contact.area)

figure, axes = plt.subplots(1, 2, figsize=(8, 5))
axes[0].imshow(results[0].image[..., ::-1])
axes[0].set_title("untouched")
axes[1].imshow(tactflow.draw(largest)[..., ::-1])
axes[1].set_title(f"{largest.t:.2f} s: {largest.contact.area:.0f} px²")
for ax in axes:
    ax.set_axis_off()
figure.tight_layout()

# %%
# The same numbers as a table, with the extra `pandas`: `tactflow.to_frame(results)`.

print(len(touched), "of", len(results), "frames are touched")
print("centre of the largest contact:", [round(x, 1) for x in largest.contact.center], "px")
