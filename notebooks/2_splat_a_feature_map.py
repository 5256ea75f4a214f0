# %% [markdown]
# # 2. Splat a feature map
#
# What splatting does, one step at a time: four Gaussians are projected, listed by tile, and composited front to back.
# Then 20,000 of them carry a teacher's 512 channels and are drawn from a view they have not seen. At the end: how much
# faster the engines are than the plain equations, and that pyvista shows the same picture as the rasteriser.
#
# About 10 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra
# `notebook`, no data.

# %%
# Your own data: a scene, and a folder with a feature map of each training view, as `kfgs features` writes it.
import os
from pathlib import Path

from kfgs import FeatureFolder, load_scene
from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))
scene = load_scene(folder)  # yours: load_scene("my/scene").undistorted()
train = scene.views("train")
maps = FeatureFolder(folder / "features").of(scene, "train")

# %% [markdown]
# ## Four Gaussians and a camera
#
# A Gaussian has a mean, a rotation (w, x, y, z), three standard deviations and an opacity; here it also carries three
# channels, which are shown as a colour. The surfaces are drawn at one standard deviation.

# %%
import pyvista as pv
import torch

from kfgs import Camera, Gaussians
from kfgs.viz import add_cameras, add_cloud, make_plotter

pv.set_jupyter_backend("static")  # "server" lets you turn the scene: pip install "pyvista[jupyter]"

four = Gaussians(
    means=torch.tensor([[-0.55, 0.1, 2.4], [0.1, -0.1, 3.0], [0.65, 0.25, 3.6], [0.2, 0.5, 2.2]]),
    quats=torch.tensor([[1.0, 0.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.4], [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.1]]),
    scales=torch.tensor([[0.30, 0.12, 0.1], [0.35, 0.15, 0.2], [0.2, 0.3, 0.1], [0.18, 0.08, 0.1]]),
    opacities=torch.tensor([0.8, 0.9, 0.95, 0.6]),
    features=torch.tensor([[0.90, 0.62, 0.0], [0.0, 0.45, 0.70], [0.0, 0.62, 0.45], [0.84, 0.37, 0.0]]),
)
pinhole = Camera(torch.eye(4), torch.tensor([[200.0, 0, 120], [0, 200.0, 80], [0, 0, 1]]), width=240, height=160)

plotter = make_plotter(320, 560)
add_cloud(plotter, four, color_by=four.features, style="ellipsoids")
add_cameras(plotter, [pinhole], size=0.8, line_width=2)
plotter.camera_position = [(3.4, -1.6, -0.5), (0.05, 0.1, 1.75), (0, -1, 0)]
plotter.show()

# %% [markdown]
# ## Project, then list by tile
#
# `project` gives each Gaussian's centre and shape on the image (EWA splatting); a Gaussian ends where its alpha falls
# to 1/255, the outer line; the inner one is one standard deviation. `bin_tiles` lists for each square of 16 pixels
# which Gaussians touch it, front to back; the numbers count them. Empty tiles cost nothing.

# %%
import matplotlib.pyplot as plt
from matplotlib_inline.backend_inline import set_matplotlib_formats

from kfgs.splat import ALPHA_MIN, bin_tiles, project

set_matplotlib_formats("jpeg")  # a third of its size as PNG
projected = project(four, pinhole)
tiles = bin_tiles(projected, pinhole.width, pinhole.height)

figure, axes = plt.subplots(figsize=(7.5, 5), layout="constrained")
y, x = torch.meshgrid(torch.arange(160) + 0.5, torch.arange(240) + 0.5, indexing="ij")
drawn = zip(projected.means2d, projected.conics, projected.opacities, projected.index, strict=True)
for (u, v), (a, b, c), opacity, i in drawn:
    alpha = opacity * torch.exp(-0.5 * (a * (x - u) ** 2 + 2 * b * (x - u) * (y - v) + c * (y - v) ** 2))
    axes.contour(x, y, alpha, levels=[ALPHA_MIN, float(opacity) * 0.61], colors=[four.features[i].tolist()])
for tile, count in enumerate(tiles.offsets.diff().tolist()):
    row, column = divmod(tile, tiles.grid[1])
    axes.text(16 * column + 8, 16 * row + 8, str(count or ""), ha="center", va="center", fontsize=8)
axes.set(xticks=range(0, 241, 16), yticks=range(0, 161, 16), xlim=(0, 240), ylim=(160, 0), aspect="equal")
axes.tick_params(labelsize=7)
axes.grid(alpha=0.5)
plt.show()

# %% [markdown]
# ## Composite front to back
#
# Each Gaussian adds its channels, weighted by its alpha and by what those before it let through (Eq. 3). The nearest
# comes first; the last picture is the opacity of all four. `rasterize` is the three steps in one call.

# %%
from PIL import Image

from kfgs import rasterize
from kfgs.splat import composite
from kfgs.viz import picture_grid

nearest_first = four.means[:, 2].argsort()
steps = [rasterize(four.select(nearest_first[:count]), pinhole).map for count in range(1, 5)]
maps4, alpha4 = composite(*projected[:2], projected.opacities, four.features[projected.index], tiles)
print(f"project, bin, composite against rasterize: largest difference {float((maps4 - steps[-1]).abs().max()):.0e}")
opacity = alpha4[..., None].expand(-1, -1, 3)
Image.fromarray(picture_grid([[*steps, opacity]], ["the nearest", "two", "three", "all four", "opacity"]))

# %% [markdown]
# ## A teacher's map
#
# A teacher gives each pixel a feature of many channels. `FeatureColors` shows them as colours: one linear projection
# for the whole scene, so that equal features have equal colours in every view. Edges are blurred, surfaces are noisy,
# and some patches are simply wrong (the picture on the wall).

# %%
from kfgs.quant import sample_grid
from kfgs.viz import FeatureColors

colors = FeatureColors.fit(torch.cat([sample_grid(maps[i], samples=500) for i in range(len(maps))]))
print(
    f"{len(maps)} maps of {maps.shape}, {len(maps) * 2 * torch.tensor(maps.shape).prod() / 1e6:.0f} MB in half precision"
)
chosen = [0, len(train) // 3, 2 * len(train) // 3]
rows = [[scene.image(train[i]) for i in chosen], [colors(maps[i]) for i in chosen]]
Image.fromarray(picture_grid(rows, width=min(scene.cameras[0].width, 320)))

# %% [markdown]
# ## Features on Gaussians
#
# Round Gaussians stand on the points of the cloud. Their features need no training to be looked at: each takes the mean
# of the pixels that it shows in, weighted by how much it shows (`accumulate_pixels`); hence blurred edges.
# [Notebook 4](4_a_semantic_field_from_start_to_end.py) does so with sharp Gaussians and corrects for blending. One training
# view is kept apart.

# %%
from kfgs import GaussianParams
from kfgs.splat import accumulate_pixels

h, w, D = maps.shape
apart = len(maps) // 4
cloud = GaussianParams.from_points(scene.points, colors=scene.colors, sh_degree=0, initial_opacity=0.8).activated()
cloud = cloud.replace(scales=0.8 * cloud.scales)  # a little narrower: less blur, a few holes
sums, weights = torch.zeros(len(cloud), D), torch.zeros(len(cloud))
for i in range(len(maps)):
    if i == apart:
        continue
    view = scene.cameras[train[i]].resized(h, w)
    seen = project(cloud, view)
    shown = accumulate_pixels(seen.means2d, seen.conics, seen.opacities, maps[i], bin_tiles(seen, w, h))
    sums[seen.index] += shown[0]
    weights[seen.index] += shown[1]
semantic = cloud.replace(features=sums / weights.clamp_min(1e-6)[:, None], sh=None)
print(semantic, f"{float((weights > 0).float().mean()):.0%} of them seen")

# %%
from kfgs import resize_map
from kfgs.metrics import feature_cosine

held = scene.cameras[train[apart]]
rendering = rasterize(semantic, held)
cosine = feature_cosine(resize_map(rendering.map, (h, w)), maps[apart])
print(f"{tuple(rendering.map.shape)} rendered; cosine with the teacher on the view kept apart {float(cosine):.3f}")
pictures = [
    scene.image(train[apart]),
    colors(maps[apart]),
    colors(rendering.map),
    rendering.alpha[..., None].expand(-1, -1, 3),
]
titles = ["photograph", "the teacher", "rendered features", "opacity"]
Image.fromarray(picture_grid([pictures], titles, width=min(held.width, 320)))

# %% [markdown]
# ## Engines
#
# The same equations are written once plainly in torch (`reference`) and once compiled. `engine="auto"` takes the
# fastest for the tensors' device, Triton where there is a GPU. Times are of 9 channels, the paper's latents, as a
# ratio.

# %%
import time

from kfgs import available_engines

latents = semantic.replace(features=semantic.features[:, :9].contiguous())
seconds, drawn = {}, {}
for engine in available_engines("cpu"):
    rasterize(latents, held, engine=engine)  # compiles
    times = []
    for _ in range(3):
        start = time.perf_counter()
        drawn[engine] = rasterize(latents, held, engine=engine).map
        times.append(time.perf_counter() - start)
    seconds[engine] = min(times)
for engine, value in seconds.items():
    difference = float((drawn[engine] - drawn["reference"]).abs().max() / drawn["reference"].abs().max())
    print(
        f"{engine:10s} {seconds['reference'] / value:6.0f} times the reference's speed, relative difference {difference:.0e}"
    )

# %% [markdown]
# ## pyvista shows the same
#
# `add_cloud(style="gaussians")` draws the Gaussians themselves, so what is inspected is what is rendered. From the same
# camera the two pictures differ by the rounding of 8 bits per blended Gaussian.

# %%
from kfgs.metrics import psnr
from kfgs.viz import look_through, show_cloud

plotter = make_plotter(held.height, held.width, off_screen=True)
add_cloud(plotter, cloud, color_by="rgb", style="gaussians")
look_through(plotter, held)
viewer = torch.from_numpy(plotter.screenshot(return_img=True).copy()) / 255
plotter.close()
ours = torch.from_numpy(show_cloud(cloud)(held)) / 255
print(f"viewer against rasteriser: {psnr(viewer, ours):.1f} dB")
difference = (10 * (viewer - ours).abs()).clamp(0, 1)
Image.fromarray(picture_grid([[viewer, ours, difference]], ["pyvista", "rasterize", "10 x difference"]))

# %% [markdown]
# Next: [3_the_codebook_grows](3_the_codebook_grows.py) makes 512 channels small enough to train.
