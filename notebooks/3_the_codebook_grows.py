# %% [markdown]
# # 3. The codebook grows
#
# Hierarchical compression (Sec. 3.3). Every pixel of every map has hundreds of channels, but a scene means only a few
# dozen things: a codebook of codewords grows until it covers them, maps shrink to one byte per pixel, and an
# autoencoder takes a codeword from 512 channels to 9. You will see the growth (as in Figure 6), the codewords with
# their nearest words, the index maps beside the teacher's, and what is left in bytes.
#
# About 25 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra
# `notebook`, no data.

# %%
# Your own data: a scene, its feature maps as `kfgs features` writes them, and the teacher's words (`kfgs text`).
import os
from pathlib import Path

from kfgs import FeatureFolder, load_label_set, load_scene
from kfgs.toy import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))
scene = load_scene(folder)  # yours: load_scene("my/scene").undistorted()
train = scene.views("train")
maps = FeatureFolder(folder / "features").of(scene, "train")
words = load_label_set(folder / "classes.json", folder / "text.npy")  # yours: load_label_set("words.safetensors")
pictures = data / "pictures"
pictures.mkdir(exist_ok=True)

# %% [markdown]
# ## Growth
#
# This is the paper's method, `CodebookConfig.paper()`; the last part of this section is what kfgs does by default.
#
# The codebook starts with 8 features that are as different as possible. Then, image by image: quantise (Eq. 5), let the
# features join whose similarity to their codeword is below alpha (Eq. 8), take a step on the class-balanced loss (Eq.
# 6-7), and drop the later of two codewords more similar than beta (Eq. 9; none is dropped here). At most one feature of
# an image joins here, so that growth can be watched. How large the book becomes depends on the scene and on alpha.

# %%
from IPython.display import Image as Shown

from kfgs import CodebookConfig, fit_codebook
from kfgs.viz import plot_codebook_growth

fits = {}
for alpha in (0.9, 0.75, 0.7):
    config = CodebookConfig.paper(epochs=6, step_every=2, joins_per_image=1, expand_below=alpha)
    fits[f"alpha = {alpha}"] = fit_codebook(maps, config)
plot_codebook_growth({name: fit.history for name, fit in fits.items()}, pictures / "growth.png")
Shown(pictures / "growth.png", width=900)

# %% [markdown]
# Coverage says how many features are at least alpha-similar to their codeword. A book that is full (K_max = 100) and
# yet covers little asks for more than the teacher's noise allows: new codewords then only copy noise. The mean
# similarity shows it: it stays at 0.90 from 24 codewords to 100.

# %%
for name, fit in fits.items():
    print(f"{name}: K = {fit.codebook.size:3d}, coverage {fit.coverage:.3f}, mean similarity {fit.mean_similarity:.3f}")
fit = fits["alpha = 0.7"]
codebook = fit.codebook

# %% [markdown]
# By default nothing has to be chosen: a codeword's features are split in two as long as that brings them clearly nearer
# to their codeword, which halves of mere noise are not. The similarity that 90 % of the features reach is a result.

# %%
by_default = fit_codebook(maps)
print(
    f"default: K = {by_default.codebook.size}, alpha {by_default.alpha:.2f}, mean similarity {by_default.mean_similarity:.3f}"
)

# %% [markdown]
# ## What the codewords mean
#
# Rows are codewords, ordered by their nearest word. Bars count the features of each, on a logarithmic axis: most words
# have one codeword that nearly all of their features belong to. The small ones beside it are borders between two
# things; their two nearest words have nearly the same cosine. No two are much alike, since a feature joins only where
# nothing in the book is similar to it.

# %%
from kfgs.viz import plot_codebook_report

plot_codebook_report(codebook.codewords, words.names, words.embeddings, pictures / "codebook.png", usage=fit.usage)
Shown(pictures / "codebook.png", width=900)

# %% [markdown]
# ## Index maps
#
# `quantize_maps` leaves one number per pixel (M in Eq. 5). Beside each picture the teacher's map, then the codewords
# that stand for it, in the same colours, then the class of each codeword, coloured as above: noise is gone, borders
# stay, and so do patches where the teacher is wrong: no view has been compared with another yet. That is the field's
# work (notebook 4).

# %%
import torch
from PIL import Image

from kfgs import quantize_maps
from kfgs.labels import label_codewords
from kfgs.viz import FeatureColors, palette, picture_grid

index_maps = quantize_maps(maps, codebook)
colors = FeatureColors.fit(codebook.codewords)
classes = label_codewords(codebook.codewords, words.embeddings).labels

rows = []
for i in (0, 2 * len(maps) // 3):
    index = torch.from_numpy(index_maps[i]).long().clamp_max(codebook.size - 1)  # K where the teacher says nothing
    rows.append([scene.image(train[i]), colors(maps[i]), colors(codebook.codewords)[index], palette(classes)[index]])
titles = ["photograph", "the teacher", "its codewords", "their classes"]
Image.fromarray(picture_grid(rows, titles, width=min(scene.cameras[0].width, 320)))

# %% [markdown]
# How similar a pixel's feature is to its codeword, over every fourth map: the codebook's error is the teacher's noise.

# %%
import matplotlib.pyplot as plt

similarity = torch.cat([codebook.nearest(maps[i].flatten(0, 1)).similarity for i in range(0, len(maps), 4)])
figure, axes = plt.subplots(figsize=(6.5, 2.6), layout="constrained")
axes.hist(similarity.numpy(), bins=80, range=(0.65, 1), color="#0072b2")
axes.axvline(0.7, color="black", linestyle="--", label="alpha")
axes.set(xlabel="cosine of a feature and its codeword", ylabel="features")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## From 512 channels to 9
#
# The scene's autoencoder (Eq. 10) learns nothing but these codewords. What counts is that a decoded latent is still
# nearest to its own codeword, so that no meaning is lost: `recovered` is the share of codewords for which this holds.
# The paper takes 5,000 steps; 1,000 are enough for these codewords.

# %%
from kfgs import AutoencoderConfig, fit_autoencoder
from kfgs.viz import plot_training

squeezed = fit_autoencoder(codebook, AutoencoderConfig(steps=1_000, record_every=25))
decoded = squeezed.autoencoder.decode(squeezed.latents)
cosine = torch.nn.functional.cosine_similarity(decoded, codebook.codewords)
print(f"{codebook.dim} -> {squeezed.autoencoder.latent} channels, recovered {squeezed.recovered:.0%}")
print(f"cosine of decoded codewords: mean {cosine.mean():.3f}, worst {cosine.min():.3f}")
print(f"two latents are at least {squeezed.min_latent_distance:.2f} apart")
plot_training(squeezed.history, pictures / "autoencoder.png")
Shown(pictures / "autoencoder.png", width=420)

# %% [markdown]
# The latents S' themselves, one row per codeword in order of its class, and how similar the decoded codewords are to
# all originals: a clean diagonal means that none is taken for another.

# %%
order = classes.argsort(stable=True)
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.6), layout="constrained", width_ratios=(1, 2))
first = left.imshow(squeezed.latents[order], cmap="cividis", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
left.set(title="latents", xlabel="channel", ylabel="codeword")
second = right.imshow(codebook.similarity(decoded)[order][:, order], cmap="cividis", interpolation="nearest")
right.set(title="decoded against original", xlabel="codeword", ylabel="decoded")
figure.colorbar(first, ax=left)
figure.colorbar(second, ax=right, label="cosine")
plt.show()

# %% [markdown]
# ## Bytes
#
# What the field learns from is now the index maps, the codebook and the decoder: `LatentMaps` looks a map of latents up
# when it is asked for (F_l = S'[M], Sec. 3.3.2).

# %%
from kfgs.quant import LatentMaps

latent_maps = LatentMaps(index_maps, squeezed.latents)
before = len(maps) * 2 * torch.tensor(maps.shape).prod().item()  # in half precision
sizes = {
    "index maps": index_maps.nbytes,
    "codebook": 4 * codebook.codewords.numel(),
    "decoder": 4 * squeezed.autoencoder.decoder_parameters,
}
for name, size in {"the teacher's maps": before, **sizes}.items():
    print(f"{name:20s}{size / 1e6:8.2f} MB")
print(f"{before / sum(sizes.values()):.0f} times less; a map to learn is {tuple(latent_maps[0].shape)}")

# %% [markdown]
# Next: [4_a_semantic_field_from_start_to_end](4_a_semantic_field_from_start_to_end.py) trains the field on these maps.
