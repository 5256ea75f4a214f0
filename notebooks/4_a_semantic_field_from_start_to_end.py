# %% [markdown]
# # 4. A semantic field from start to end
#
# **Can a field be better than the teacher it learns from?** A teacher says, with many mistakes, what is where in each
# photograph. Here its maps become some 35,000 Gaussians that answer from any viewpoint, and you will see that they are
# right more often than the teacher. It takes three steps: Gaussians with colours, the teacher's maps carried onto them,
# and classes for pictures that no step has seen.
#
# About 25 seconds on two CPU cores (20 more to make the toy room the first time), 5 afterwards. Needs the extra
# `notebook`, no data: kfgs makes the room, its photographs and a simulated teacher.

# %%
# Your own data: a scene, a teacher's maps of its views and the classes (notebook 7 makes both), label pictures
# `<stem>.png` of its views to score against, and a folder for what is made.
import os
from pathlib import Path

from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features = folder / "features"  # `kfgs features my/scene --teacher lseg ...` writes such a folder
names, text, labels = folder / "classes.json", folder / "text.npy", folder / "labels"
run, pictures = data / "run", data / "pictures"

# %% [markdown]
# ## What goes in
#
# Photographs with cameras, and for each of them a map of 512 channels from the teacher. Similar things have similar
# colours in the second row. Edges are blurred, and some patches are wrong.

# %%
from dataclasses import replace
from functools import partial

import torch
from IPython.display import Image as Shown
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.pipeline import score_teacher, true_labels

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
train, test = scene.views("train"), scene.views("test")
maps = kfgs.FeatureFolder(features).of(scene, "train")
print(scene)
print(f"{len(maps)} maps of {tuple(maps[0].shape)}; {len(classes)} classes: {', '.join(classes.names)}")
unit = partial(torch.nn.functional.normalize, dim=-1)  # only the direction of a feature has a meaning
colors = viz.FeatureColors.fit(unit(torch.cat([maps[i][::4, ::4].flatten(0, 1) for i in range(len(maps))])))
chosen = [k * len(maps) // 5 for k in range(4)]
rows = [[scene.image(train[k]) for k in chosen], [colors(unit(maps[k])) for k in chosen]]
Image.fromarray(viz.picture_grid(rows, width=256))

# %% [markdown]
# ## Gaussians, then features
#
# Features are only as sharp as the Gaussians that carry them. So `fit` first trains Gaussians on the photographs,
# as 3DGS does. Then each Gaussian $i$ takes the mean of the teacher's features $\mathbf{F}$ at the pixels $x$ that show
# it, weighted by how much of the pixel it fills:
#
# $$f_i = \frac{\sum_x w_i(x) \, \mathbf{F}(x)}{\sum_x w_i(x)}, \qquad
# w_i(x) = \alpha_i(x) \prod_{j < i} (1 - \alpha_j(x))$$
#
# If the teacher is wrong in one view, the other views outvote it. Blending with neighbours is corrected, and the 512
# numbers become a few *latents* $z_i$ with $f_i \approx B z_i$. Only the Gaussians are trained, no feature is. (The paper
# trains the features too; notebook 8 compares.) If you have a splat of your scene already, add `splat="my.ply"`.

# %%
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
field = kfgs.fit(scene, maps, kfgs.Uplift(color=quick), folder=run, report=print)
print(field.summary())

# %% [markdown]
# ## What is seen from a new viewpoint
#
# Nobody trained on this view. The colours come from the first step, the features from the second. Compare the last two
# pictures: the field has finer borders than the teacher, which sees this very photograph.

# %%
k = 2
camera, image = scene.cameras[test[k]], scene.image(test[k])
test_maps = kfgs.FeatureFolder(features).of(scene, "test")
colored = kfgs.read_splats(run / "color.ply")
print(f"{len(colored):,} Gaussians, PSNR on unseen views: {kfgs.score_views(colored, scene).psnr.value:.1f} dB")
drawn = viz.show_cloud(colored, background="black", color_by="rgb")(camera)
row = [image, drawn, colors(unit(field.feature_map(camera))), colors(unit(test_maps[k]))]
Image.fromarray(viz.picture_grid([row], ("photograph", "colour field", "field's features", "teacher's"), width=256))

# %% [markdown]
# ## Classes
#
# A class is a text, and a text has a feature too, in the same space. Each Gaussian shares one vote among the classes whose
# texts $t_c$ its feature is similar to, $\cos(f_i, t_c)$. A pixel blends the votes of its Gaussians like colours, and the
# largest sum wins. `segment_scene` does so for all unseen views, and draws sheets that compare truth and field.

# %% tags=["thumbnail"]
truth = true_labels(scene, labels, "test")
found = kfgs.segment_scene(field, scene, classes, run / "segmentation", truth=truth)
sheet = Image.open(run / "segmentation" / "sheets" / f"{scene.stem(test[-1])}.png").convert("RGB")
sheet.resize((1024, round(sheet.height * 1024 / sheet.width)))

# %% [markdown]
# ## How good it is
#
# The score of a class is its *intersection over union*: of all pixels that are of the class, or said to be, the share that
# is both. The mean over the classes is the mIoU. Diamonds mark the teacher. Its mistakes differ from view to view, so
# what many views agree on is better than what each of them says. Thin things, like the stand of the lamp, suffer most.

# %%
stems = list(truth)
scores = kfgs.score_scene(found, truth, classes)
teacher = score_teacher(lambda stem: test_maps[stems.index(stem)], truth, classes, camera.size)
print(f"mIoU on unseen views: field {scores.miou.value:.3f}, teacher {teacher.miou.value:.3f}")
viz.plot_iou(scores.iou, classes.names, pictures / "iou.png", reference=teacher.iou, reference_name="teacher")
Shown(pictures / "iou.png", width=700)

# %% [markdown]
# ## Save and load
#
# `fit` has saved the field already, as `field.kfgs` in the run folder: Gaussians, latents, the decoder $B$, the training
# cameras, and how they came about. What is loaded answers exactly as before.

# %%
again = kfgs.SemanticField.load(run / "field.kfgs")
assert torch.equal(again.segment(camera, classes), found[scene.stem(test[k])])
size = (run / "field.kfgs").stat().st_size / 2**20
maps_size = len(maps) * maps[0].numel() * 2 / 2**20
print(f"the field: {size:.1f} MiB; the teacher's maps that it was made of: {maps_size:.0f} MiB")

# %% [markdown]
# Next: [5_query_transfer_edit](5_query_transfer_edit.ipynb) asks this field for things and edits the room with the
# answers.
