# %% [markdown]
# # 5. Ask, carry over, edit
#
# **Where is the chair, and how does the room look without it?** A semantic field is asked for the chair. Its classes are
# carried over to an ordinary colour scene. There the chairs are removed and the plants are painted. You will see what a
# question selects and why, the answer taken apart into single chairs, and the room before and after.
#
# About 40 seconds on two CPU cores if no notebook was run before this one, else 15. Needs the extra `notebook`, no data.

# %%
# Your own data: a scene, a teacher's maps of its views, the classes, a folder for what is made; and two of the classes,
# what to look for and what to paint.
import os
from pathlib import Path

from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
run, out = data / "run", data / "edited"
thing, painted, paint = "chair", "plant", "#c04040"
shell = ("ceiling", "wall", "window blind")  # what hides the rest from outside, where there are such classes

# %%
from dataclasses import replace

import torch
from IPython.display import Image as Shown
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.labels import InBox, OfClass, nearest_labels

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
maps = kfgs.FeatureFolder(features).of(scene, "train")
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
field = kfgs.fit(scene, maps, kfgs.Uplift(color=quick), folder=run)  # notebook 4 explains it
colors = kfgs.read_splats(run / "color.ply")
print(field)
print(colors)

# %% [markdown]
# ## "Where is the chair?"
#
# The cosine $\cos(f_i, t)$ says how well Gaussian $i$ fits the text $t$. Those above a threshold $\gamma$ are selected
# (Sec. 3.4). The paper gives no value for $\gamma$. With the cosine alone, kfgs looks for a gap between the scores. By
# default it compares the text with the other classes: the *relevancy* is the share of the text against the class that
# comes closest, and $\gamma = 0.5$ means "as much like the chair as like something else".

# %%
camera = scene.cameras[scene.views("test")[0]]
answers = {"cosine": field.query(thing, classes, score="cosine"), "relevancy": field.query(thing, classes)}
for name, selection in answers.items():
    print(f"{name:<10} {len(selection):5d} Gaussians, gamma {selection.threshold:.3f}: {selection.how}")


def draw(cloud, color_by):
    return viz.draw_view(camera, lambda plotter: viz.add_cloud(plotter, cloud, color_by=color_by, style="gaussians"))


row = [scene.image(scene.views("test")[0]), *(draw(field, answer) for answer in answers.values())]
Image.fromarray(viz.picture_grid([row], ["photograph", *answers], width=320))

# %% [markdown]
# The scores of all Gaussians: the chairs' cosines form a hill of their own, and $\gamma$ lies in the gap before it.

# %%
viz.plot_scores(answers["cosine"], out / "scores.png")
Shown(out / "scores.png", width=560)

# %% [markdown]
# ## One chair after the other
#
# `connected_parts` takes a selection apart into things: each has a box, a size, and the view that shows it best. Parts that
# are nearer than `distance` (0.1 m here) are one thing. Walls and ceiling are left out, to look into the room.

# %% tags=["thumbnail"]
cameras = [scene.cameras[i] for i in scene.views("train")]
semantic = field.label(classes)
things = kfgs.connected_parts(semantic, answers["relevancy"], cameras, distance=0.1)
for number, part in enumerate(things, start=1):
    print(f"{thing} {number}: {part!r}")
hidden = torch.tensor([-1, *(classes.index(name) for name in shell if classes.knows(name))])
inside = semantic.select(~torch.isin(semantic.labels, hidden))
up = estimate_up(scene.cameras)
orbit = Orbit(frames=1, size=(450, 640), elevation_degrees=50, start_degrees=120, zoom=1.6)


def draw_things(plotter):
    viz.add_cloud(plotter, inside, style="gaussians")
    viz.add_boxes(plotter, things, up=up.tolist())


Image.fromarray(viz.draw_view(orbit_cameras(inside.means, orbit, up=up)[0], draw_things))

# %% [markdown]
# ## Carried over to the colour scene
#
# The semantic field has no colours, and a colour scene has no classes: the two are decoupled. But they lie in the same
# place. A colour Gaussian at $p^1$ takes the label of the nearest semantic Gaussian at $p^2$ if it is closer than a distance
# $\lambda$ (Sec. 3.4):
#
# $$\|p^1 - p^2\| < \lambda$$
#
# By default kfgs takes $\lambda$ from the spacing of the clouds. `linked_clouds` shows the two next to each other with one
# camera; in a window, turning one turns the other.

# %%
carried = nearest_labels(semantic.means, semantic.labels, colors.means)
print(carried)
plotter = viz.linked_clouds(semantic, colors, camera=camera, height=360, off_screen=True)
picture = plotter.screenshot()
plotter.close()
Image.fromarray(picture)

# %% [markdown]
# Who gave a label to whom? `show_transfer` lifts the colour cloud over the semantic one, without walls and ceiling. Each line
# joins a colour Gaussian to the semantic one that gave it its class, in the colour of the class. Red has no label, and yellow
# is disputed: another class is nearly as near. In a window, a slider moves $\lambda$, and the key P names a Gaussian.

# %%
plotter = viz.show_transfer(field, colors, off_screen=True)
picture = plotter.screenshot(return_img=True)
plotter.close()
Image.fromarray(picture)

# %% [markdown]
# If $\lambda$ is too small, Gaussians stay without a label (grey). The last picture shows another way, `attach(by="views")`:
# the field segments its training views, and each colour Gaussian takes the class of most of the pixels that it fills. Its
# borders are sharper, so we continue with it.

# %%
row, titles = [], []
for distance in (0.1 * carried.distance, carried.distance):
    near = kfgs.transfer_labels(semantic, colors, distance)
    row.append(viz.show_cloud(near)(camera))
    titles.append(f"lambda {distance:.2g}: {int((near.labels < 0).sum()):,} without")
labelled = kfgs.attach(field, colors, classes, by="views").gaussians
row.append(viz.show_cloud(labelled)(camera))
Image.fromarray(viz.picture_grid([row], [*titles, "by views"], width=320))

# %% [markdown]
# ## Edits
#
# An edit says what to do, and where. A list of edits is applied to a copy, so the scene itself never changes. The views are
# those that show the change best. Floor and rug were hardly seen where the chairs stood: kfgs does not invent them.

# %%
picture = {"background": "black", "color_by": "rgb"}
edits = kfgs.EditList().then(kfgs.Remove(OfClass(thing))).then(kfgs.Recolor(OfClass(painted), paint))
edited = edits.apply(labelled)
print(f"{len(labelled)} Gaussians, {len(edited)} after {[edit.op for edit in edits]}")
unseen = [scene.cameras[i] for i in scene.views("test")]
views = [unseen[i] for i in viz.views_of_change(labelled, edited, unseen)]
rows = [[viz.show_cloud(cloud, **picture)(view) for cloud in (labelled, edited)] for view in views]
Image.fromarray(viz.picture_grid(rows, ("before", f"no {thing}, {painted} in red"), width=320))

# %% [markdown]
# Selections combine with `&`, `|` and `~`: here it is only the chair in one box. `undo` gives the list without its last edit.
# Any splat viewer opens the file that is written; the classes travel along.

# %%
low, high = (corner.tolist() for corner in things[0].extent)
first = OfClass(thing).select(labelled) & InBox(low, high).select(labelled)
painting = kfgs.EditList().then(kfgs.Recolor(first, "teal"))
states = {"before": painting.undo(), f"one {thing} painted": painting}
view = cameras[things[0].best_view.index]
row = [viz.show_cloud(edit.apply(labelled), **picture)(view) for edit in states.values()]
written = kfgs.write_splats(edited, out / "edited.ply")
print([path.name for path in written.paths])
Image.fromarray(viz.picture_grid([row], list(states), width=320))

# %% [markdown]
# Next: [6_inspect_in_pyvista](6_inspect_in_pyvista.ipynb) looks at all of this in space.
