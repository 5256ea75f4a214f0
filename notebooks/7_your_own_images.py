# %% [markdown]
# # 7. Your own images
#
# From bare pictures to answers: cameras by structure from motion, a teacher that you write yourself, a semantic field,
# then *where is the dark forest green plant?* You will see what each step makes of the one before it.
#
# About a minute on two CPU cores (20 seconds more to make the toy room the first time), 10 seconds afterwards. Needs the
# extra `notebook`, no weights, no network. The pictures of the toy room stand for yours; nothing but the pictures is used,
# neither its cameras nor its labels.

# %%
# Your own data: a folder of photos that overlap (JPEG, PNG, ...), and a folder for what is made of them; a phrase for each
# class of things there, the one to look for, and one that is no class; places where things are seen. 30 to 150 photos of
# one camera at one zoom are enough for a room; walk around, do not just turn on the spot.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room
from kfgs.fields import Clicks

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
photos = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6)) / "images"
out = data / "own"
phrases = [
    "dark forest green plant", "dark grey blue sofa", "reddish brown chair", "greyish brown table", "dark brown cabinet",
    "pinkish grey wall", "cloudy blue wall", "greenish grey wall", "medium grey ceiling", "dusty red rug", "cocoa floor",
]  # fmt: skip
question, no_class = "dark forest green plant", "mustard cushion"
clicks = {  # things that you point at: (x, y) pixels of pictures
    "red things": Clicks("view_020.png", [(54, 93), (74, 91), (244, 138), (144, 98)]),  # chair and rug
    "floor": Clicks("view_020.png", [(14, 148)]),
    "table": Clicks("view_020.png", [(164, 48)]),
    "plant": Clicks("view_020.png", [(151, 23)]),
    "blue wall": Clicks("view_020.png", [(44, 23)]),
    "wall": Clicks("view_010.png", [(128, 80)]),
    "sofa": Clicks("view_010.png", [(178, 178)]),
    "ceiling": Clicks("view_010.png", [(128, 25)]),
}

# %%
from dataclasses import replace

import numpy as np
import torch
from kornia.color import rgb_to_lab
from matplotlib import colormaps
from matplotlib.colors import XKCD_COLORS, to_rgb
from PIL import Image
from torch.nn.functional import avg_pool2d, normalize

from kfgs import (
    ColorConfig,
    FeatureFolder,
    FitConfig,
    connected_parts,
    extract_features,
    fit_scene,
    label_set_from_examples,
    load_scene,
    make_label_set,
    plan_scene,
    resize_map,
    run_sfm,
    viz,
)
from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.scenes import list_images, read_image
from kfgs.teachers import CallableTeacher

# %% [markdown]
# ## Pictures

# %%
names = list_images(photos)
shown = [read_image(photos / name) for name in names[2 :: max(1, len(names) // 6)][:6]]
Image.fromarray(viz.picture_grid([shown[:3], shown[3:]], width=256))

# %% [markdown]
# ## Cameras
#
# COLMAP's structure from motion, in-process, on the CPU. The line to read is the number of *registered* pictures; those
# that found no place are named, and a scene that falls into pieces is refused with advice. The lens that COLMAP fitted
# is removed from pictures and maps alike.

# %%
if not (out / "sparse" / "0").is_dir():
    print(run_sfm(photos, out))
scene = load_scene(out, images=photos).undistorted()
train, test = scene.views("train"), scene.views("test")
cameras = [scene.cameras[i] for i in train]
print(scene)

# %% [markdown]
# Look before you fit: are the pictures where you stood? A world from photographs has no scale and no *up* of its own;
# `estimate_up` reads the latter from how the camera was held.

# %%
up = estimate_up(scene.cameras)
around = Orbit(frames=8, size=(420, 640), elevation_degrees=40, zoom=1.25)
outside = orbit_cameras(scene.points, around, up=up)[1]
size = 0.25 * scene.extent
plotter = viz.make_plotter(*outside.size, off_screen=True)
plotter.add_points(scene.points.numpy(), scalars=scene.colors.numpy(), rgb=True, point_size=5)
viz.add_cameras(plotter, scene.cameras, size=size, most=10)
viz.add_camera_images(plotter, scene.cameras, scene.image, size=size, most=10)
viz.look_through(plotter, outside)
Image.fromarray(plotter.screenshot(return_img=True))

# %% [markdown]
# ## A teacher of your own
#
# Any function from a picture [3, H, W] to a map [D, h, w] can be distilled. This one knows **colours and nothing else**:
# a feature says which of 216 reference colours are near a pixel in CIELAB, averaged over a small window. Words
# get the same features, through the 949 colour names of XKCD's survey; of a phrase it hears only the colours
# (in *forest green plant*, "plant" is for you). A toy in its knowledge, but a real teacher in every other respect.

# %%
NAMED = {name.removeprefix("xkcd:"): to_rgb(name) for name in XKCD_COLORS}
SPREAD = torch.tensor([25.0, 12.0, 12.0])  # of L, a, b: how unlike two colours may be and still be felt as near
STEPS = torch.linspace(0, 1, 6)
REFERENCE = rgb_to_lab(torch.cartesian_prod(STEPS, STEPS, STEPS).T[None, :, :, None])[0, :, :, 0].T / SPREAD


def nearness(image):  # [3, H, W] -> [216, H, W]
    lab = rgb_to_lab(image[None])[0].movedim(0, -1) / SPREAD
    return (-torch.cdist(lab, REFERENCE).square() / 2).exp().movedim(-1, 0)


def see(image):  # [3, H, W] -> [216, H / 2, W / 2]
    return avg_pool2d(nearness(avg_pool2d(image, 2)), 5, stride=1, padding=2, count_include_pad=False)


def hear(prompts):  # n phrases -> [n, 216]
    rows = []
    for prompt in prompts:
        words, colors = prompt.lower().split(), []
        while words:  # the longest colour name that starts here, else the next word
            found = [n for n in (3, 2, 1) if " ".join(words[:n]) in NAMED]
            colors += [NAMED[" ".join(words[: found[0]])]] if found else []
            words = words[found[0] if found else 1 :]
        if not colors:
            raise ValueError(f"{prompt!r}: expected a colour, such as 'slate blue', in what this teacher is asked")
        rows.append(normalize(nearness(torch.tensor(colors).T[:, :, None])[:, :, 0], dim=0).mean(dim=1))
    return torch.stack(rows)


teacher = CallableTeacher(see, hear, name="colour words")

# %% [markdown]
# With weights at hand, one line takes its place, and nothing below changes:
#
# ```python
# teacher = load_teacher("lseg", "demo_e200.ckpt", fast=True)              # the paper's teacher
# teacher = load_teacher("clip", "openai/clip-vit-large-patch14")          # extra `hf`; a folder or a hub id
# ```
#
# Always look at one map first: in false colours, and as the cosine with the question (yellow is near).

# %%
photo = scene.image(test[0])
seen = resize_map(teacher.encode_image(photo.movedim(-1, 0)).movedim(0, -1), photo.shape[:2])  # [H, W, 216]
likeness = normalize(seen, dim=-1) @ teacher.encode_text([question])[0]
pictures = [photo, viz.FeatureColors.fit(seen.flatten(0, 1))(seen), colormaps["cividis"](likeness.numpy())[..., :3]]
Image.fromarray(viz.picture_grid([pictures], ["photo", "features", question], width=256))

# %% [markdown]
# ## What it will cost
#
# Before anything long starts: minutes, memory and disk of each stage. The planner lets the teacher see one picture and tries a
# few views and steps on this machine. Ask with `teacher="lseg"` to see what the paper's would take. The field is fused onto
# Gaussians that are trained on the photographs first (`color`, a short schedule here); if you have a splat in this frame,
# `fit_scene` takes it instead (`splat=`).

# %%
quick = ColorConfig.quick()
config = FitConfig.cpu(color=replace(quick, field=replace(quick.field.with_steps(800), max_gaussians=60_000)))
print(plan_scene(scene, teacher=teacher, config=config, features=out / "features", run=out))

# %% [markdown]
# ## Features, then the field
#
# Maps are written one picture at a time, and a killed run goes on where it stopped; so does the fit: Gaussians from the
# photographs, then the maps averaged onto them, merged and compressed (notebook 4). Each stage is found again when nothing
# it depends on has changed: run this notebook twice, and the second time takes seconds.

# %%
manifest = extract_features(teacher, scene, out / "features", split="train")
maps = FeatureFolder(out / "features").of(scene, "train")
fitted = fit_scene(scene, maps, out / "run", config, report=print)
semantic = fitted.field
print(semantic.summary())

# %% [markdown]
# ## Segment pictures that it never saw
#
# What is there was named in the first cell, one phrase per class. Views of the test split took no part in the fit. The
# colours are the palette's, not those named. Walls and plants are right; the rug's dark squares, being brown, go to chair
# and floor: this teacher hears only colours.

# %%
classes = make_label_set(teacher, phrases, negatives=None)
rows = []
for i in test[:2]:
    photo, labels = scene.image(i), semantic.segment(scene.cameras[i], classes)
    rows.append([photo, viz.overlay_labels(photo, labels, phrases, alpha=0.8, legend=False)])
sheet = viz.picture_grid(rows, ["unseen picture", "segmented"], width=320)
legend = viz.legend_strip(torch.arange(len(phrases)), phrases, sheet.shape[1])
Image.fromarray(np.concatenate([sheet, legend]))

# %% [markdown]
# ## Ask
#
# A query is told from the other classes (the score is its relevancy) and cut at a gamma, which the result states.
# `connected_parts` lists what was found: how many, where, how large, seen best from where. Sizes are in the units of the
# reconstruction.

# %%
found = semantic.query(question, classes)
things = connected_parts(semantic.gaussians, found, cameras)
print(found)
for thing in things:
    print(" ", thing)

# %% [markdown]
# ## Look
#
# The scores of all Gaussians (yellow is 1) and a box around each answer, from the camera that sees the last of them best.

# %%
best = things[-1].best_view.index if things else 0
camera, boxes = cameras[best], [thing.box for thing in things]
scale = 480 / camera.width
plotter = viz.make_plotter(round(scale * camera.height), 480, off_screen=True)
viz.add_cloud(plotter, semantic.gaussians, color_by=found.scores, style="gaussians", clim=(0, 1))
if boxes:
    viz.add_boxes(plotter, boxes)
    viz.add_names(plotter, boxes, [f"answer {n}" for n in range(1, len(boxes) + 1)], up=tuple(up.tolist()))
viz.look_through(plotter, camera)
view = plotter.screenshot(return_img=True)
Image.fromarray(viz.picture_grid([[scene.image(train[best]), view]], ["picture", question], width=480))

# %% [markdown]
# ## Without words
#
# Some teachers have no text (DINOv2, SAM), and some things have no name. Then show what you mean: a few clicks in
# pictures make classes for `segment`, `classify` and `query` alike. Several clicks for one class are averaged: here a chair
# and squares of the rug, which a teacher of colours hardly tells apart.

# %%
pointed = label_set_from_examples(semantic, clicks)
labels, photo = semantic.segment(scene.cameras[test[-1]], pointed), scene.image(test[-1])
marked = {scene.cameras[i].name: scene.image(i).clone() for i in train}
for shown in clicks.values():
    for x, y in shown.points:
        marked[shown.view][max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = torch.tensor([1.0, 1.0, 0.0])
row = [*(marked[view] for view in sorted({shown.view for shown in clicks.values()})), photo]
row.append(viz.overlay_labels(photo, labels, pointed.names, alpha=0.8, legend=False))
sheet = viz.picture_grid([row], [*["clicks"] * (len(row) - 2), "unseen picture", "segmented"], width=240)
Image.fromarray(np.concatenate([sheet, viz.legend_strip(torch.arange(len(pointed)), pointed.names, sheet.shape[1])]))

# %% [markdown]
# ## Explore
#
# The explorer takes the teacher's ear along, so that any phrase can be asked, not only the classes. Here it is driven from
# a cell; without `where=` it opens with its controls in the notebook, and `where="browser"` or `"window"` elsewhere.

# %%
with viz.explore(
    semantic, classes=classes, cameras=cameras, embed=lambda phrase: teacher.encode_text([phrase])[0], where="picture"
) as explorer:
    explorer.look_from(camera)
    explorer.ask(no_class)
    explorer.set_show("score")
    print("\n".join(explorer.lines()))
    picture = explorer.screenshot()
Image.fromarray(picture)

# %% [markdown]
# ## Further
#
# - `semantic` is saved in `data/own/run/field`; `SemanticField.load` brings it back, `kfgs query` and `kfgs view` ask it
#   from a shell.
# - `data/own/run/color.ply` holds the colour Gaussians that the features were fused onto: notebook 5 edits them.
# - `kfgs sfm`, `kfgs plan`, `kfgs features`, `kfgs fit` are these cells as commands.
