# %% [markdown]
# # 7. Your own images
#
# **I have a folder of photographs. What can I ask them?** From pictures alone to answers: cameras by structure from motion, a
# teacher, a semantic field, and *where is something green?* You will see what each step makes, and how to check it before
# the next one.
#
# About a minute on two CPU cores with the pictures of the toy room (20 seconds more to make it the first time). Needs the
# extra `notebook`, no weights and no network. Nothing but the pictures is used, neither cameras nor labels.

# %%
# Your own data: a folder of photos that overlap, and a folder for what is made of them. Colours that you see there, one
# for each class, and the one to look for. 30 to 150 photos of one camera at one zoom are enough for a room; walk around,
# do not just turn on the spot.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
photos = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6)) / "images"  # yours: Path("my/photos")
out = data / "own"
phrases = ["dark sage", "slate grey", "blue grey", "dark brown", "light brown", "pale brown", "camel", "clay"]
phrases += ["light grey", "greyish", "charcoal", "off white"]
question = "dark sage"  # the green of leaves

# %% [markdown]
# ## Pictures

# %%
from dataclasses import replace

import torch
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.scenes import list_images, read_image

names = list_images(photos)
shown = [read_image(photos / names[k * len(names) // 9]) for k in range(8)]
Image.fromarray(viz.picture_grid([shown[:4], shown[4:]], width=256))

# %% [markdown]
# ## Cameras
#
# Structure from motion finds points that several pictures share, and from them where each picture was taken. It is COLMAP's,
# in this process and on the CPU. Read how many pictures are *registered*: the others found no place and are not used. If
# you have cameras already, load them and skip this cell. The lens that COLMAP found is removed from the pictures.

# %%
if not (out / "sparse" / "0").is_dir():
    print(kfgs.run_sfm(photos, out))
scene = kfgs.load_scene(out, images=photos).undistorted()
train, test = scene.views("train"), scene.views("test")
print(scene)

# %% [markdown]
# Look before you go on: are the pictures where you stood? A world made of photographs has no scale and no *up* of its own.
# `estimate_up` reads the latter from how the camera was held.

# %%
from kfgs.cameras import Orbit, estimate_up, orbit_cameras, robust_bounds

inside = robust_bounds(scene.points).inside
points, colors = scene.points[inside], scene.colors[inside]


def draw_cameras(plotter):
    plotter.add_points(points.numpy(), scalars=colors.numpy(), rgb=True, point_size=4, lighting=False)
    viz.add_cameras(plotter, scene.cameras, images=scene.image, size=0.25 * scene.extent, most=10)


orbit = Orbit(frames=8, size=(420, 640), elevation_degrees=40, zoom=1.1)
everything = torch.cat([points, torch.stack([one.center for one in scene.cameras]).to(points)])
around = orbit_cameras(everything, orbit, up=estimate_up(scene.cameras))
ahead = scene.cameras[0].viewmat[2, :3]  # where the first camera looks
outside = max(around, key=lambda one: float(one.viewmat[2, :3] @ ahead.to(one.viewmat)))
Image.fromarray(viz.draw_view(outside, draw_cameras))

# %% [markdown]
# ## A teacher
#
# Any function from a picture [3, H, W] to a map [D, h, w] can be a teacher, together with one from texts to rows [n, D]. This
# one knows **colours and nothing else**, so it needs no weights. The feature of a pixel says how near it is, in the colour
# space CIELAB, to each of 216 reference colours. A text is one of the 949 colour names of XKCD's survey. With weights, one
# line takes its place, and nothing below changes but the words:
#
# ```python
# teacher = load_teacher("lseg", "demo_e200.ckpt", fast=True)        # the paper's teacher
# teacher = load_teacher("clip", "openai/clip-vit-large-patch14")    # extra `hf`; a folder or a hub id
# ```

# %%
from kornia.color import rgb_to_lab
from matplotlib import colormaps
from matplotlib.colors import XKCD_COLORS, to_rgb
from torch.nn.functional import adaptive_avg_pool2d, normalize

from kfgs.teachers import CallableTeacher

SPREAD = torch.tensor([25.0, 12.0, 12.0])  # of L, a, b: how different two colours may be that are called alike
STEPS = torch.linspace(0, 1, 6)
REFERENCE = rgb_to_lab(torch.cartesian_prod(STEPS, STEPS, STEPS).T[None, :, :, None])[0, :, :, 0].T / SPREAD


def nearness(image):  # [3, H, W] -> [216, H, W]
    lab = rgb_to_lab(image[None])[0].movedim(0, -1) / SPREAD
    return (-torch.cdist(lab, REFERENCE).square() / 2).exp().movedim(-1, 0)


def see(image):  # [3, H, W] -> [216, 96, about 128]
    return nearness(adaptive_avg_pool2d(image, (96, round(96 * image.shape[2] / image.shape[1]))))


def hear(names):  # n names of colours -> [n, 216]
    rgb = torch.tensor([to_rgb(XKCD_COLORS[f"xkcd:{name}"]) for name in names])
    return normalize(nearness(rgb.T[:, :, None])[:, :, 0], dim=0).T


teacher = CallableTeacher(see, hear, name="colour words")
photo = scene.image(test[0])
seen = kfgs.resize_map(teacher.encode_image(photo.movedim(-1, 0)).movedim(0, -1), photo.shape[:2])  # [H, W, 216]
likeness = normalize(seen, dim=-1) @ teacher.encode_text([question])[0]
row = [photo, viz.FeatureColors.fit(seen.flatten(0, 1)[::7])(seen), colormaps["cividis"](likeness.numpy())[..., :3]]
Image.fromarray(viz.picture_grid([row], ["photo", "features", question], width=320))

# %% [markdown]
# ## The field
#
# The teacher sees every training picture, and `fit` makes the field (notebook 4). Its Gaussians are trained on pictures
# made 320 pixels wide, which is quick. A killed run goes on where it stopped: run this notebook twice, and the second time
# takes seconds.

# %%
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(600).with_maximum(60_000))
method = kfgs.Uplift(color=replace(quick, picture_scale=min(1.0, 320 / scene.cameras[0].width)))
kfgs.extract_features(teacher, scene, out / "features", split="train")
field = kfgs.fit(scene, kfgs.FeatureFolder(out / "features").of(scene, "train"), method, folder=out / "run")
print(field.summary())

# %% [markdown]
# ## Ask, and segment
#
# A question is compared with the other classes, and `connected_parts` lists the things that were found. Below, pictures that
# took no part in the fit: the classes of their pixels, in colours of the palette, and how well each pixel answers the
# question. This teacher knows only colours: a
# wooden floor is brown like a chair.

# %% tags=["thumbnail"]
classes = kfgs.make_label_set(teacher, phrases, templates=None, negatives=None)
found = field.query(question, classes)
for thing in kfgs.connected_parts(field.gaussians, found, [scene.cameras[i] for i in train]):
    print(thing)
cloud, rows = field.gaussians, []
for i in test[:2]:
    camera = scene.cameras[i].resized(round(480 * scene.cameras[i].height / scene.cameras[i].width), 480)
    photo = kfgs.resize_map(scene.image(i), camera.size)
    labels = viz.overlay_labels(photo, field.segment(camera, classes), phrases, alpha=0.8, legend=False)
    scores = viz.draw_view(
        camera, lambda plotter: viz.add_cloud(plotter, cloud, color_by=found.scores, style="gaussians", clim=(0, 1))
    )
    rows.append([photo, labels, scores])
titles = ["unseen picture", "segmented", question]
Image.fromarray(viz.picture_grid(rows, titles, width=320, names=phrases))

# %% [markdown]
# ## Further
#
# - `kfgs.explore(field, classes=classes, embed=lambda phrase: teacher.encode_text([phrase])[0])` opens the viewer; with
#   `embed`, you can type any text that the teacher understands.
# - The field is saved in `run/field.kfgs`. `kfgs view`, `kfgs select` and `kfgs render` take it from a shell.
# - `kfgs sfm`, `kfgs features` and `kfgs fit` are these cells as commands.
#
# Next: [8_compare_methods](8_compare_methods.ipynb) asks which method to take.
