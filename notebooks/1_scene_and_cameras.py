# %% [markdown]
# # 1. A scene and its cameras
#
# What goes in: photographs, the cameras that took them, and a sparse cloud of points. You will see the cameras standing
# in the room with their pictures, points projected into a picture and a picture seen again in space, which views are
# held out for testing, and a lens removed.
#
# About 10 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra
# `notebook`, no data.

# %%
# Your own data: a folder with images/ and a COLMAP model in sparse/0, or a transforms.json (which often has no points).
import os
from pathlib import Path

from kfgs import load_scene
from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")

# %% [markdown]
# ## What a scene holds
#
# Cameras, image files, points with their colours, and named splits. Pictures are read when asked for, one at a time, so
# a scene of thousands costs nothing to open. Units are those of the file; the room's are metres. Points are optional
# for looking (training starts from them): where there are none, each camera's line of sight is drawn in their place.

# %%
import torch

recorded = load_scene(folder)
scene = recorded.undistorted()  # the last part shows what this does
camera = scene.cameras[0]
print(scene)
print(
    f"view 0: {camera.name}, {camera.width} x {camera.height} pixels, fx {camera.K[0, 0]:.1f}, fy {camera.K[1, 1]:.1f}"
)
print(f"it stands at {[round(x, 2) for x in camera.center.tolist()]}; extent of the cameras {scene.extent:.2f}")
print("notes:", *scene.notes or ["none"], sep="\n  ")

points, colors, what = scene.points, scene.colors, f"{len(scene.points):,} sparse points"
if not len(points):
    ahead = scene.extent * torch.linspace(0.2, 2, 40)[:, None]
    points = torch.cat([c.center + ahead * c.viewmat[2, :3] for c in scene.cameras]).float()
    colors = torch.full_like(points, 128, dtype=torch.uint8)
    what = "no sparse points: lines of sight"

# %%
from PIL import Image

from kfgs.viz import picture_grid

train = scene.views("train")
shown = [train[i] for i in torch.linspace(0, len(train) - 1, min(8, len(train))).long().tolist()]
rows = [[scene.image(i) for i in shown[first : first + 4]] for first in range(0, len(shown), 4)]
Image.fromarray(picture_grid([row for row in rows if len(row) == len(rows[0])], width=min(camera.width, 256)))

# %% [markdown]
# ## Cameras in space
#
# Each camera is a pyramid with its true opening, its picture on the image plane, and a small roof on the picture's
# upper edge; eight of them are drawn. Structure from motion leaves points far outside of a scene; `robust_bounds` says
# where the bulk of the cloud is. The lid of the room is taken off here, to look in.

# %%
import pyvista as pv

from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.scenes import robust_bounds
from kfgs.viz import add_camera_images, add_cameras, look_through, make_plotter

pv.set_jupyter_backend("static")  # "server" lets you turn the scene: pip install "pyvista[jupyter]"

bounds = robust_bounds(points)
up = estimate_up(scene.cameras).to(points)
height = points @ up
inside = bounds.inside & (height < height[bounds.inside].quantile(0.8))
everything = torch.cat([points[inside], torch.stack([c.center for c in scene.cameras]).to(points)])
corners = torch.stack([everything.amin(0), everything.amax(0)])
orbit = orbit_cameras(corners, Orbit(frames=8, size=(540, 720), elevation_degrees=40, zoom=1.0), up=up)

plotter = make_plotter(540, 720)
plotter.add_points(points[inside].numpy(), scalars=colors[inside].numpy(), rgb=True, point_size=3, lighting=False)
plotter.add_text(f"{int(inside.sum()):,} of {what}", font_size=8, color="black")
add_cameras(plotter, scene.cameras, size=0.3 * scene.extent, most=8)
add_camera_images(plotter, scene.cameras, scene.image, size=0.3 * scene.extent, most=8)
look_through(plotter, orbit[1])
plotter.show()

# %% [markdown]
# ## Points into a picture
#
# `project_points` takes world points to pixels (x, y) and says which fall into the picture; what stands in front of
# them is not asked. The first pixel's centre is (0.5, 0.5), as in COLMAP. `to_kornia` makes one kornia `PinholeCamera`
# of any number of cameras; it counts pixels as K does and so says the same: the largest difference is printed.
# (kornia's own grids count pixel centres from 0: for those, `to_kornia(cameras, integer_centers=True)`.)

# %%
from kfgs.cameras import project_points, to_kornia

pixels, depths, seen = project_points(camera, points)
kornia_camera = to_kornia([camera])
theirs = kornia_camera.project(points[seen].to(kornia_camera.intrinsics)[None])[0]
print(
    f"{int(seen.sum()):,} of {len(seen):,} points project into the picture; kornia's camera differs by at most "
    f"{float((theirs - pixels[seen]).abs().max()):.1e} pixels"
)

# %%
import matplotlib.pyplot as plt
from matplotlib_inline.backend_inline import set_matplotlib_formats

set_matplotlib_formats("jpeg")  # a photograph is a fifth of its size as PNG

figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
axes.imshow(scene.image(0).mean(-1), cmap="gray", vmin=-0.5, extent=(0, camera.width, camera.height, 0))
drawn = seen & bounds.inside
dots = axes.scatter(*pixels[drawn].T, c=depths[drawn], s=2, cmap="plasma_r")
figure.colorbar(dots, label="depth (world units)", shrink=0.8)
axes.set(title=f"{camera.name}, {what}", xlim=(0, camera.width), ylim=(camera.height, 0))
plt.show()

# %% [markdown]
# The other way round: the cloud in pyvista, looked at through the same camera, beside the photograph. Where they agree,
# poses, axes and principal point are read as they were meant. Points have no surface, so what is behind shines through.

# %%
small = camera.resized(round(camera.height * min(1, 384 / camera.width)), min(camera.width, 384))
plotter = make_plotter(small.height, small.width, off_screen=True)
plotter.add_points(points.numpy(), scalars=colors.numpy(), rgb=True, point_size=4, lighting=False)
look_through(plotter, small)
through = plotter.screenshot(return_img=True)
plotter.close()
Image.fromarray(picture_grid([[scene.image(0), through]], ["photograph", what], width=small.width))

# %% [markdown]
# ## Which views are held out
#
# Training never sees the test views (orange); at most 30 of each are drawn. A `split.json` in the folder is used where
# there is one; any other rule is one call, here every eighth view as in Mip-NeRF 360.

# %%
from kfgs.scenes import make_split

plotter = make_plotter(480, 720)
plotter.add_points(
    points[inside].numpy(),
    scalars=colors[inside].numpy(),
    rgb=True,
    point_size=2,
    opacity=0.4,
    lighting=False,
)
for split, color in {"train": "#0072b2", "test": "#d55e00"}.items():
    add_cameras(plotter, scene.select(split).cameras, size=0.15 * scene.extent, color=color, line_width=3, most=30)
plotter.add_legend([["train", "#0072b2"], ["test", "#d55e00"]], face="rectangle", bcolor="white", size=(0.15, 0.12))
above = orbit_cameras(corners, Orbit(frames=1, size=(480, 720), elevation_degrees=75, zoom=1.1), up=up)
look_through(plotter, above[0])
plotter.show()
print({name: len(views) for name, views in make_split(len(scene), "holdout8").items()})

# %% [markdown]
# ## A lens removed
#
# Gaussians are drawn by a pinhole, so a lens has to go first: `scene.undistorted()` removes it from every picture on
# the way in, and `scene.mask(i)` says which pixels were recorded. The room's pictures come from a pinhole; to have
# something to remove, kornia gives view 0 a barrel lens, and `undistort` takes it away again (two interpolations cost
# the decibels that are missing). The black rim is where kornia had no picture to bend. If your cameras have a lens, it
# is that of view 0 that is removed.

# %%
from dataclasses import replace

from kornia.geometry import create_meshgrid, remap, undistort_points

from kfgs.cameras import Distortion, undistort
from kfgs.metrics import psnr

photo, bent, lens = scene.image(0), recorded.image(0), recorded.cameras[0]
if not recorded.distorted:
    lens = replace(camera, distortion=Distortion("brown_conrady", (-0.25, 0.06, 0.0, 0.0)))
    k = torch.tensor([lens.distortion.coefficients])
    K = camera.intrinsics_at_integer_centers[None].float()  # kornia's grid counts pixel centres from 0
    grid = create_meshgrid(camera.height, camera.width, normalized_coordinates=False)
    x, y = undistort_points(grid.reshape(1, -1, 2), K, k).reshape(grid.shape).unbind(-1)
    bent = remap(photo.permute(2, 0, 1)[None], x, y, align_corners=True)[0].permute(1, 2, 0)

straight, pinhole, known = undistort(bent, lens)
columns = {"through the lens": bent, "undistorted": straight}
print(lens.distortion)
print(f"undistorted: {known.float().mean():.0%} of the pixels recorded")
if not recorded.distorted:
    print(f"{psnr(straight[known][None], photo[known][None]):.1f} dB from the pinhole's picture")
    columns = {"pinhole": photo, **columns}
Image.fromarray(picture_grid([list(columns.values())], list(columns), width=small.width))

# %% [markdown]
# Next: [2_splat_a_feature_map](2_splat_a_feature_map.py) puts features on Gaussians and draws them.
