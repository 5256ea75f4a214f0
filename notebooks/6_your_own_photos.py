# %% [markdown]
# # 6. Your own photos
#
# **I have a folder of photos. What can I ask them, without words and without labels?** From pictures alone to answers: cameras
# by structure from motion, features of DINOv2, a field, and a few clicks that say what is what. You will see what each step
# makes, and how to check it before the next one.
#
# About a minute on two CPU cores. Needs the extras `notebook` and `hf`, twelve photos, and the weights of DINOv2; the first cell
# says where to get both.

# %%
# Your own data: photos = Path("my/photos"), 10 to 150 that overlap, of one camera at one zoom: walk around, do not just turn on
# the spot. weights = "facebook/dinov2-small" (88 MB from the Hugging Face hub), or a folder.
from example import DATA, find_dinov2, find_photos

photos, weights = find_photos(), find_dinov2()
out = DATA / "photos"

# %% [markdown]
# ## Photos
#
# The portal of the cathedral of Lund (test data of gtsfm, Apache-2.0). Copies of 960 pixels make everything quick.

# %%
from PIL import Image

from kfgs import viz
from kfgs.scenes import list_images, read_image

small = out / "images"
small.mkdir(parents=True, exist_ok=True)
for name in list_images(photos):
    photo = Image.open(photos / name)
    photo.thumbnail((960, 960))
    photo.save(small / name, quality=95)
names = list_images(small)
Image.fromarray(viz.picture_grid([[read_image(small / name) for name in names[::3]]], width=180))

# %% [markdown]
# ## Cameras
#
# Structure from motion finds points that several photos share, and from them where each photo was taken. It is COLMAP's, in
# this process and on the CPU. Read how many photos are *registered*: the others found no place and are not used. If you have
# cameras already, load them and skip this cell. `undistorted` removes the lens that COLMAP found.

# %%
import kfgs

if not (out / "sparse" / "0").is_dir():
    print(kfgs.run_sfm(small, out))
scene = kfgs.load_scene(out).undistorted()
print(scene)

# %% [markdown]
# Look before you continue: are the photos where you stood, and is the top up? A world made of photos has no scale and no
# *up* of its own. `estimate_up` reads the latter from how the camera was held.

# %%
from kfgs.cameras import estimate_up, robust_bounds

inside = robust_bounds(scene.points).inside
plotter = viz.make_plotter(480, 720)
colors = scene.colors[inside].numpy()
plotter.add_points(scene.points[inside].numpy(), scalars=colors, rgb=True, point_size=3, lighting=False)
viz.add_cameras(plotter, scene.cameras, images=scene.image, size=0.6 * scene.extent, most=6)
right, _, ahead = scene.cameras[0].viewmat[:3, :3]
up = estimate_up(scene.cameras).to(ahead)
plotter.view_vector((0.8 * right + 0.5 * up - ahead).tolist(), viewup=up.tolist())  # from behind the cameras
plotter.camera.zoom(1.7)
plotter.show()

# %% [markdown]
# ## Features
#
# DINOv2 gives each patch of 14 x 14 pixels 384 numbers that say what it looks like. It knows no words. `FeatureColors` shows
# them as colours: what is alike should have one colour in all photos. If what you look for has the colour of what is around
# it, no question will find it.

# %%
import torch

teacher = kfgs.load_teacher("dinov2", weights, size=644)
kfgs.extract_features(teacher, scene, out / "features", split="train")
maps = kfgs.FeatureFolder(out / "features").of(scene, "train")
train, test = scene.views("train"), scene.views("test")
features = viz.FeatureColors.fit(torch.cat([maps[i].flatten(0, 1)[::5] for i in range(len(maps))]))
row = [scene.image(train[0]), features(maps[0]), scene.image(train[-1]), features(maps[len(maps) - 1])]
Image.fromarray(viz.picture_grid([row], ["photo", "DINOv2"] * 2, width=180))

# %% [markdown]
# ## The field
#
# `fit` trains Gaussians on the photos and puts the features on them (notebook 4). `QUICK` is a short schedule, on pictures of a
# third of their size; leave it out for a better splat. A run that was killed continues where it stopped.

# %%
from dataclasses import replace

from example import QUICK

method = kfgs.Uplift(color=replace(QUICK, picture_scale=1 / 3))
field = kfgs.fit(scene, maps, method, folder=out / "run")
print(field)

# %% [markdown]
# ## Clicks
#
# Some clicks in the photos say what is what: (x, y) in pixels, or a box. Give an example of everything that is large, also of
# what you do not look for: each Gaussian takes the most similar of *your* classes. For each example $k$ the field renders its
# features at the pixels $P_k$, and the class gets the mean direction:
#
# $$t = \frac{1}{n} \sum_{k=1}^{n} \frac{\bar{f}_k}{\|\bar{f}_k\|}, \qquad
# \bar{f}_k = \sum_{x \in P_k} \frac{\mathbf{F}_r(x)}{\|\mathbf{F}_r(x)\|}$$

# %%
from kfgs.fields import Clicks

left, right = scene.cameras[train[0]].name, scene.cameras[train[-1]].name
clicks = {
    "door": [Clicks(left, [(360, 520), (360, 690)])],
    "arch": [Clicks(left, [(350, 215), (250, 300), (440, 300)]), Clicks(left, [(350, 320), (350, 395)])],
    "jamb": [Clicks(left, [(230, 600), (260, 530), (470, 600), (180, 540)])],
    "column": [Clicks(left, [(85, 600), (84, 520), (560, 600), (560, 700)]), Clicks(right, [(72, 650), (568, 600)])],
    "frieze": [Clicks(left, [(180, 125), (350, 105), (250, 60), (500, 60)])],
    "wall": [Clicks(left, [(30, 250), (30, 500), (615, 350)]), Clicks(right, [(20, 200)])],
    "steps": [Clicks(left, [(300, 830), (250, 910), (450, 905)])],
}
photo_of = {camera.name: scene.image(i) for i, camera in enumerate(scene.cameras)}
shown = viz.draw_examples(field.cameras, clicks, lambda camera: photo_of[camera.name], width=360)
Image.fromarray(shown)

# %% [markdown]
# ## Answers
#
# Everything that takes classes takes these: `segment`, `classify`, `query`, the viewer. Here are the classes of two photos that
# took no part in the fit. What was not shown, like the bases of the columns, gets the class of what is most like it.

# %% tags=["thumbnail"]
classes = kfgs.label_set_from_examples(field, clicks)
row = []
for i in test:
    labels = field.segment(scene.cameras[i], classes)
    row += [scene.image(i), viz.overlay_labels(scene.image(i), labels, classes.names, alpha=0.6, legend=False)]
Image.fromarray(viz.picture_grid([row], ["unseen photo", "its classes"] * 2, width=180, names=classes.names))

# %% [markdown]
# A question gives Gaussians, not pixels: how well each one answers, and which are selected. Its size is in the units of the
# scene, which a world made of photos chose for itself.

# %%
door = field.query("door", classes)
print(f"{len(door):,} Gaussians: {door.how}")
print(*kfgs.connected_parts(field, door, field.cameras), sep="\n")
camera = scene.cameras[test[0]]
scores = viz.draw_view(camera, lambda plotter: viz.add_cloud(plotter, field, color_by=door, style="gaussians"))
splat = kfgs.attach(field, kfgs.read_splats(out / "run" / "color.ply"), classes).gaussians
painted = kfgs.EditList().then(kfgs.Recolor("door", "teal")).apply(splat)
edited = viz.show_cloud(painted, background="black", color_by="rgb")(camera)
row = [scene.image(test[0]), scores, edited]
Image.fromarray(viz.picture_grid([row], ["unseen photo", "score of door", "the door painted"], width=240))

# %% [markdown]
# - `kfgs.explore(field, splat, classes=classes)` opens the viewer with these classes (notebook 5).
# - A teacher that knows words needs no clicks: `load_teacher("lseg", "demo_e200.ckpt")`, the paper's, or `"clip"`; then
#   `kfgs.make_label_set(teacher, ["door", "arch"])` makes the classes.
# - `kfgs sfm`, `kfgs features`, `kfgs fit` and `kfgs view` are these cells as commands.
