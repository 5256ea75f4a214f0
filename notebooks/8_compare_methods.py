# %% [markdown]
# # 8. Compare methods
#
# **Which method should I take?** Three ways to make a field from the same maps of the same teacher: kfgs's own (`fuse`), the
# paper's (codebook, autoencoder, training), and training without any compression. The teacher itself takes part too. You
# will see one table of scores, the mistakes of each in pictures, and quality against size.
#
# About 50 seconds on two CPU cores (20 more to make the toy room the first time), 10 afterwards. Needs the extra
# `notebook`, no data.

# %%
# Your own data: a scene with label pictures in labels/, a teacher's maps, the classes, and a folder for the three runs.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.evaluation import TeacherMethod, label_view
from kfgs.pipeline import evaluate, open_question

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
maps = kfgs.FeatureFolder(features).of(scene, "train")

# %% [markdown]
# ## Three methods
#
# - **fused**: features are averaged onto sharp Gaussians; then 512 channels become a few latents (notebook 4).
# - **paper**: a pixel's feature becomes a codeword, and a codeword 9 latents (notebook 3). Gaussians are trained until the
#   maps that they show, $\mathbf{F}_r$, equal the maps of latents $\mathbf{F}_l$ (Eq. 4):
#   $\mathcal{L}_f = \|\mathbf{F}_l - \mathbf{F}_r\|_1$
# - **raw**: the same training with all 512 channels, which the paper calls *just decouple*.
#
# The two that are trained get about the same time, not the same number of steps: that is the use of compression. All
# schedules are short, so that you need not wait. `Paper.paper()` is the published one, with 30,000 steps.

# %%
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
trained = {"codebook": kfgs.GrownCodebook(), "autoencoder": kfgs.AutoencoderConfig(steps=500)}
methods = {
    "fused": kfgs.Uplift(color=quick),
    "paper": kfgs.Paper(**trained, training=kfgs.Training.cpu().with_steps(400)),
    "raw": kfgs.Paper(None, None, replace(kfgs.Training.cpu(), render_scale=1.0).with_steps(60)),
}
runs = {"fused": data / "run", "paper": data / "run_paper", "raw": data / "run_raw"}
fields = {}
for name, method in methods.items():
    fields[name] = kfgs.fit(scene, maps, method, folder=runs[name])
    stages = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in fields[name].info["seconds"].items())
    print(f"{name:6s} {fields[name].latents.shape[1]:3d} channels, {len(fields[name]):6,} Gaussians; {stages}")

# %% [markdown]
# ## One question for all
#
# Numbers can be compared only if they answer the same question. `open_question` fixes it: a *protocol*, which says what is
# counted, the views, and the truth. Then each method is scored, and the teacher like one of them. (Its maps are enlarged
# before classes are chosen; in notebook 4 it is the other way round, so the number differs a little.) The table uses the
# names of the paper's Table 1: *decouple+ADC+SC* is **paper**, and *just decouple* is **raw**.

# %%
question = open_question(folder, "kfgs-pooled/1")
asked = {**fields, "teacher": features}
reports = {name: evaluate(result, question, encode=classes) for name, result in asked.items()}
for name, report in sorted(reports.items(), key=lambda pair: -pair[1].value):
    print(f"{name:8s} {report}")
print(report.about)

# %% [markdown]
# In a shell, `kfgs evaluate run/` gives such a report. `benchmarks/protocols.py` compares results of other programs, too.
#
# ## What each gets wrong
#
# A mistake has the colour of the class that was said; all else is grey. The teacher's are whole patches, in other places in
# every view. A method that compresses each map, before views are compared, keeps some of them. The fused field has outvoted
# most.

# %% tags=["thumbnail"]
view = question.views[-1]
truth, photo = question.truth.maps[view.stem], scene.image(scene.splits["test"][-1])
labels = {name: field.segment(view.camera, classes) for name, field in fields.items()}
labels["teacher"] = label_view(TeacherMethod(kfgs.FeatureFolder(features)), view, classes.embeddings)
pictures = {}
for name, found in labels.items():
    share = ((found != truth) & (truth >= 0)).float().mean()
    mistakes = found.where(found != truth, -1)  # a mistake has the colour of the wrong class
    pictures[f"{name}: {share:.1%} wrong"] = viz.overlay_labels(photo, mistakes, classes.names, legend=False)
Image.fromarray(viz.picture_grid([[*pictures.values()]], [*pictures], width=320))

# %% [markdown]
# ## Quality and size
#
# The size counts all numbers of the Gaussians and what decodes their features, as Table 1 of the paper does. The teacher's
# maps are listed for comparison: they show only the views that they were made for, and nobody can walk around in them.
# In the paper, with long training on real scenes, *just decouple* reaches 73.5 mIoU with 59.4 MB in 263 minutes, and the
# compressed field 76.6 mIoU with 13.0 MB in 8 minutes.

# %%
sizes = [field.storage() for field in fields.values()] + [len(scene) * maps[0].numel() * 2]
points = {name: (size / 2**20, reports[name].value) for name, size in zip(reports, sizes, strict=True)}
figure, axes = plt.subplots(figsize=(7, 4))
for name, (mib, miou) in points.items():
    axes.scatter(mib, 100 * miou)
    axes.annotate(name, (mib, 100 * miou), (8, 0), textcoords="offset points", va="center")
axes.set(xscale="log", xlabel="storage in MiB", ylabel="mIoU in %", title="quality and size")
axes.margins(x=0.2)
axes.grid(alpha=0.3, which="both")
plt.show()

# %% [markdown]
# Take *fused* if you have, or can train, sharp Gaussians of the scene. Take the paper's method to compare with the paper, or
# if Gaussians shall be trained on the features alone. `docs/results.md` has both on real scenes.
#
# Next: [9_query_by_example](9_query_by_example.ipynb) asks without words.
