# %% [markdown]
# # 4. A semantic field from start to end
#
# A teacher says, noisily, what is where in each picture. Here its maps become some 20,000 labelled Gaussians that answer
# from any viewpoint, and you will see that **they are better than the teacher they learnt from**: sharp Gaussians, the
# maps averaged onto them and compressed, unseen views beside truth and teacher, scores, one query, the paper's method
# for comparison, sizes, save and load.
#
# About 45 seconds on two CPU cores (20 more to make the toy room the first time), 10 afterwards. Needs the extra
# `notebook`, no data: kfgs makes the room, its photographs and a simulated teacher.

# %%
# Your own data: a scene (COLMAP, transforms.json, ...), a teacher's maps of its views, the classes with their text
# embeddings (notebook 7 makes maps and classes), label pictures `<stem>.png` of its views to score against, and a
# folder for the run. Without label pictures, notebook 7 is the one to follow.
import os
from pathlib import Path

from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features = folder / "features"  # `kfgs features my/scene --teacher lseg ...` writes such a folder
names, text, labels = folder / "classes.json", folder / "text.npy", folder / "labels"
run, pictures = data / "run", data / "pictures"
lid = ("ceiling",)  # classes that hide the rest from above; () if there are none
question = "chair"  # one of the classes

# %% [markdown]
# ## What goes in
#
# Posed pictures, and for each a map of 512 channels from the 2-D teacher. The third picture of each row is what the
# teacher says when each of its pixels takes the class with the nearest text: blurred at the borders, with patches that
# are wrong, and wrong elsewhere in every view.

# %%
from dataclasses import replace

import numpy as np
import torch
from IPython import display
from PIL import Image

from kfgs import (
    AutoencoderConfig,
    ColorConfig,
    FeatureFolder,
    FieldConfig,
    FitConfig,
    SemanticField,
    fit_color,
    fit_scene,
    load_label_set,
    load_scene,
    score_scene,
    score_views,
    segment_scene,
    uplift,
    viz,
)
from kfgs.cameras import Orbit, estimate_up, orbit_cameras, resize_labels
from kfgs.labels import classify
from kfgs.pipeline import feature_colors, score_teacher, true_labels

scene = load_scene(folder).undistorted()
classes = load_label_set(names, text)
train, test = scene.views("train"), scene.views("test")
maps = FeatureFolder(features).of(scene, "train")
print(scene)
print(f"{len(maps)} maps of {tuple(maps[0].shape)}; {len(classes)} classes: {', '.join(classes.names)}")

# %%
unit = torch.nn.functional.normalize  # only the direction of a feature means something
colors = viz.FeatureColors.fit(unit(torch.cat([maps[i][::4, ::4].flatten(0, 1) for i in range(len(maps))]), dim=1))
truth = true_labels(scene, labels, "train")


def teacher_labels(features, size):  # [h, w, D] -> [H, W]
    """The class of the nearest text at each pixel of a teacher's map."""
    return resize_labels(classify(features.flatten(0, 1), classes.embeddings).labels.view(features.shape[:2]), size)


def as_colors(features):  # [h, w, D] -> [h, w, 3] uint8
    """A map of features in the scene's own colours."""
    return colors(unit(features, dim=-1))


rows = []
for k in (0, 10):
    image, size = scene.image(train[k]), scene.cameras[train[k]].size
    said, real = teacher_labels(maps[k], size), truth[scene.stem(train[k])]
    drawn = (viz.overlay_labels(image, labels, classes.names, legend=False) for labels in (said, real))
    rows.append([image, as_colors(maps[k]), *drawn])
sheet = viz.picture_grid(rows, ("photograph", "teacher's features", "teacher's labels", "truth"), width=256)
Image.fromarray(np.concatenate([sheet, viz.legend_strip(torch.arange(len(classes)), classes.names, sheet.shape[1])]))

# %% [markdown]
# ## First: Gaussians that are sharp
#
# Features are only as sharp as the Gaussians that carry them, so the first step is an ordinary 3DGS colour field. If you
# have a splat of your scene already, skip this cell and pass the file to the next one: `fit_scene(..., splat="my.ply")`.
# Each step is kept in the run folder under the hash of its inputs: run the notebook again and it is found.

# %%
quick = ColorConfig.quick()
quick = replace(quick, field=replace(quick.field.with_steps(800), max_gaussians=60_000))
colored = fit_color(scene, run, quick).gaussians
k = 2
camera, image = scene.cameras[test[k]], scene.image(test[k])
print(f"{len(colored):,} Gaussians, PSNR on unseen views: {score_views(colored, scene).psnr.value:.1f} dB")
drawn = viz.show_cloud(colored, background="black", color_by="rgb")(camera)
Image.fromarray(viz.picture_grid([[image, drawn]], ("unseen view", "colour field"), width=256))

# %% [markdown]
# ## Then: the maps, fused in 3-D
#
# `fit_scene` gives each Gaussian the mean of the teacher's features at the pixels that show it, weighted by how much of
# each pixel it fills, and subtracts what its neighbours have added to those pixels. A wrong patch in one view is outvoted
# by the other views *before* anything is compressed. Only then are the 512 channels kept as a few **latents**, numbers that
# are linear in the feature. Gaussians that fill less than half a pixel are dropped, and where more than 50,000 are left,
# those with similar features are merged. Nothing is trained here: seconds, not minutes. `uplift` is the same with every
# Gaussian kept, for a splat that is to stay as it is.

# %%
fitted = fit_scene(scene, maps, run, FitConfig.cpu(), splat=colored, report=print)
field = fitted.field
every = uplift(scene, maps, colored)
print(field.summary())
print(f"every Gaussian kept: {every!r}")

# %% [markdown]
# ## What is seen from a new viewpoint
#
# The field renders its latents z; B z, a product with one matrix, brings them back to the teacher's 512 channels. The field
# never saw the teacher's own map of this view. Its own has finer borders and none of the wrong patches. (The mottled wall
# among the latents: where the Gaussians that are left cover less of a pixel, its latents are shorter. Only their direction
# counts, as in the other two.)

# %%
test_maps = FeatureFolder(features).of(scene, "test")
latents = feature_colors(field)(field.render(camera).map)
row = [image, latents, as_colors(field.feature_map(camera)), as_colors(test_maps[k])]
titles = ("photograph", f"{field.channels} latents", "decoded to 512", "teacher's 512")
Image.fromarray(viz.picture_grid([row], titles, width=256))

# %% [markdown]
# Each Gaussian has one vote, shared among the classes that its feature is similar to. A pixel takes the class with most
# votes, as blended there. All unseen views at once, then two of them beside the truth and beside the teacher, which sees
# the picture itself:

# %%
found = segment_scene(field, scene, classes, run / "segmentation")
truth = true_labels(scene, labels, "test")
rows = []
for k in (2, 5):
    photograph, stem, size = scene.image(test[k]), scene.stem(test[k]), scene.cameras[test[k]].size
    columns = truth[stem], teacher_labels(test_maps[k], size), found[stem]
    rows.append(
        [photograph, *(viz.overlay_labels(photograph, label, classes.names, legend=False) for label in columns)]
    )
sheet = viz.picture_grid(rows, ("photograph", "truth", "teacher", "field"), width=256)
present = torch.cat([target.unique() for target in truth.values()])
Image.fromarray(np.concatenate([sheet, viz.legend_strip(present, classes.names, sheet.shape[1])]))

# %% [markdown]
# ## How good it is
#
# One confusion matrix over all unseen views. Diamonds mark the teacher. Its errors differ from view to view, so what
# many views agree on is better than what each of them says. Thin things (the lamp's stand) suffer most.

# %%
stems = list(truth)
scores = score_scene(found, truth, classes)
teacher = score_teacher(lambda stem: test_maps[stems.index(stem)], truth, classes, camera.size)
print(f"field {scores.miou.value:.3f}, teacher {teacher.miou.value:.3f} mIoU")
viz.plot_iou(scores.iou, classes.names, pictures / "iou.png", reference=teacher.iou, reference_name="teacher")
display.display(display.Image(filename=pictures / "iou.png"))
viz.plot_confusion(scores.confusion, classes.names, pictures / "confusion.png", misses=scores.misses)
display.Image(filename=pictures / "confusion.png")

# %% [markdown]
# ## One question
#
# The same features answer for single Gaussians, without any view: `classify` gives each its class, and `query` those that
# are more similar to one word than to the other classes. From above, without the
# ceiling:

# %%
answer = field.query(question, classes)
print(f"{question}: {answer!r}")
kinds = field.classify(classes).labels
off = torch.tensor([-1, *(classes.index(name) for name in lid if classes.knows(name))])
shown = ~torch.isin(kinds, off)
orbit = Orbit(frames=1, size=(300, 400), elevation_degrees=55, start_degrees=240, zoom=1.6)
above = orbit_cameras(field.gaussians.means[shown], orbit, up=estimate_up(scene.cameras))[0]
selected = torch.where(answer.mask, kinds, -1)
clouds = [field.gaussians.replace(labels=label).select(shown) for label in (kinds, selected)]
row = [viz.show_cloud(cloud)(above) for cloud in clouds]
Image.fromarray(viz.picture_grid([row], ("classes", f"selected: {question}"), width=400))

# %% [markdown]
# ## The paper's method
#
# The paper compresses first: a **codebook** of the teacher's features (Sec. 3.3.1, notebook 3), the codeword of each pixel
# (Eq. 5), an **autoencoder** from 512 to 9 channels (Sec. 3.3.2), and Gaussians that are **trained** until their rendered
# latents match (Eq. 4). It needs no colour field, but training constrains only blends of latents, and the wrong patches
# are compressed with the rest. This schedule is short, so that you need not wait; 1,000 and 800 steps score 0.87 here.
# `FitConfig.paper()` is the published one, 30,000 steps for a GPU, and `docs/results.md` compares both on real scenes.

# %%
config = FitConfig.cpu(
    method="paper", autoencoder=AutoencoderConfig(steps=500), field=FieldConfig.cpu().with_steps(600)
)
fit = fit_scene(scene, maps, data / "run_paper", config)
trained = fit.field
print(*(f"{stage.name:<12} {stage.seconds:5.1f} s" for stage in fit.stages), sep="\n")
trained_found = segment_scene(trained, scene, classes, data / "run_paper" / "segmentation")
trained_scores = score_scene(trained_found, truth, classes)
print(f"paper's method, short schedule: {trained_scores.miou.value:.3f} mIoU; fused: {scores.miou.value:.3f}")
stem = scene.stem(test[2])
row = [
    viz.overlay_labels(image, label, classes.names, legend=False)
    for label in (truth[stem], trained_found[stem], found[stem])
]
Image.fromarray(viz.picture_grid([row], ("truth", "paper's method, short", "fused"), width=256))

# %% [markdown]
# ## How large it is
#
# Table 1 of the paper counts every attribute of a Gaussian in float32 (14 numbers, three of them a colour that these
# fields do not hold, and the latents) and what decodes them: a matrix B for the fused field, a decoder network and a
# codebook for the paper's. Dropping and merging makes it smaller at nearly the same score. The teacher's maps are pictures of
# given viewpoints: only a field can be looked at from others, and edited.

# %%
MIB = 2**20
views, (h, w, dim) = len(train) + len(test), maps[0].shape
every_found = {scene.stem(i): every.segment(scene.cameras[i], classes) for i in test}
every_miou = score_scene(every_found, truth, classes).miou.value
points = {
    f"teacher's maps of {views} views": (views * h * w * dim * 2 / MIB, teacher.miou.value),
    "fused, every Gaussian": (every.storage() / MIB, every_miou),
    "fused": (field.storage() / MIB, scores.miou.value),
    "paper's method, short": (trained.storage() / MIB, trained_scores.miou.value),
}
for name, (size, miou) in points.items():
    print(f"{name:<28} {size:7.2f} MiB   mIoU {miou:.3f}")
viz.plot_quality_storage(points, pictures / "storage.png")
display.Image(filename=pictures / "storage.png")

# %% [markdown]
# ## Save and load
#
# `fit_scene` saved the field already. It is one folder without pickles: Gaussians, latents, what decodes them, the
# training cameras, and how they came about. What is loaded segments exactly as what was saved.

# %%
field.save(run / "copy")
again = SemanticField.load(run / "copy")
assert torch.equal(again.segment(camera, classes), found[scene.stem(test[2])])
size = sum(path.stat().st_size for path in (run / "copy").iterdir()) / MIB
print(f"{again!r}: {size:.2f} MiB in {len(list((run / 'copy').iterdir()))} files, the same labels")

# %% [markdown]
# Next: [5_query_transfer_edit](5_query_transfer_edit.py) asks this field for things and edits the room with the
# answers.
