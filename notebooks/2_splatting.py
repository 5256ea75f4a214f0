# %% [markdown]
# # 2. Splatting
#
# **How does a cloud of Gaussians become a picture, and how can that picture show features instead of colours?** You will
# see four Gaussians projected, listed by tile, and blended from front to back. Then 20,000 of them carry the 512 numbers
# of a teacher, and are drawn from a view that they have not seen. At the end the engines are timed.
#
# About 10 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra
# `notebook`, no data.

# %%
# Your own data: a scene, and a folder with a feature map of each training view, as `kfgs features` writes it.
from example import make_room

from kfgs import FeatureFolder, load_scene

folder = make_room()  # yours: folder = Path("my/scene")
scene = load_scene(folder).undistorted()
train = scene.views("train")
maps = FeatureFolder(folder / "features").of(scene, "train")

# %% [markdown]
# ## Four Gaussians and a camera
#
# A Gaussian has a position $p$, a scale $s$ (its standard deviation along each of its three axes), a rotation $q$ (a
# quaternion w, x, y, z) and an opacity $o$. It carries any number of channels $f'$. Drawing is a function $R$ of these and of
# the camera (Eq. 3):
#
# $$\mathbf{F}_r = R(p^2, s^2, q^2, o^2, f'; p_{cam})$$
#
# The upper index 2 says that these Gaussians are not those of the colours (index 1): the two fields are *decoupled*.
# Here $f'$ has three channels, which we show as a colour. The surfaces are drawn at one standard deviation.

# %%
import torch
from PIL import Image

from kfgs import Camera, Gaussians, viz

four = Gaussians(
    means=torch.tensor([[-0.55, 0.1, 2.4], [0.1, -0.1, 3.0], [0.65, 0.25, 3.6], [0.2, 0.5, 2.2]]),
    quats=torch.tensor([[1.0, 0.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.4], [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.1]]),
    scales=torch.tensor([[0.30, 0.12, 0.1], [0.35, 0.15, 0.2], [0.2, 0.3, 0.1], [0.18, 0.08, 0.1]]),
    opacities=torch.tensor([0.8, 0.9, 0.95, 0.6]),
    features=torch.tensor([[0.90, 0.62, 0.0], [0.0, 0.45, 0.70], [0.0, 0.62, 0.45], [0.84, 0.37, 0.0]]),
)
pinhole = Camera(torch.eye(4), torch.tensor([[200.0, 0, 120], [0, 200.0, 80], [0, 0, 1]]), width=240, height=160)

plotter = viz.make_plotter(320, 560, off_screen=True)
viz.add_cloud(plotter, four, color_by=four.features, style="ellipsoids")
viz.add_cameras(plotter, [pinhole], size=0.8, line_width=2)
plotter.camera_position = [(3.4, -1.6, -0.5), (0.05, 0.1, 1.75), (0, -1, 0)]
Image.fromarray(plotter.screenshot(return_img=True))

# %% [markdown]
# ## Project, then list by tile
#
# `project` finds where each Gaussian lies in the picture: a centre $\mu$ and an ellipse with the matrix $\Sigma$ (EWA
# splatting). At a pixel $x$ it covers a share
#
# $$\alpha(x) = o \, \exp\left(-\tfrac{1}{2} (x - \mu)^\top \Sigma^{-1} (x - \mu)\right)$$
#
# The inner line is one standard deviation. The outer line is where $\alpha$ falls to 1/255; a Gaussian ends there.
# `bin_tiles` lists the Gaussians that touch each square of 16 pixels, the nearest first. The numbers count them: where
# there is none, nothing has to be computed.

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
axes.grid(alpha=0.5)
plt.show()

# %% [markdown]
# ## Composite front to back
#
# Each Gaussian adds its channels, weighted by its own $\alpha$ and by what the Gaussians in front of it let through:
#
# $$\mathbf{F}_r(x) = \sum_i f'_i \, \alpha_i(x) \prod_{j < i} (1 - \alpha_j(x))$$
#
# The nearest one comes first. `rasterize` does the three steps in one call.

# %%
from kfgs import rasterize
from kfgs.splat import composite

nearest_first = four.means[:, 2].argsort()
steps = [rasterize(four.select(nearest_first[:count]), pinhole).map for count in range(1, 5)]
maps4, _ = composite(*projected[:2], projected.opacities, four.features[projected.index], tiles)
print(f"the three steps differ from rasterize by at most {float((maps4 - steps[-1]).abs().max()):.0e}")
Image.fromarray(viz.picture_grid([steps], ["the nearest", "two", "three", "all four"], width=176))

# %% [markdown]
# ## A teacher's map
#
# A *teacher* is a network that gives each pixel of a photograph a feature: many numbers that say what is there. We show
# them as colours, with one projection for the whole scene: equal features have equal colours in every view. The edges
# are blurred, surfaces are noisy, and some patches are wrong. It is a simulated teacher, with the faults of real ones.

# %% tags=["thumbnail"]
from kfgs.quant import sample_grid

colors = viz.FeatureColors.fit(torch.cat([sample_grid(maps[i], samples=500) for i in range(len(maps))]))
print(f"{len(maps)} maps of {maps.shape}")
chosen = [0, len(train) // 3, 2 * len(train) // 3]
rows = [[scene.image(train[i]) for i in chosen], [colors(maps[i]) for i in chosen]]
Image.fromarray(viz.picture_grid(rows, width=240))

# %% [markdown]
# ## Features on Gaussians
#
# We put a round Gaussian on each point of the scene. Then each takes the mean of the teacher's features at the pixels that
# show it, weighted by how much it shows there. No training is needed. The Gaussians are round and large, so the edges are
# blurred; [notebook 4](4_a_field.ipynb) does it with sharp ones. One training view is kept
# apart, to see how well the others predict it.

# %%
from kfgs.fields import gaussians_from_points
from kfgs.splat import accumulate_pixels

h, w, D = maps.shape
apart = len(maps) // 4
cloud = gaussians_from_points(scene.points, colors=scene.colors, sh_degree=0, initial_opacity=0.8)
cloud = cloud.replace(scales=0.8 * cloud.scales)  # a little narrower: less blur, a few holes
sums, weights = torch.zeros(len(cloud), D), torch.zeros(len(cloud))
for i in set(range(len(maps))) - {apart}:
    view = scene.cameras[train[i]].resized(h, w)
    seen = project(cloud, view)
    shown = accumulate_pixels(seen.means2d, seen.conics, seen.opacities, maps[i], bin_tiles(seen, w, h))
    sums[seen.index] += shown[0]
    weights[seen.index] += shown[1]
semantic = cloud.replace(features=sums / weights.clamp_min(1e-6)[:, None], sh=None)
print(semantic, f"{float((weights > 0).float().mean()):.0%} of them seen")

# %%
from torch.nn.functional import cosine_similarity

from kfgs import resize_map

held = scene.cameras[train[apart]]
rendering = rasterize(semantic, held)
cosine = cosine_similarity(resize_map(rendering.map, (h, w)), maps[apart], dim=-1).mean()
print(f"{tuple(rendering.map.shape)} rendered; cosine with the teacher on the view kept apart {float(cosine):.3f}")
pictures = [scene.image(train[apart]), colors(maps[apart]), colors(rendering.map)]
Image.fromarray(viz.picture_grid([pictures], ["photograph", "the teacher", "rendered features"], width=240))

# %% [markdown]
# ## Engines
#
# The equations above are written plainly in torch (`reference`), and again as compiled code that gives the same numbers
# faster. `engine="auto"` takes the fastest one for the device of the tensors; on a GPU that is Triton. The times are for 9
# channels, as many as the paper trains.

# %%
import time

from kfgs.splat import available_engines

latents = semantic.replace(features=semantic.features[:, :9].contiguous())
seconds = {}
for engine in available_engines("cpu"):
    rasterize(latents, held, engine=engine)  # compiles
    start = time.perf_counter()
    rasterize(latents, held, engine=engine)
    seconds[engine] = time.perf_counter() - start
print({engine: f"{seconds['reference'] / value:.0f} times as fast" for engine, value in seconds.items()})

# %% [markdown]
# Next: [3_the_codebook](3_the_codebook.ipynb) makes 512 channels small enough to train.
