# %% [markdown]
# # 1. Cameras
#
# **Are my cameras right?** Everything in kfgs starts from photographs, the cameras that took them, and some points in
# space. Wrong cameras spoil all that follows, so look at them first. You will see the photographs, the cameras in
# space, the points drawn into a photograph, and a lens removed.
#
# About 10 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra `notebook`, no data.

# %%
# Your own data: folder = "my/scene", with images/ and a COLMAP model in sparse/0, or with a transforms.json.
from example import make_room

folder = make_room()

# %% [markdown]
# ## What a scene holds
#
# A scene holds cameras, image files, points with colours, and the names of its splits. A picture is read only when it
# is needed, so a large scene opens quickly. Lengths are in the units of the file. Here they are metres.

# %%
from PIL import Image

from kfgs import load_scene, viz

scene = load_scene(folder).undistorted()  # the last part shows what this does
camera = scene.cameras[0]
print(scene)
print(f"{camera.name}: {camera.width} x {camera.height} pixels, at {[round(x, 2) for x in camera.center.tolist()]}")
train = scene.views("train")
shown = [scene.image(train[k * len(train) // 9]) for k in range(8)]
Image.fromarray(viz.picture_grid([shown[:4], shown[4:]], width=256))

# %% [markdown]
# ## Cameras in space
#
# Each camera is a pyramid that opens as wide as its lens. The base carries its photograph, and a small roof marks the
# upper edge. Check three things: do the cameras stand where you stood, do they look where you looked, and is the top up?
#
# Structure from motion leaves some points far outside of the scene. `robust_bounds` finds the bulk of them. The highest
# fifth is left out too, to look into the room.

# %% tags=["thumbnail"]
from kfgs.cameras import Orbit, estimate_up, orbit_cameras, robust_bounds

up = estimate_up(scene.cameras).to(scene.points)
inside = robust_bounds(scene.points).inside
inside &= scene.points @ up < (scene.points[inside] @ up).quantile(0.8)
points, colors = scene.points[inside].numpy(), scene.colors[inside].numpy()
size = 0.3 * scene.extent


def draw_cameras(plotter):
    plotter.add_points(points, scalars=colors, rgb=True, point_size=3, lighting=False)
    viz.add_cameras(plotter, scene.cameras, images=scene.image, size=size, most=8)


orbit = Orbit(frames=8, size=(480, 720), elevation_degrees=40, zoom=1.5)
Image.fromarray(viz.draw_view(orbit_cameras(scene.points[inside], orbit, up=up)[1], draw_cameras))

# %% [markdown]
# ## Points in a picture
#
# This is the sharpest test. A camera with rotation $R$, translation $t$ and intrinsics $K$ takes a point $X$ of the world
# to the pixel $(u, v)$ and the depth $z$:
#
# $$z \, (u, v, 1)^\top = K \, (R X + t)$$
#
# Points have to lie on the things that they belong to. The colour of a dot is its depth. Of the points in a square of 4 x 4
# pixels, only the nearest is drawn: most of the others are hidden behind it. The centre of the first pixel is (0.5, 0.5), as
# in COLMAP.

# %%
import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats

from kfgs.cameras import project_points

set_matplotlib_formats("jpeg")
pixels, depths, seen = project_points(camera, scene.points)
seen &= robust_bounds(scene.points).inside
pixels, depths = pixels[seen], depths[seen]
order = depths.argsort()
squares = (pixels[order] // 4).int().numpy()
nearest = order[np.unique(squares, axis=0, return_index=True)[1]]
figure, axes = plt.subplots(figsize=(7.5, 5.2), layout="constrained")
axes.imshow(scene.image(0).mean(-1), cmap="gray", vmin=-0.5, extent=(0, camera.width, camera.height, 0))
dots = axes.scatter(*pixels[nearest].T, c=depths[nearest], s=5, cmap="plasma_r")
figure.colorbar(dots, label="depth (units of the scene)", shrink=0.8)
axes.set(
    title=f"{len(nearest):,} of {len(pixels):,} points in {camera.name}",
    xlim=(0, camera.width),
    ylim=(camera.height, 0),
)
plt.show()

# %% [markdown]
# ## Which views are held out
#
# Scores count only on pictures that training has not seen. Here the test views are orange. If the folder has a
# `split.json`, it decides. Otherwise every eighth view is for testing.

# %%
split_colors = {"train": "#0072b2", "test": "#d55e00"}


def draw_split(plotter):
    plotter.add_points(points, scalars=colors, rgb=True, point_size=2, opacity=0.4, lighting=False)
    for split, color in split_colors.items():
        cameras = scene.select(split).cameras
        viz.add_cameras(plotter, cameras, size=0.15 * scene.extent, color=color, line_width=3, most=30)
    plotter.add_legend(list(map(list, split_colors.items())), face="rectangle", bcolor="white", size=(0.15, 0.12))


above = Orbit(frames=1, size=(480, 640), elevation_degrees=75, zoom=1.25)
Image.fromarray(viz.draw_view(orbit_cameras(scene.points[inside], above, up=up)[0], draw_split))

# %% [markdown]
# ## A lens removed
#
# Gaussians are drawn by a pinhole camera, in which straight lines stay straight. A real lens bends them.
# `scene.undistorted()` straightens every picture when it is read. If your cameras have no lens, as in the toy room, you
# see what would happen to a straight picture if it had come from a wide-angle lens: what is near the edges is pulled
# outwards, and the corners that nobody recorded are cut off.

# %%
from dataclasses import replace

from kfgs.cameras import Distortion, undistort

taken = load_scene(folder)
bent, lens = taken.image(0), taken.cameras[0]
if lens.distortion is None:
    lens = replace(lens, distortion=Distortion("brown_conrady", (-0.25, 0.06, 0.0, 0.0)))
straight, pinhole, known = undistort(bent, lens)
print(f"{lens.distortion}: {known.float().mean():.0%} of the new picture were recorded")
Image.fromarray(viz.picture_grid([[bent, straight]], ["as taken", "lens removed"], width=360))

# %% [markdown]
# Next: [2_splatting](2_splatting.ipynb) puts features on Gaussians and draws them.
