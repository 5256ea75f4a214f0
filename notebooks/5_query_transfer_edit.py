# %% [markdown]
# # 5. Ask, carry over, edit
#
# The semantic field of a scene is asked for the chair. Its classes are carried over to an ordinary colour scene, by distance
# (Sec. 3.4 of the paper) or by views. There the chairs are removed and the plants painted. You will see where the scores of a
# question lie and where its threshold gamma comes from, which Gaussians find no label for each lambda, the room before and
# after from two viewpoints, and an edit undone.
#
# About a minute on two CPU cores if no notebook was run before this one, 20 seconds if
# `4_a_semantic_field_from_start_to_end` was, and as long afterwards. Needs the extra `notebook`, no data.

# %%
# Your own data: a scene, a teacher's maps of its views, the classes with their text embeddings, a folder for the run (and
# a colour scene of it in any frame, if you have one); what to look for and to paint, two of the classes.
import os
from pathlib import Path

from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
run, out = data / "run", data / "edited"
splat_file = None  # yours: Path("my.ply"); None: the colour field of notebook 4
thing, painted, paint = "chair", "plant", "#c04040"
shell = ("ceiling", "wall", "window blind")  # what hides the rest from outside, where there are such classes
apart = 0.15  # scene units: parts that are nearer are one thing; None: the spacing of the Gaussians decides
shown_view = 0  # of the test views

# %%
from dataclasses import replace

import torch
from IPython import display
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.labels import Component, InBox, InSphere, OfClass
from kfgs.pipeline import views_of_change

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
cameras = [scene.cameras[i] for i in scene.views("train")]
maps = kfgs.FeatureFolder(features).of(scene, "train")
quick = kfgs.ColorConfig.quick()
quick = replace(quick, field=replace(quick.field.with_steps(800), max_gaussians=60_000))
own = kfgs.fit_color(scene, run, quick).gaussians  # notebook 4 looks at this step and the next
field = kfgs.fit_scene(scene, maps, run, kfgs.FitConfig.cpu(), splat=own).field
print(field.summary())

# %% [markdown]
# ## "Where is the chair?"
#
# A Gaussian fits a word as well as its feature's cosine with the word's text embedding, and it is selected above a threshold
# gamma. The paper publishes no gamma. With the cosine alone, kfgs reads one off the scores and says how. By default it tells
# the word from the other classes of the scene: the score is then a relevancy, and gamma is 0.5, "as much like another word".

# %%
questions = {"cosine": {"score": "cosine"}, "relevancy": {}}
found = {name: field.query(thing, classes, **options) for name, options in questions.items()}
for name, selection in found.items():
    print(f"{name:<10} {len(selection):5d} Gaussians, gamma {selection.threshold:.3f}: {selection.how}")

# %% [markdown]
# The scores from a view held out of training, each on its own scale: bright is the thing. Told from the other classes,
# everything else goes dark. (`negatives="canonical"` tells it from "object", "things" and the like, if the label set holds
# them; a phrase that is no class is compared with those by default.)

# %%
held_out = scene.views("test")[shown_view]
camera = scene.cameras[held_out]
width = min(camera.width, 256)  # of each picture in a row of them
row = []
for selection in found.values():
    plotter = viz.make_plotter(*camera.size, off_screen=True)
    viz.add_cloud(plotter, field.gaussians, color_by=selection.scores, style="gaussians")
    viz.look_through(plotter, camera)
    row.append(plotter.screenshot())
    plotter.close()
Image.fromarray(viz.picture_grid([row], list(found), width=width))

# %% [markdown]
# Where gamma comes from: the chairs' cosines form a heap of their own, and gamma lies in the gap below it. A relevancy needs
# no heaps: its gamma is 0.5.

# %%
for selection in found.values():
    viz.plot_scores(selection, out / "scores.png")
    display.display(display.Image(filename=out / "scores.png", width=560))

# %% [markdown]
# ## Things, not a heap of Gaussians
#
# `connected_parts` takes a selection apart: each part has its box, its size and the view that shows it best. How near is
# connected follows from the spacing of the Gaussians; this room's five chairs stand so close that two of them are one part,
# until the first cell says 0.15 (metres here).

# %%
selection = found["relevancy"]
print(
    [one.count for one in kfgs.connected_parts(field.gaussians, selection)], "Gaussians each, with the default distance"
)
things = kfgs.connected_parts(field.gaussians, selection, cameras, distance=apart)
for number, one in enumerate(things, start=1):
    print(f"{thing} {number}: {one!r}")

# %% [markdown]
# In their boxes, from outside; what hides the room is left out of the picture.

# %%
semantic = field.label(classes)
labels = semantic.labels
hidden = torch.tensor([-1, *(classes.index(name) for name in shell if classes.knows(name))])
inside = semantic.select(~torch.isin(labels, hidden))
up = estimate_up(scene.cameras)
orbit = Orbit(frames=1, size=(450, 640), elevation_degrees=50, start_degrees=120, zoom=1.8)
outside = orbit_cameras(inside.means, orbit, up=up)[0]
boxes = [one.box for one in things]
plotter = viz.make_plotter(*outside.size, off_screen=True)
viz.add_cloud(plotter, inside, color_by="label", style="gaussians")
viz.add_boxes(plotter, boxes)
viz.add_names(plotter, boxes, [f"{thing} {i}" for i in range(1, len(boxes) + 1)], up=tuple(up.tolist()))
viz.look_through(plotter, outside)
picture = plotter.screenshot()
plotter.close()
Image.fromarray(picture)

# %% [markdown]
# The first four in the training views that show them best: what is selected, drawn by the rasteriser over the photograph.

# %%
row, titles = [], []
for number, one in enumerate(things[:4]):
    view = cameras[one.best_view.index]
    member = one.selection(len(semantic)).scores[:, None]  # 1 for its Gaussians, 0 for the others
    covered = kfgs.rasterize(semantic.replace(features=member), view).map[..., 0] > 0.5
    photograph = scene.image(scene.views("train")[one.best_view.index])
    row.append(viz.overlay_labels(photograph, torch.where(covered, number, -1)))
    titles.append(f"{thing} {number + 1}, {one.best_view.share:.0%} of {one.best_view.camera}")
Image.fromarray(viz.picture_grid([row], titles, width=width))

# %% [markdown]
# ## The colour scene
#
# An ordinary 3DGS field: spherical harmonics, L1 + D-SSIM, trained without any class. Here it is the one that the features
# were fused onto, before merging; any splat file of the scene will do.

# %%
colors = kfgs.SplatFile(own) if splat_file is None else kfgs.read_splats(splat_file)
print(colors)
print(f"PSNR on unseen views: {kfgs.score_views(colors.gaussians, scene).psnr.value:.1f} dB")
draw = {"background": "black", "color_by": "rgb"}
rendered = viz.show_cloud(colors.gaussians, **draw)(camera)
Image.fromarray(viz.picture_grid([[scene.image(held_out), rendered]], ("unseen view", "colour field"), width=width))

# %% [markdown]
# ## Carried over by distance
#
# A colour Gaussian takes the label of the nearest labelled semantic Gaussian closer than lambda (Sec. 3.4). Without a lambda
# of yours, the spacing of the two clouds decides. Small values leave orphans; large ones give floaters a class. The histogram
# is of a search to ten times lambda, to show the tail beyond it; a few Gaussians have no source even there. The bar at the
# left: Gaussians that are in both clouds, because the field kept them.

# %%
carried = kfgs.transfer_labels(semantic, labels, colors.gaussians)
print(carried)
everything = kfgs.transfer_labels(semantic, labels, colors.gaussians, 10 * carried.distance)
viz.plot_distances(everything.distances, carried.distance, out / "distances.png")
display.Image(filename=out / "distances.png")

# %%
row, titles = [], []
for scale in (0.1, 0.3, 1.0):
    some = kfgs.transfer_labels(semantic, labels, colors.gaussians, scale * carried.distance)
    row.append(viz.show_cloud(colors.gaussians.replace(labels=some.labels))(camera))
    titles.append(f"lambda {some.distance:.2g}: {some.orphaned:,} orphaned")
Image.fromarray(viz.picture_grid([row], titles, width=width))

# %% [markdown]
# Around the first of the things, with a small lambda: destinations are matched, ambiguous (labelled, but their nearest sources
# disagree) or orphaned. They are lifted off their sources, so that the lines to where labels came from have a length.
# Ambiguous ones stand where one thing ends and another begins.

# %%
strict = kfgs.transfer_labels(semantic, labels, colors.gaussians, 0.3 * carried.distance)
radius = float(things[0].box.half.norm())
near = InSphere(things[0].centroid, radius).mask(colors)
sources = semantic.select(InSphere(things[0].centroid, radius).mask(semantic))
shift = 2.2 * radius * up.to(semantic.means)
whole = torch.cat([sources.means, colors.gaussians.means[near] + shift])
side = orbit_cameras(whole, replace(orbit, size=(480, 640), elevation_degrees=15, zoom=1.05), up=up)[0]
plotter = viz.make_plotter(*side.size, off_screen=True)
viz.add_cloud(plotter, sources, options=viz.CloudOptions(point_size=5))
viz.add_matches(
    plotter, semantic, colors.gaussians.select(near), strict.select(near), shift=tuple(shift.tolist()), sample=100
)
viz.look_through(plotter, side)
picture = plotter.screenshot()
plotter.close()
Image.fromarray(picture)

# %% [markdown]
# Distance follows a border only as well as the sparser cloud does. `attach` does all of it in one call and finds the common
# frame if the splat has another one. By default the field segments its training views, and each colour Gaussian takes the class
# of most of the pixels that it fills there, which is sharper. (For a splat in the field's own frame, `kfgs.uplift` gives each
# Gaussian a feature of its own, to be asked like the field.)

# %%
attached = {by: kfgs.attach(field, colors, classes, by=by) for by in ("distance", "views")}
print(*attached["views"].notes[1:], sep="\n")  # the first says how the frames were found to agree
row = [viz.show_cloud(one.splats.gaussians)(camera) for one in attached.values()]
Image.fromarray(viz.picture_grid([row], ("by distance", "by views"), width=width))

# %% [markdown]
# ## Edits
#
# An edit is a value: what to do, and where. A list of them is applied to a copy; the scene itself never changes.

# %%
labelled = attached["views"].splats
edits = kfgs.EditList().then(kfgs.Remove(OfClass(thing))).then(kfgs.Recolor(OfClass(painted), paint))
edited = edits.apply(labelled)
print(f"{len(labelled)} Gaussians, {len(edited)} after {[edit.op for edit in edits]}")
unseen = [scene.cameras[i] for i in scene.views("test")]
views = [unseen[i] for i in views_of_change(labelled.gaussians, edited.gaussians, unseen)]
rows = [[viz.show_cloud(one.gaussians, **draw)(view) for one in (labelled, edited)] for view in views]
Image.fromarray(viz.picture_grid(rows, ("before", f"no {thing}, {painted} in {paint}"), width=width))

# %% [markdown]
# Floor and rug were hardly seen where the chairs stood, and kfgs does not invent them. Questions combine: a box tells one
# chair from the others, and so does being the largest connected part. `undo` and `redo` give lists; the file holds them as text.

# %%
low, high = (corner.tolist() for corner in things[0].extent)
one = kfgs.EditList().then(kfgs.Remove(OfClass(thing) & InBox(low, high)))
largest = Component(OfClass(thing), distance=apart)  # of those that are left: an edit sees what the one before it made
two = one.then(kfgs.Recolor(largest, "teal", allow_empty=True))
print([edit.op for edit in two])
two.save(out / "two.edits.json")
assert kfgs.EditList.load(out / "two.edits.json") == two
assert two.undo().redo() == two
lists = {"before": kfgs.EditList(), "one removed": one, "and one painted": two, "that undone": two.undo()}
row = [viz.show_cloud(some.apply(labelled).gaussians, **draw)(views[0]) for some in lists.values()]
Image.fromarray(viz.picture_grid([row], list(lists), width=width))

# %% [markdown]
# ## Out of kfgs
#
# Any splat viewer opens these; classes travel along (in the file where the format allows it, else beside it). Packed formats
# are smaller and round a little.

# %%
for ending in ("ply", "spz"):
    written = kfgs.write_splats(out / f"edited.{ending}", edited)
    back = kfgs.read_splats(written.paths[0])
    same = float((back.gaussians.labels == edited.gaussians.labels).float().mean())
    pair = [viz.show_cloud(cloud.gaussians, **draw)(camera) / 255 for cloud in (edited, back)]
    error = 10 * torch.tensor(((pair[0] - pair[1]) ** 2).mean()).clamp_min(1e-12).log10()
    size = sum(path.stat().st_size for path in written.paths) / 2**20
    print(f"{ending}: {size:.2f} MiB, {same:.1%} of the labels as they were, the picture agrees to {-error:.0f} dB")

# %% [markdown]
# Next: [6_inspect_in_pyvista](6_inspect_in_pyvista.py) looks at all of this in space.
