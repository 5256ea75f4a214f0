# %% [markdown]
# # 6. Inspect in pyvista
#
# What `kfgs.viz` puts into a pyvista plotter, in pyvista's own grammar: `add_*(plotter, ...)` puts one actor into it and
# returns it, data travel as named arrays, and you call `.show()`. You will see both fields as true Gaussians, cameras,
# selections, and at the end the explorer: type a word and watch it light up in the semantic cloud and, through lambda, in
# the colour cloud.
#
# About a minute on two CPU cores if no notebook was run before this one, 15 seconds if
# `5_query_transfer_edit` was. Needs the extra `notebook`, no data and no display: without one everything is drawn
# off-screen (Debian: `libegl1 libegl-mesa0 libgl1-mesa-dri`).

# %%
# Your own data: a scene, its teacher's maps, the classes with their text embeddings, and a run folder (fields that are
# there already are only read); what to ask for, a class to show alone, and what hides the rest from outside.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
run, out = data / "run", data / "pictures"
word, alone = "chair", "table"
shell = ("ceiling", "wall", "window blind", "door", "picture")  # where there are such classes
apart = 0.15  # scene units: parts that are nearer are one thing; None: the spacing of the Gaussians decides
shown_view = 3  # of the test views

# %%
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from kfgs import (
    ColorConfig,
    FeatureFolder,
    FitConfig,
    connected_parts,
    fit_color,
    fit_scene,
    load_label_set,
    load_scene,
    rasterize,
    transfer_labels,
    viz,
)
from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.labels import Selection
from kfgs.metrics import psnr
from kfgs.pipeline import feature_colors

# %% [markdown]
# The same room and the same fields as in the notebooks before. The semantic Gaussians take the class of their own fused
# feature; the colour Gaussians get theirs by distance alone (Sec. 3.4).

# %%
scene = load_scene(folder).undistorted()
classes = load_label_set(names, text)
cameras = [scene.cameras[i] for i in scene.views("train")]
maps = FeatureFolder(features).of(scene, "train")
quick = ColorConfig.quick()
color_config = replace(quick, field=replace(quick.field.with_steps(800), max_gaussians=60_000))
color = fit_color(scene, run, color_config).gaussians
field = fit_scene(scene, maps, run, FitConfig.cpu(), splat=color).field

semantic = field.label(classes)
transfer = transfer_labels(semantic, semantic.labels, color)
color = color.replace(labels=transfer.labels)
print(f"{len(semantic):,} semantic Gaussians, {len(color):,} of colour")
print(transfer)

# %% [markdown]
# ## A plotter, an actor, a picture
#
# `make_plotter` is `pv.Plotter` made safe for machines without a display. `style="gaussians"` draws what a splat *is*:
# anisotropic Gaussians, sorted and blended. `look_through` puts the view where one of the scene's cameras stood.

# %%
camera = scene.cameras[scene.views("test")[shown_view]]
camera = camera.resized(round(256 * camera.height / camera.width), 256)  # small pictures
plotter = viz.make_plotter(480, 640, off_screen=True)
colors = viz.palette(semantic.labels, classes.names)
actor = viz.add_cloud(plotter, semantic, color_by=colors, style="gaussians")
viz.add_legend(plotter, semantic.labels, classes.names)
viz.look_through(plotter, camera)
print(actor.mapper.dataset.array_names)  # what the actor carries, one row per Gaussian
Image.fromarray(plotter.screenshot(return_img=True))  # with a display: plotter.show()

# %% [markdown]
# ## Points, Gaussians, ellipsoids
#
# Points are quick. Ellipsoids are closed surfaces (half axes of one standard deviation; faint ones
# are left out). Only Gaussians are the field. `shot` is the cell above, for short.


# %%
def shot(camera, draw, scale=1):
    plotter = viz.make_plotter(scale * camera.height, scale * camera.width, off_screen=True)
    draw(plotter)
    viz.look_through(plotter, camera)
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    return picture


styles = ("points", "gaussians", "ellipsoids")
pictures = [
    shot(camera, lambda plotter, style=style: viz.add_cloud(plotter, semantic, style=style)) for style in styles
]
Image.fromarray(viz.picture_grid([pictures], styles))

# %% [markdown]
# ## What colours stand for
#
# Labels, colours, latents, scores, opacity. Latent colours are **one** projection per scene (`FeatureColors`), so that they
# agree from view to view. A score bar is `add_scalar_bar`. Scores here are the relevancy of the word, told from the other
# classes.

# %%
found = field.query(word, classes)
meanings = {
    "labels": (semantic, {"color_by": "label"}),
    "latents": (semantic, {"color_by": "feature", "feature_colors": feature_colors(field)}),
    f"score of {word}": (semantic, {"color_by": found.scores, "clim": (0, 1)}),
    "carried labels": (color, {"color_by": "label"}),
    "rgb": (color, {"color_by": "view"}),
    "opacity": (color, {"color_by": "opacity"}),
}
pictures = [
    shot(camera, lambda plotter, cloud=cloud, how=how: viz.add_cloud(plotter, cloud, style="gaussians", **how))
    for cloud, how in meanings.values()
]
titles = list(meanings)
rows = [viz.picture_grid([pictures[i : i + 3]], titles[i : i + 3]) for i in (0, 3)]
Image.fromarray(np.concatenate(rows))

# %% [markdown]
# ## Is it the right picture?
#
# The same Gaussians by kfgs's own rasteriser, the one that trains and scores. VTK's Gaussians are sorted, dilated, and cut
# off by the rules of 3DGS, so the two agree to about 40 dB (as in notebook 2, now with the trained colours): what you
# inspect is what was fitted.

# %%
drawn = shot(camera, lambda plotter: viz.add_cloud(plotter, color, color_by="view", style="gaussians"))
with torch.no_grad():
    ours = rasterize(color.replace(features=None), camera, background=torch.ones(3)).map.clamp(0, 1)
error = (torch.from_numpy(drawn / 255).float() - ours).abs()
titles = ["pyvista", "kfgs.rasterize", "10 x difference"]
print(f"{psnr(torch.from_numpy(drawn / 255).float(), ours):.1f} dB")
Image.fromarray(viz.picture_grid([[drawn, ours, 10 * error]], titles))

# %% [markdown]
# ## Cameras and their pictures
#
# Pyramids with the true opening, each picture on its image plane, a roof on its upper edge: twelve of them, evenly chosen.

# %%
up = estimate_up(cameras).float()
hidden = torch.tensor([-1, *(classes.index(name) for name in shell if classes.knows(name))])
inside = semantic.select(~torch.isin(semantic.labels, hidden))
around = Orbit(frames=8, size=(420, 640), elevation_degrees=40, zoom=1.3)
outside = orbit_cameras(inside.means, around, up=up)[1]
photographs = [scene.image(i) for i in scene.views("train")]
size = 0.2 * scene.extent
plotter = viz.make_plotter(*outside.size, off_screen=True)
viz.add_cloud(plotter, inside, style="gaussians")
viz.add_cameras(plotter, cameras, size=size, most=12)
viz.add_camera_images(plotter, cameras, photographs, size=size, most=12)
viz.look_through(plotter, outside)
Image.fromarray(plotter.screenshot(return_img=True))

# %% [markdown]
# ## Both fields, linked
#
# They share only space. Turning one turns the other (`plotter.show()`).

# %%
plotter = viz.linked_clouds(semantic, color, names=classes.names, camera=camera, height=360, off_screen=True)
Image.fromarray(plotter.screenshot(return_img=True))

# %% [markdown]
# ## Selections
#
# `connected_parts` gives the connected parts of a selection: how many Gaussians, where, how large, seen best from where. Scores
# light up on the left, and on the right the parts stand in their oriented boxes. The rest keeps its brightness where there
# are colours: so the selection is carried to the colour cloud first, to half of lambda, so that parts stay crisp.
# (Matches and the histogram of their distances, `add_matches` and `plot_distances`, are in notebook 5.)

# %%
parts = connected_parts(semantic, found, cameras, distance=apart)
for part in parts:
    print(part)
owner = torch.full((len(semantic),), -1)
for number, part in enumerate(parts):
    owner[part.indices] = number
carried = transfer_labels(semantic, owner, color, transfer.distance / 2).labels
selections = {f"{word} {number + 1}": Selection.of(carried == number) for number in range(len(parts))}


def draw_scores(plotter):
    cloud = viz.add_cloud(plotter, semantic, color_by=found.scores, style="gaussians", clim=(0, 1))
    viz.add_scalar_bar(plotter, cloud, f"relevancy of {word}")


def draw_parts(plotter):
    viz.add_selections(plotter, color, selections, style="gaussians")


pictures = [shot(camera, draw_scores, 2), shot(camera, draw_parts, 2)]
Image.fromarray(viz.picture_grid([pictures], ["scores", "parts"]))

# %% [markdown]
# ## Recolour without drawing again
#
# The actor stays; its colours are exchanged in the order of the Gaussians. That is how the explorer's sliders are quick.

# %%
plotter = viz.make_plotter(*camera.size, off_screen=True)
actor = viz.add_cloud(plotter, semantic, style="gaussians")
viz.look_through(plotter, camera)
before = plotter.screenshot(return_img=True)
wanted = torch.where(semantic.labels == classes.index(alone), semantic.labels, -1)
viz.recolor_cloud(actor, viz.palette(wanted))
plotter.render()
after = plotter.screenshot(return_img=True)
Image.fromarray(viz.picture_grid([[before, after]], ["all classes", alone]))

# %% [markdown]
# ## The explorer, driven from cells
#
# One call for all of it. `where="picture"` opens nothing; every control is a method, and the picture is the window.

# %%
options = viz.ExploreOptions(height=360, width=960)
view = viz.explore(field, color, classes=classes, cameras=cameras, where="picture", options=options)
view.look_from(camera)
view.ask(word)
print("\n".join(view.lines()))
Image.fromarray(view.screenshot())

# %% [markdown]
# The question was told from the other classes; gamma and lambda were chosen from the data, and can be dragged. A higher
# gamma keeps what is surest. A smaller lambda leaves colour Gaussians without a source (grey once the question is dropped):
# a sixth of it is far too small, to see what it does.

# %%
view.set_gamma(0.8)
view.set_distance(transfer.distance / 6)
print("\n".join(view.lines()))
Image.fromarray(view.screenshot())

# %% [markdown]
# Point at something (pixels, y from the top), here at the middle of the left half: its class, its neighbours, the views that
# see it.

# %%
view.ask(None)
picked = view.pick(options.width / 4, options.height / 2)
print("\n".join(picked.lines() if picked else ["background"]))
Image.fromarray(view.screenshot())

# %% [markdown]
# ### Live
#
# The viewer draws in the browser, with everything to click, select, edit and undo. In a notebook it is a widget; where
# widgets cannot run, on a web page for instance, you see a picture of it.

# %%
viewer = viz.explore(field, color, classes=classes, cameras=cameras, where="notebook")
viewer.ask(word)
viewer

# %% [markdown]
# `where="browser"` opens it as a page that only this machine can open (interrupt the kernel to go on), `where="window"` both
# clouds in a pyvista window, and `viewer.save_html("room.html")` writes one file to send around. From a shell:
# `kfgs view data/run/field --color data/run/color.ply --scene data/room`. To ask for words that are no classes, pass the
# teacher's text encoder as `embed=`.
