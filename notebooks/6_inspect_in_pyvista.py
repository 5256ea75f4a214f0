# %% [markdown]
# # 6. Inspect in pyvista
#
# **How do I look at a field in space?** You will see clouds, cameras and selections in pyvista, with pyvista's own grammar:
# `viz.add_*(plotter, ...)` puts one thing into a plotter and returns it. Everything else that pyvista can do is yours. At
# the end the viewer opens in a cell, where you can turn the scene and click.
#
# About 40 seconds on two CPU cores if no notebook was run before this one, else 15. Needs the extra `notebook`, no data and
# no display: without one, pictures are drawn off-screen (Debian: `libegl1 libegl-mesa0 libgl1-mesa-dri`).

# %%
# Your own data: a scene, its teacher's maps, the classes, and a run folder (a field that is there already is only read);
# what to ask for, and what hides the rest from outside.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
run = data / "run"
word = "chair"
shell = ("ceiling", "wall", "window blind", "door", "picture")  # where there are such classes

# %%
from dataclasses import replace

import torch
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.cameras import Orbit, estimate_up, orbit_cameras

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
cameras = [scene.cameras[i] for i in scene.views("train")]
maps = kfgs.FeatureFolder(features).of(scene, "train")
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
field = kfgs.fit(scene, maps, kfgs.Uplift(color=quick), folder=run)  # notebook 4 explains it
color = kfgs.read_splats(run / "color.ply")
semantic = field.label(classes)
print(f"{len(semantic):,} semantic Gaussians, {len(color):,} of colour")

# %% [markdown]
# ## Two clouds and their labels, in one line
#
# Below are the classes, above the colours, and lines show who gave a label to whom (notebook 5). It is a pyvista plotter. In
# Jupyter it is live: drag to turn it, move the slider for $\lambda$, and press P over a Gaussian. A web page shows a still.

# %%
viz.show_transfer(field, color).show()

# %% [markdown]
# ## A plotter, a cloud, a picture
#
# `make_plotter` is `pv.Plotter`, made safe for machines without a display. `look_through` puts the view where one of the
# scene's cameras stood. The actor carries its data as named arrays, one value per Gaussian.

# %%
camera = scene.cameras[scene.views("test")[3]]
plotter = viz.make_plotter(2 * camera.height, 2 * camera.width, off_screen=True)
actor = viz.add_cloud(plotter, semantic, style="gaussians")  # coloured by its classes
viz.add_legend(plotter, semantic)
viz.look_through(plotter, camera)
print(actor.mapper.dataset.array_names)
Image.fromarray(plotter.screenshot(return_img=True))  # with a display: plotter.show()

# %% [markdown]
# ## Points, Gaussians, ellipsoids
#
# Points are quick. Ellipsoids are closed surfaces of one standard deviation, to see shapes and sizes. Only `gaussians` is
# what kfgs renders and scores. `draw_view` is the cell above in one call: it makes the plotter, and closes it.


# %%
def draw(cloud, scale=1, **how):
    view = camera.resized(scale * camera.height, scale * camera.width)
    return viz.draw_view(view, lambda plotter: viz.add_cloud(plotter, cloud, **how))


styles = ("points", "gaussians", "ellipsoids")
Image.fromarray(viz.picture_grid([[draw(semantic, style=style) for style in styles]], styles))

# %% [markdown]
# ## What colours stand for
#
# A cloud can be coloured by its classes, by its latents (similar features have similar colours), by the score of a question,
# or by its own colour.

# %%
found = field.query(word, classes)
latents = draw(semantic, color_by="feature", style="gaussians")
scores = draw(semantic, color_by=found, clim=(0, 1), style="gaussians")
row = [latents, scores, draw(color, color_by="view", style="gaussians")]
Image.fromarray(viz.picture_grid([row], ["latents", f"score of {word}", "colours"]))

# %% [markdown]
# ## From outside, with cameras
#
# Any camera will do. Here it flies around the room, whose walls and ceiling are left out.

# %% tags=["thumbnail"]
hidden = torch.tensor([-1, *(classes.index(name) for name in shell if classes.knows(name))])
inside = semantic.select(~torch.isin(semantic.labels, hidden))
orbit = Orbit(frames=8, size=(420, 640), elevation_degrees=40, zoom=1.3)
outside = orbit_cameras(inside.means, orbit, up=estimate_up(cameras).float())[1]


def draw_outside(plotter):
    viz.add_cloud(plotter, inside, style="gaussians")
    photographs = [scene.image(i) for i in scene.views("train")]
    viz.add_cameras(plotter, cameras, images=photographs, size=0.2 * scene.extent, most=10)


Image.fromarray(viz.draw_view(outside, draw_outside))

# %% [markdown]
# ## Selections
#
# The answer to a question is a selection, and `connected_parts` takes it apart. To see the parts in the colour scene, their
# numbers are carried over like labels (notebook 5). What is not selected is grey, and each part has its box.

# %%
owner, parts = torch.full((len(semantic),), -1), kfgs.connected_parts(semantic, found, cameras, distance=0.15)
for number, part in enumerate(parts):
    owner[part.indices] = number
    print(part)
shown = kfgs.transfer_labels(semantic.replace(labels=owner, names=()), color, 0.1)
view = camera.resized(2 * camera.height, 2 * camera.width)


def draw_parts(plotter):
    viz.add_cloud(plotter, shown, style="gaussians")
    viz.add_boxes(plotter, parts)


Image.fromarray(viz.draw_view(view, draw_parts))

# %% [markdown]
# ## The explorer, driven from cells
#
# `explore` is one call for all of this: both clouds, questions, thresholds, clicks. With `where="picture"` nothing opens, and
# every control is a method. A higher $\gamma$ keeps only what is surest.

# %%
with kfgs.explore(field, color, classes=classes, cameras=[camera, *cameras], where="picture", height=420) as view:
    print(view.ask(word).selection)
    view.set_gamma(0.8)
    picture = view.screenshot()
Image.fromarray(picture)

# %% [markdown]
# ## Live
#
# In Jupyter, the last value of this cell is the viewer itself: turn the scene, type a word, click, select, edit and undo.
# Where widgets cannot run, for instance on a web page, you see a still picture: what was asked keeps its colours.

# %%
first = camera.resized(2 * camera.height, 2 * camera.width)
viewer = kfgs.explore(field, color, classes=classes, cameras=[first, *cameras], where="notebook")
viewer.ask(word)
viewer

# %% [markdown]
# `where="browser"` opens it as a page that only this machine can open. `where="window"` opens both clouds in a pyvista
# window. `viewer.save_html("room.html")` writes one file to send around. From a shell:
# `kfgs view data/run --color data/run/color.ply --scene data/room`.
#
# Next: [7_your_own_images](7_your_own_images.ipynb) starts from photographs alone.
