# %% [markdown]
# # 4. A field
#
# **Can a field be better than the teacher it learns from?** A teacher says, with many mistakes, what is where in each
# photograph. Here its maps become some 35,000 Gaussians that answer from any viewpoint, and you will see that they are
# right more often than the teacher. It takes three steps: Gaussians with colours, the teacher's maps carried onto them,
# and classes for pictures that no step has seen. At the end you ask it where the chairs are.
#
# About 35 seconds on two CPU cores (20 more to make the toy room the first time), 15 afterwards. Needs the extra
# `notebook`, no data: kfgs makes the room, its photographs and a simulated teacher.

# %%
# Your own data: a scene, its teacher's maps (`kfgs features my/scene --teacher lseg ...` writes such a folder) and classes;
# label pictures `<stem>.png` of its views to score against, and a folder for what is made.
from example import DATA, QUICK, make_room

folder = make_room()  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
labels, run, word = folder / "labels", DATA / "run", "chair"

# %% [markdown]
# ## What goes in
#
# Photographs with cameras, and for each of them a map of 512 channels from the teacher. Similar things have similar
# colours in the second row. Edges are blurred, and some patches are wrong.

# %%
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
# numbers become a few *latents* $z_i$ with $f_i \approx B z_i$. Only the Gaussians are trained, no feature is. The paper
# trains the features too, on the maps of notebook 3: `kfgs.fit(scene, maps, kfgs.Paper())`.
#
# `QUICK` is a short schedule for this small room. For a scene of yours, leave it out: `kfgs.fit(scene, maps, folder=run)`. If
# you have a splat already, `kfgs.Uplift(splat="my.ply")` takes it.

# %%
field = kfgs.fit(scene, maps, kfgs.Uplift(color=QUICK), folder=run, report=print)
print(field)

# %% [markdown]
# ## What is seen from a new viewpoint
#
# Nobody trained on this view. The colours come from the first step, the features from the second. Compare the lower
# two pictures: the field has finer borders than the teacher, which sees this very photograph.

# %%
k = 2
camera, image = scene.cameras[test[k]], scene.image(test[k])
test_maps = kfgs.FeatureFolder(features).of(scene, "test")
colored = kfgs.read_splats(run / "color.ply")
print(f"{len(colored):,} Gaussians, PSNR on unseen views: {kfgs.score_views(colored, scene).psnr.value:.1f} dB")
drawn = viz.show_cloud(colored, background="black", color_by="rgb")(camera)
rows = [[image, drawn], [colors(unit(test_maps[k])), colors(unit(field.feature_map(camera)))]]
Image.fromarray(viz.picture_grid(rows, ("a photograph and its teacher's map", "drawn from Gaussians"), width=360))

# %% [markdown]
# ## Classes
#
# A class is a text, and a text has a feature too, in the same space. Each Gaussian shares one vote among the classes whose
# texts $t_c$ its feature is similar to, $\cos(f_i, t_c)$. A pixel blends the votes of its Gaussians like colours, and the
# largest sum wins. `segment_scene` does so for all unseen views.

# %% tags=["thumbnail"]
truth = true_labels(scene, labels, "test")
predicted = kfgs.segment_scene(field, scene, classes, run / "segmentation", truth=truth)
rows = []
for i in (test[1], test[5]):
    pictures = [viz.palette(answer[scene.stem(i)], classes.names) for answer in (truth, predicted)]
    rows.append([scene.image(i), *pictures])
Image.fromarray(viz.picture_grid(rows, ("unseen photograph", "truth", "the field"), width=240, names=classes.names))

# %% [markdown]
# ## How good it is
#
# The score of a class is its *intersection over union*: of all pixels that are of the class, or said to be, the share that
# is both. The mean over the classes is the mIoU. Diamonds mark the teacher. Its mistakes differ from view to view, so
# what many views agree on is better than what each of them says. Thin things, like the stand of the lamp, suffer most.

# %%
stems = list(truth)
scores = kfgs.score_scene(predicted, truth, classes)
teacher = score_teacher(lambda stem: test_maps[stems.index(stem)], truth, classes, camera.size)
print(f"mIoU on unseen views: field {scores.miou.value:.3f}, teacher {teacher.miou.value:.3f}")
viz.plot_iou(scores.iou, classes.names, run / "iou.png", reference=teacher.iou, reference_name="teacher")
Shown(run / "iou.png", width=700)

# %% [markdown]
# ## "Where is the chair?"
#
# The cosine $\cos(f_i, t)$ says how well Gaussian $i$ fits the text $t$, and those above a threshold $\gamma$ are selected
# (Sec. 3.4). The paper gives no value for $\gamma$. With the cosine alone, kfgs looks for a gap between the scores: the
# chairs are a hill of their own. By default it compares the text with the other classes: the *relevancy* is the share of
# the text against the class that comes closest, and $\gamma = 0.5$ means "as much like the chair as like something else".

# %%
answers = {"cosine": field.query(word, classes, score="cosine"), "relevancy": field.query(word, classes)}
for name, selection in answers.items():
    print(f"{name:<10} {len(selection):5d} Gaussians, gamma {selection.threshold:.3f}: {selection.how}")
viz.plot_scores(answers["cosine"], run / "scores.png")
Shown(run / "scores.png", width=560)

# %% [markdown]
# How many chairs are that? `field.instances` tells the things of a class apart, by what the training views show: two chairs
# that touch are two pieces in most pictures. Each has a box, and the view that shows it best.

# %%
parts = field.instances(word)
for part in parts:
    print(f"{word} {part.number}: {part!r}")


def draw(plotter):
    viz.add_cloud(plotter, field, style="gaussians")  # in the colours of its classes
    viz.add_boxes(plotter, parts)


Image.fromarray(viz.draw_view(scene.cameras[0].resized(480, 640), draw))

# %% [markdown]
# ## Save and load
#
# `fit` has saved the field already, as `field.kfgs` in the run folder: Gaussians, latents, the decoder $B$, the training
# cameras, and how they came about. What is loaded answers exactly as before.

# %%
again = kfgs.SemanticField.load(run / "field.kfgs")
assert torch.equal(again.segment(camera, classes), predicted[scene.stem(test[k])])
size = (run / "field.kfgs").stat().st_size / 2**20
maps_size = len(maps) * maps[0].numel() * 2 / 2**20
print(f"the field: {size:.1f} MiB; the teacher's maps that it was made of: {maps_size:.0f} MiB")

# %% [markdown]
# Next: [5_two_clouds_and_their_labels](5_two_clouds_and_their_labels.ipynb) carries the labels of this field over to a colour
# splat, in space.
