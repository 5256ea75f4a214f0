# %% [markdown]
# # 9. Query by example
#
# **How do I ask for something that has no name?** Some teachers know no texts (DINOv2, SAM), and for some things you do not
# know the word. Then show what you mean: click on it in a photograph, or draw a box around it. You will see examples become
# classes, the classes of unseen pictures, and what one click finds.
#
# About 30 seconds on two CPU cores if no notebook was run before this one, else 10. Needs the extra `notebook`, no data.

# %%
# Your own data: a scene, a teacher's maps, and a folder for what is made; examples by class, (x, y) in pixels of a training
# view: points that lie on the thing, or a box (x0, y0, x1, y1) that it fills.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room
from kfgs.fields import Box, Clicks

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, run = folder / "features", data / "run"
examples = {
    "chair": [Clicks("view_020.png", [(136, 92)])],
    "table": [Clicks("view_020.png", [(192, 68)])],
    "plant": [Clicks("view_020.png", [(152, 29)])],
    "rug": [Box("view_020.png", (40, 96, 94, 150))],
    "floor": [Clicks("view_020.png", [(23, 168), (18, 80)])],
    "wall": [Clicks("view_020.png", [(29, 29)]), Box("view_010.png", (15, 135, 55, 175))],
    "ceiling": [Box("view_010.png", (175, 12, 219, 56))],
    "sofa": [Clicks("view_010.png", [(150, 180)])],
    "cushion": [Clicks("view_010.png", [(130, 165), (95, 172)])],
    "lamp": [Clicks("view_010.png", [(205, 118)])],
    "picture": [Box("view_010.png", (75, 110, 95, 130))],
}

# %%
from dataclasses import replace

from PIL import Image

import kfgs
from kfgs import viz

scene = kfgs.load_scene(folder).undistorted()
maps = kfgs.FeatureFolder(features).of(scene, "train")
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
field = kfgs.fit(scene, maps, kfgs.Uplift(color=quick), folder=run)  # notebook 4 explains it
print(field)

# %% [markdown]
# ## What is shown
#
# The examples in their pictures. A few are enough: the field has seen each thing from many sides already.

# %% tags=["thumbnail"]
index = {scene.cameras[i].name: i for i in scene.views("train")}
shown = viz.draw_examples(field.cameras, examples, lambda camera: scene.image(index[camera.name]), width=384)
Image.fromarray(shown)

# %% [markdown]
# ## Examples become classes
#
# For each example $k$ the field renders its features at the pixels $P_k$ that you showed. The class gets the mean direction:
#
# $$t = \frac{1}{n} \sum_{k=1}^{n} \frac{\bar{f}_k}{\|\bar{f}_k\|}, \qquad
# \bar{f}_k = \sum_{x \in P_k} \frac{\mathbf{F}_r(x)}{\|\mathbf{F}_r(x)\|}$$
#
# It takes the place that the feature of a text has otherwise. So everything that takes classes takes these: `segment`,
# `classify`, `query`, the explorer. Masks count as examples too (`kfgs.fields.Mask`, for instance of Segment Anything).

# %%
classes = kfgs.label_set_from_examples(field, examples)
print(classes)
rows = []
for i in scene.views("test")[1:3]:
    photo, labels = scene.image(i), field.segment(scene.cameras[i], classes)
    rows += [photo, viz.overlay_labels(photo, labels, classes.names, alpha=0.7, legend=False)]
titles = ["unseen picture", "classes by example"] * 2
Image.fromarray(viz.picture_grid([rows], titles, width=288, names=classes.names))

# %% [markdown]
# A thing that was not shown, like the cabinet or the door, is given the class of what is most like it.
# To leave such things out, show them as a class of their own, or ask for one class as below.
#
# ## One click
#
# The example alone: a question without any other class. Scores are cosines with what was clicked, and the threshold $\gamma$
# is found in a gap between them. All chairs are found, not only the one that was clicked.

# %%
wanted = next(iter(examples))
one = kfgs.label_set_from_examples(field, {wanted: examples[wanted][0]})
found = field.query(wanted, one, score="cosine")
print(found.how)
for thing in kfgs.connected_parts(field.gaussians, found, distance=0.15):
    print(thing)
camera = scene.cameras[scene.views("test")[1]]
view = camera.resized(2 * camera.height, 2 * camera.width)
scores = viz.draw_view(
    view, lambda plotter: viz.add_cloud(plotter, field.gaussians, color_by=found.scores, style="gaussians")
)
row = [scene.image(scene.views("test")[1]), scores]
Image.fromarray(viz.picture_grid([row], ["unseen picture", f"like what was shown as {wanted}"], width=400))

# %% [markdown]
# In a shell, `kfgs features FIELD --examples FILE` makes the same classes. In the explorer you click in the scene.
#
# Next: [10_meshes_and_point_clouds](10_meshes_and_point_clouds.ipynb) takes labels to other programs.
