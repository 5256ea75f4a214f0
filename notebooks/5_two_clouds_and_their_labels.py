# %% [markdown]
# # 5. Two clouds and their labels
#
# **How do the labels of a semantic field reach a colour splat, and what can I do with them?** You will see both clouds in
# pyvista, with lines that show who gave a label to whom, choose the distance within which labels are carried, and edit the
# room by class. At the end a viewer in a cell and Python share one selection.
#
# About 20 seconds on two CPU cores (50 more to make the toy room and its field the first time). Needs the extra `notebook`,
# no data and no display: without one, pictures are drawn off-screen (Debian: `libegl1 libegl-mesa0 libgl1-mesa-dri`).

# %%
# Your own data: run = "my/run", a folder that `kfgs fit` made; a class to look for and one to paint.
from example import make_run

from kfgs import SemanticField, read_splats, viz

run = make_run()
field = SemanticField.load(run)
splat = read_splats(run / "color.ply")
thing, painted = "chair", "plant"
print(field)
print(splat)

# %% [markdown]
# ## Both clouds, in one line
#
# The field has no colours, and the splat has no classes: the two are decoupled. But they lie in the same place, so a colour
# Gaussian at $p^1$ takes the label of the nearest semantic Gaussian at $p^2$ if it is closer than a distance $\lambda$
# (Sec. 3.4 of the paper):
#
# $$\|p^1 - p^2\| < \lambda$$
#
# `show_transfer` lifts the colour cloud over the semantic one and leaves out walls and ceiling. Each line joins a colour
# Gaussian to the one that gave it its class. Red has no label, and yellow is disputed: another class is nearly as near.
#
# In Jupyter this is live: drag to turn it, move the slider for $\lambda$, and press P over a Gaussian to read its class. In
# a file or on a web page you see a still picture.

# %% tags=["thumbnail"]
viz.show_transfer(field, splat).show()

# %% [markdown]
# ## Lambda
#
# `nearest_labels` is the rule alone, on arrays. The paper gives no value for $\lambda$; kfgs takes it from the spacing of the
# clouds. If it is too small, Gaussians stay without a label (grey).
#
# The last picture shows another way, kfgs's own: the field segments its training views, and each colour Gaussian takes the
# class of most of the pixels that it fills. Its borders are sharper, so `attach` does that by default.

# %%
from PIL import Image

from kfgs import attach, transfer_labels
from kfgs.labels import nearest_labels

semantic = field.label()  # Gaussians with the class of each
near = nearest_labels(semantic.means, semantic.labels, splat.means)
print(f"lambda {near.distance:.3g}: {int((near.labels >= 0).sum()):,} of {len(splat):,} colour Gaussians labelled")
camera = field.cameras[0]
distances = (near.distance / 10, near.distance)
clouds = [transfer_labels(semantic, splat, distance) for distance in distances]
labelled = attach(field, splat).gaussians
titles = [*(f"lambda {distance:.2g}" for distance in distances), "by views"]
row = [viz.show_cloud(cloud)(camera) for cloud in (*clouds, labelled)]
Image.fromarray(viz.picture_grid([row], titles, width=240, names=semantic.names))

# %% [markdown]
# ## pyvista's grammar
#
# `viz.add_*(plotter, ...)` puts one thing into any plotter of pyvista and returns its actor; everything else that pyvista can
# do is yours. A class has the same colour in the cloud, the boxes and the legend. `style="gaussians"` draws what kfgs
# renders and scores, `"points"` is quicker, and `"ellipsoids"` shows shapes.

# %%
from kfgs import OfClass

cameras = field.cameras
parts = field.instances(thing)  # told apart by what the views show
for part in parts:
    print(f"{thing} {part.number}: {len(part.indices)} Gaussians, best seen in {part.best_view.camera}")
wall, ceiling = (OfClass(name).select(semantic) for name in ("wall", "ceiling"))
inside = semantic[~(wall | ceiling)]  # to look into the room
plotter = viz.make_plotter(480, 720)  # pv.Plotter, safe on machines without a display
viz.add_cloud(plotter, inside, style="gaussians")
viz.add_boxes(plotter, parts)
viz.add_cameras(plotter, field, most=8)
viz.add_legend(plotter, inside)
plotter.camera.zoom(1.7)
plotter.show()

# %% [markdown]
# ## What colours mean
#
# `color_by` takes the name of a class, the answer to a question (its scores), features, the splat's own colours, or an array.
# `draw_view` makes the picture of one camera.

# %%
view = camera.resized(2 * camera.height, 2 * camera.width)
shown = {
    f"score of {thing}": (field, field.query(thing)),
    "latents": (field, "feature"),
    "colours": (splat, "view"),
}


def draw(cloud, color_by):
    return viz.draw_view(view, lambda plotter: viz.add_cloud(plotter, cloud, color_by=color_by, style="gaussians"))


pictures = [draw(cloud, color_by) for cloud, color_by in shown.values()]
Image.fromarray(viz.picture_grid([pictures], list(shown), width=240))

# %% [markdown]
# ## Edits
#
# An edit says what to do, and where: a class, a box, a selection. A list of edits is applied to a copy, so the splat itself
# does not change. Floor and rug were hardly seen where the chairs stood: kfgs does not invent them.

# %%
from kfgs import EditList, Recolor, Remove, write_splats

edits = EditList().then(Remove(thing)).then(Recolor(painted, "#c04040"))
edited = edits.apply(labelled)
print(f"{len(labelled):,} Gaussians, {len(edited):,} after {[edit.op for edit in edits]}")
best = cameras[parts[0].best_view.index]
row = [viz.show_cloud(cloud, background="black", color_by="rgb")(best) for cloud in (labelled, edited)]
write_splats(edited, run / "edited.ply")  # any viewer of splats opens it; the classes travel along
Image.fromarray(viz.picture_grid([row], ("before", f"no {thing}, {painted} in red"), width=360))

# %% [markdown]
# ## The viewer, in a cell
#
# Here the browser draws. Turn the scene, type a word, move $\gamma$ and $\lambda$, draw a lasso, edit and undo.

# %% tags=["live"]
from kfgs import explore

viewer = explore(field, splat, cameras=[view, *cameras], where="notebook")
viewer.ask(thing)
viewer

# %% [markdown]
# What you do there is a value here, and the other way round: `selection`, `gamma`, `distance`, `hidden`, `camera`, `edits` and
# `picked` can be read, set and observed. Select something with the lasso (key 3), then run this cell.

# %%
chosen = splat[viewer.selection]
print(f"{viewer.selection.how}: {len(chosen):,} Gaussians, at {chosen.means.mean(dim=0)}")
viewer.gamma = 0.8  # moves the slider; only what is surest stays selected
print(f"gamma {viewer.gamma}: {len(viewer.selection):,}")

# %% [markdown]
# `viewer.save_html("room.html")` writes one file that opens in any browser, and `kfgs view run/` opens the same viewer from a
# shell. The how-to "In pyvista and in Jupyter" of the documentation has more.
#
# Next: [6_your_own_photos](6_your_own_photos.ipynb) starts from photographs alone.
