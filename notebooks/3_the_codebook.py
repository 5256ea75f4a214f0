# %% [markdown]
# # 3. The codebook
#
# **Why can 512 numbers per pixel become 9, and the meaning stay?** This is the paper's compression (Sec. 3.3). A scene
# contains only some dozens of things, so the features of all pixels are copies, with noise, of a few *codewords*. A
# codebook of them grows until it covers the scene. Then an autoencoder makes 9 numbers of each. You will see the
# book grow (as in Figure 6 of the paper), the words that its codewords mean, and how many bytes are left.
#
# About 20 seconds on two CPU cores (20 more to make the toy room the first time). Needs the extra
# `notebook`, no data.

# %%
# Your own data: a scene, its feature maps as `kfgs features` writes them, and the teacher's words (`kfgs features --words`).
from example import DATA, make_room

from kfgs import FeatureFolder, load_label_set, load_scene

folder = make_room()  # yours: folder = Path("my/scene")
scene = load_scene(folder).undistorted()
train = scene.views("train")
maps = FeatureFolder(folder / "features").of(scene, "train")
words = load_label_set(folder / "classes.json", folder / "text.npy")  # yours: load_label_set("words.safetensors")
pictures = DATA / "pictures"
pictures.mkdir(exist_ok=True)

# %% [markdown]
# ## Growth
#
# The codebook $S$ starts with 8 features of the first image that are as different as possible. Then, for each image:
#
# - Each feature finds its nearest codeword: $t = \operatorname{argmax}_{e \le K} \cos(f_{raw}, f_e)$ (Eq. 5).
# - Features that no codeword is similar to join the book:
#   $S = S \cup \{\mathbf{F}_{i,j}\}$ if $\cos(\mathbf{F}_{i,j}, \hat{\mathbf{F}}_{i,j}) < \alpha$ (Eq. 8).
# - The codewords take a step towards their features. Each class $\tau$ counts the same, however many pixels $N_\tau$ it
#   has: $\mathcal{L}_q = \frac{1}{T} \sum_{\tau} \frac{1}{N_\tau} \sum_{i,j}
#   (1 - \cos(\mathbf{F}_{i,j}, \hat{\mathbf{F}}_{i,j})) \, \delta(M_{i,j}, \tau)$ (Eq. 6).
# - Of two codewords that are nearly equal, one goes: $S = S \setminus \{f_g\}$ if $\cos(f_e, f_g) > \beta$ (Eq. 9).
#
# How large the book becomes depends on the scene and on $\alpha$. We try two values. At most one feature of an image joins
# here, so that the growth can be watched.

# %%
from IPython.display import Image as Shown

from kfgs import PaperCodebook, fit_codebook
from kfgs.viz import plot_history

books = {}
for alpha in (0.9, 0.7):
    config = PaperCodebook(epochs=4, step_every=2, joins_per_image=1, expand_below=alpha)
    books[f"alpha = {alpha}"] = fit_codebook(maps, config)
drawn = ("epoch", "size", "added", "coverage", "mean_similarity")
history = {name: [{key: row[key] for key in drawn} for row in book.report.history] for name, book in books.items()}
plot_history(history, pictures / "growth.png")
Shown(pictures / "growth.png", width=720)

# %% [markdown]
# *Coverage* is the share of features whose similarity to their codeword is at least $\alpha$. With $\alpha = 0.9$, the
# paper's value, this book grows to the limit of 100 and still covers little: this teacher is so noisy that new codewords
# only copy its noise. The mean similarity hardly differs between the two books. By default
# (`fit_codebook(maps)`), kfgs needs no $\alpha$: it splits the features of a codeword in two while both halves come clearly
# nearer to their codewords.

# %%
for name, book in books.items():
    print(
        f"{name}: K = {book.size:3d}, coverage {book.report.coverage:.3f}, mean similarity {book.report.mean_similarity:.3f}"
    )
codebook = books["alpha = 0.7"]

# %% [markdown]
# ## What the codewords mean
#
# The matrix shows how similar the codewords are, ordered by their nearest word. Most words have one large codeword. The small
# ones next to it are borders between two things: their two nearest words fit nearly equally well, as the list of the rarest
# codewords shows.

# %%
import matplotlib.pyplot as plt
from torch.nn.functional import normalize

cosines, usage = normalize(codebook.codewords) @ normalize(words.embeddings).T, codebook.report.usage
classes = cosines.argmax(dim=1)  # the nearest word of each codeword (Sec. 3.4)
rows = classes.argsort(stable=True)
plt.imshow(codebook.similarity(codebook.codewords)[rows][:, rows], cmap="cividis", interpolation="nearest")
plt.yticks(range(len(rows)), [words.names[label] for label in classes[rows]], fontsize=6)
plt.colorbar(label="cosine")
plt.title("similarity of the codewords")
plt.show()
for row in usage.argsort()[:6].tolist():
    nearest = cosines[row].topk(2)
    two = [f"{words.names[i]} {value:.2f}" for value, i in zip(nearest.values, nearest.indices, strict=True)]
    print(f"codeword {row:3d}: {int(usage[row]):6d} features, {', '.join(two)}")

# %% [markdown]
# ## Index maps
#
# Now one number per pixel is enough: the number of its codeword, the map $M$ of Eq. 5. You see the teacher's map, then the
# codewords that stand for it in the same colours, then the class of each codeword. The noise is gone and the borders are
# kept. Patches where the teacher is wrong are kept as well, because no view was compared with another one yet.

# %% tags=["thumbnail"]
import torch
from PIL import Image

from kfgs import quantize_maps
from kfgs.viz import FeatureColors, palette, picture_grid

index_maps = quantize_maps(maps, codebook)
colors = FeatureColors.fit(codebook.codewords)

rows = []
for i in (0, 2 * len(maps) // 3):
    index = torch.from_numpy(index_maps[i]).long().clamp_max(codebook.size - 1)  # K where the teacher says nothing
    rows.append([colors(maps[i]), colors(codebook.codewords)[index], palette(classes, words.names)[index]])
titles = ["the teacher", "its codewords", "their classes"]
Image.fromarray(picture_grid(rows, titles, width=240, names=words.names))

# %% [markdown]
# ## From 512 channels to 9
#
# An encoder $E$ makes 9 numbers, the *latent*, of a codeword, and a decoder $\Psi$ makes the codeword of them again. Both
# are trained on this scene's codewords only (Eq. 10):
#
# $$\mathcal{L}_{ae} = \|\Psi(E(f_e)) - f_e\|_2$$
#
# No meaning is lost if each decoded latent is still nearest to its own codeword: `recovered` is the share for which that
# is so. In the picture a clean diagonal says the same. The paper takes 5,000 steps; 800 are enough here.

# %%
from kfgs import AutoencoderConfig, fit_autoencoder

autoencoder = fit_autoencoder(codebook, AutoencoderConfig(steps=800))
latents = autoencoder.encode(codebook.codewords)
decoded = autoencoder.decode(latents)
print(f"{codebook.dim} -> {autoencoder.latent} channels, recovered {autoencoder.report.recovered:.0%}")
order = classes.argsort(stable=True)
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.6), layout="constrained", width_ratios=(1, 2))
first = left.imshow(latents[order], cmap="cividis", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
left.set(title="latents", xlabel="channel", ylabel="codeword")
second = right.imshow(codebook.similarity(decoded)[order][:, order], cmap="cividis", interpolation="nearest")
right.set(title="decoded against original", xlabel="codeword", ylabel="decoded")
figure.colorbar(first, ax=left)
figure.colorbar(second, ax=right, label="cosine")
plt.show()

# %% [markdown]
# ## Bytes
#
# What is left to learn from: a byte per pixel, the codebook and the decoder. A map of latents is looked up when it is
# needed: $\mathbf{F}_l = S'[M]$ (Sec. 3.3.2), where $S'$ is the codebook of latents.
#
# The decoder is larger than this codebook, so why nine channels? Because of what comes next: each Gaussian carries and trains
# them, and each rendered pixel blends them. A blend of two latents is in no codebook, and the decoder says which feature it is.

# %%
from kfgs.quant import LatentMaps

latent_maps = LatentMaps(index_maps, latents)
before = len(maps) * 2 * torch.tensor(maps.shape).prod().item()  # in half precision
sizes = {
    "index maps": sum(index.nbytes for index in index_maps),
    "codebook": 4 * codebook.codewords.numel(),
    "decoder": 4 * autoencoder.decoder_parameters,
}
for name, size in {"the teacher's maps": before, **sizes}.items():
    print(f"{name:20s}{size / 1e6:8.2f} MB")
print(f"{before / sum(sizes.values()):.0f} times less; a map to learn is {tuple(latent_maps[0].shape)}")

# %% [markdown]
# Next: [4_a_field](4_a_field.ipynb) makes a field of such maps.
