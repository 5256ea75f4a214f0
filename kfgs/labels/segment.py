"""Novel-view segmentation: turn a rendered latent map into one class per pixel (Sec. 3.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from .._check import check_choice, check_range, check_shapes
from .._rows import EPS, row_norms
from .._typed import typed
from ..quant.codebook import Codebook
from ..splat.engines.table import choose, load, offers
from .classify import CodewordLabels, classify

if TYPE_CHECKING:  # only a type here: any object with its encode and decode works
    from ..quant.autoencoder import Autoencoder

Decode = Literal["exact", "latent"]

Layers = tuple[tuple[Tensor, Tensor], ...]  # weight [out, in], bias [out] of each

LEAD = 1e-4
"""Of the best codeword's score. Sums of a decoder's 1,000 products in another order differ by about 1e-6 of it (float32); where
codewords of two classes are nearer to each other, the plain computation decides."""


@typed
def label_pixels(
    latent_map: Tensor,  # [..., d], usually [H, W, d]
    codebook: Codebook | None,
    codeword_labels: CodewordLabels | Tensor | None,  # [K]
    autoencoder: Autoencoder | None = None,
    *,
    decode: Decode = "exact",
    embeddings: Tensor | None = None,  # [C, D]
    covered: Tensor | None = None,  # [...] bool
    chunk: int = 8192,
) -> Tensor:  # [...] int64
    """Label each rendered latent: decode it (Psi), quantise it by cosine to the codebook (Eq. 5), look up its class.

    `decode="exact"` is the paper's method and the reference. `decode="latent"` takes the codeword with the nearest
    **latent** (Euclidean): it saves the decoder's 0.83 M multiply-adds per pixel, and gives the same class for 98.9 % of
    pixels that mixed two latents (72 codewords). Without an autoencoder the map holds features, which
    are quantised directly. Without a codebook each decoded feature takes the class of the most similar of `embeddings`.

    Args:
        latent_map: a rendered map [H, W, d], or the latents of N Gaussians [N, d].
        codebook: S, or None.
        codeword_labels: from `label_codewords`, or labels [K]; not used without a codebook.
        autoencoder: the scene's autoencoder, or None.
        decode: see above.
        embeddings: class embeddings; used only without a codebook.
        covered: pixels that show something, for instance `alpha > 0.5`; the others get label -1.
        chunk: latents decoded at once; the decoder's widest layer holds chunk x 1024 numbers (32 MB by default).

    Returns:
        Labels on the map's device, -1 = none. All-zero features have none; an all-zero latent is a normal value.

    Raises:
        ValueError: if shapes disagree, `codeword_labels` or `embeddings` is missing, or `decode` is unknown.
    """
    check_choice("decode", decode, ("exact", "latent"))
    check_range("chunk", chunk, 1)
    shape = latent_map.shape[:-1]
    if covered is not None and covered.shape != shape:
        raise ValueError(f"covered: expected a mask {tuple(shape)} (from latent_map), got {tuple(covered.shape)}")
    rows = latent_map.detach().reshape(-1, latent_map.shape[-1])
    labels = torch.full((len(rows),), -1, dtype=torch.int64, device=rows.device)
    which = torch.arange(len(rows), device=rows.device) if covered is None else covered.reshape(-1).nonzero()[:, 0]
    with torch.no_grad():
        if codebook is None:
            if embeddings is None:
                raise ValueError(
                    "embeddings: expected [C, D] because there is no codebook, got None; pass class embeddings"
                )
            for part in which.split(chunk):
                labels[part] = classify(_decoded(rows[part], autoencoder), embeddings).labels
            return labels.reshape(shape)
        table = _table(codebook, codeword_labels).to(rows.device)
        centres = None
        if autoencoder is not None and decode == "latent":
            centres = autoencoder.encode(codebook.codewords).to(rows)
        layers = None if autoencoder is None else _score_layers(rows, codebook, autoencoder, centres)
        if layers is not None:
            labels[which], unsure = _decide(rows[which], table, layers)
            which = which[unsure]
        for part in which.split(chunk):
            if centres is not None:
                labels[part] = table[nearest_codeword(rows[part], centres)]
            else:
                features = _decoded(rows[part], autoencoder)
                found = table[codebook.quantize(features)]
                labels[part] = found.masked_fill(row_norms(features) <= EPS, -1)
    return labels.reshape(shape)


def _score_layers(
    rows: Tensor,  # [n, d]
    codebook: Codebook,
    autoencoder: Autoencoder,
    centres: Tensor | None,  # [K, d] the codewords' latents, if the nearest of them is wanted
) -> Layers | None:
    """Linear layers whose largest output is the codeword of a latent; None if no engine evaluates them for these rows.

    With a decoder W h + b and unit codewords C, argmax over C (W h + b) / |W h + b| is argmax over (C W) h + C b: one layer
    in place of the last one and of the comparison. The nearest latent is argmax over 2 c·x - |c|^2. The constant that is
    added makes the largest output positive for latents like the codewords'; for others the plain computation decides.
    """
    if rows.dtype not in (torch.float32, torch.float64) or not offers(_engine(rows), "decide"):
        return None
    if centres is not None:
        squares = centres.square().sum(dim=-1)
        return ((2 * centres, 2 * squares.max() - squares),)
    decoder = getattr(autoencoder, "decoder", ())
    layers = [(layer.weight.detach(), layer.bias.detach()) for layer in decoder]
    if not layers or layers[0][0].dtype != rows.dtype:
        return None
    weight, bias = layers[-1]
    unit = codebook.unit.to(rows)
    return *layers[:-1], (unit @ weight, unit @ bias)


def _decide(rows: Tensor, table: Tensor, layers: Layers) -> tuple[Tensor, Tensor]:
    """Labels of latents [n] int64, and which of them are not sure, [n] bool.

    Sums in another order differ by rounding. So labels are sure only where the best codeword leads those of other classes by
    more than LEAD.
    """
    winners, leads = load(_engine(rows)).decide(layers, table, rows)
    return table[winners], ~(leads > LEAD)


def _engine(rows: Tensor) -> str:
    return choose("auto", rows.device.type, rows.dtype)


@typed
def nearest_codeword(
    latents: Tensor,  # [N, d]
    centres: Tensor,  # [K, d]
) -> Tensor:  # [N] int64
    """The codeword whose latent is nearest, argmin_k |x - c_k|^2 = argmin_k |c_k|^2 - 2 x.c_k; ties go to the lowest.

    One matrix product of [N, d] by [d, K]: the sum without |x|^2 loses no accuracy that d <= 16 latents in [0, 1] need.
    """
    check_shapes(("latents", latents, "N d"), ("centres", centres, "K d"))
    return torch.addmm((centres * centres).sum(dim=-1), latents, centres.T, alpha=-2).argmin(dim=-1)


def _decoded(latents: Tensor, autoencoder: Autoencoder | None) -> Tensor:
    return latents if autoencoder is None else autoencoder.decode(latents)


def _table(codebook: Codebook, codeword_labels: CodewordLabels | Tensor | None) -> Tensor:
    if codeword_labels is None:
        raise ValueError(
            f"codeword_labels: expected labels [{len(codebook.codewords)}] of the codebook, got None; call label_codewords"
        )
    table = codeword_labels.labels if isinstance(codeword_labels, CodewordLabels) else codeword_labels
    check_shapes(("codebook.codewords", codebook.codewords, "K D"), ("codeword_labels", table, "K"))
    return table.to(torch.int64)
