"""The finished semantic field: Gaussians with latents, and what turns latents into features and classes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._check import check_shapes
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import (
    CodewordLabels,
    Score,
    Selection,
    Votes,
    average_views,
    classify,
    label_codewords,
    label_pixels,
    nearest_codeword,
    select_by_query,
    select_by_similarity,
    vote_labels,
)
from ..labels._rows import unit_embeddings
from ..labels.segment import Decode
from ..metrics import MIB, semantic_storage_bytes
from ..quant.autoencoder import Autoencoder
from ..quant.codebook import Codebook, unit_rows
from ..splat import Rendering, rasterize
from .store import load_field, save_field

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB


@dataclass(frozen=True, eq=False)
class SemanticField:
    """A scene's semantics in 3-D (Sec. 3.2-3.4), in any of the three rows of Table 1.

    With codebook and autoencoder the Gaussians carry d latents ("decouple+ADC+SC"); with the codebook alone they carry
    features near codewords ("decouple+ADC"); with neither, the teacher's features as they are ("just decouple").
    """

    gaussians: Gaussians
    codebook: Codebook | None = None
    autoencoder: Autoencoder | None = None
    info: dict[str, Any] = default(default_factory=dict)
    """Where it comes from; anything that JSON can hold."""

    def __post_init__(self) -> None:
        if self.gaussians.features is None:
            raise ValueError("gaussians: expected features [N, d], got None; fit them with fit_field")
        if self.autoencoder is not None and self.codebook is None:
            raise ValueError("codebook: expected the one that the autoencoder was fitted to, got None; pass it as well")
        if self.codebook is None:
            return
        expected = self.codebook.dim if self.autoencoder is None else self.autoencoder.latent
        if self.autoencoder is not None and self.autoencoder.dim != self.codebook.dim:
            raise ValueError(
                f"autoencoder: expected {self.codebook.dim} decoded channels (from codebook), got {self.autoencoder.dim}; "
                "pass the autoencoder that was fitted to this codebook"
            )
        if expected != self.channels:
            raise ValueError(
                f"gaussians: expected {expected} features each (from the codebook's latents), got {self.channels}; "
                "pass the codebook and autoencoder that this field was fitted with"
            )

    @property
    def features(self) -> Tensor:  # [N, d]
        """The Gaussians' latents (or features, without an autoencoder)."""
        assert self.gaussians.features is not None
        return self.gaussians.features

    @property
    def channels(self) -> int:
        """d, the channels of a Gaussian."""
        return int(self.features.shape[1])

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's features."""
        return self.channels if self.codebook is None else self.codebook.dim

    def __len__(self) -> int:
        return len(self.gaussians)

    def render(self, camera: Camera, *, engine: str = "auto") -> Rendering:
        """The latent map F_r (Eq. 3) from a viewpoint, with its alpha. No gradient."""
        with torch.no_grad():
            return rasterize(self.gaussians, camera, engine=engine)

    def decode(
        self,
        latents: Tensor,  # [..., d]
    ) -> Tensor:  # [..., D]
        """Bring latents back to the teacher's space (Psi of Sec. 3.3.2); features are returned as they are."""
        if latents.shape[-1] != self.channels:
            raise ValueError(
                f"latents: expected [..., d] with d = {self.channels} (from gaussians), got {tuple(latents.shape)}; "
                "pass maps or features of this field"
            )
        if self.autoencoder is None:
            return latents
        with torch.no_grad():
            return self.autoencoder.decode(latents, chunk=CHUNK)

    def feature_map(self, camera: Camera) -> Tensor:  # [H, W, D]
        """The teacher's features as seen from a viewpoint. 512 channels at 640x480 take 630 MB."""
        return self.decode(self.render(camera).map)

    def codeword_labels(
        self,
        embeddings: Tensor,  # [C, D]
    ) -> CodewordLabels:
        """The class of each codeword (Sec. 3.4).

        Raises:
            ValueError: if the field has no codebook, or shapes disagree.
        """
        self._check_embeddings(embeddings)
        if self.codebook is None:
            raise ValueError("codebook: expected one, got None in this field; use classify or segment, which need none")
        return label_codewords(self.codebook.codewords, embeddings)

    def segment(
        self,
        camera: Camera,
        embeddings: Tensor,  # [C, D]
        *,
        decode: Decode = "exact",
    ) -> Tensor:  # [H, W] int64
        """The class of each pixel from a viewpoint (Sec. 3.4): render, decode, quantise, look up.

        Args:
            camera: any viewpoint.
            embeddings: one row per class.
            decode: "exact" as in the paper, or "latent", which compares latents and skips the decoder.

        Returns:
            Class indices; -1 where no Gaussian was drawn.

        Raises:
            ValueError: if shapes disagree or `decode` is unknown.
        """
        self._check_embeddings(embeddings)
        rendering = self.render(camera)
        labels = None if self.codebook is None else self.codeword_labels(embeddings)
        return label_pixels(
            rendering.map,
            self.codebook,
            labels,
            self.autoencoder,
            decode=decode,
            embeddings=embeddings,
            covered=rendering.alpha > 0,
        )

    def quantized(self) -> Tensor:  # [N, D]
        """The codeword nearest to each Gaussian's decoded feature; without a codebook the features themselves.

        All-zero where the Gaussian was never learnt.
        """
        if self.codebook is None:
            return self.features
        return self.codebook.codewords[self._codeword_index()] * self._learnt()[:, None]

    def classify(
        self,
        embeddings: Tensor,  # [C, D]
    ) -> tuple[Tensor, Tensor]:  # labels [N] int64, scores [N]
        """The class of each Gaussian by max-similarity (Sec. 3.4), and its cosine with that class.

        This decodes each Gaussian's own latent, as the paper does. Training constrains only blends of latents, so
        `classify_by_views` is more accurate where cameras are at hand. A Gaussian that no training view ever showed
        still has its all-zero start: label -1, score 0.
        """
        self._check_embeddings(embeddings)
        if self.codebook is None:
            found = classify(self.features, embeddings)
            return found.labels, found.scores
        per_codeword = classify(self.codebook.codewords, embeddings)
        index, learnt = self._codeword_index(), self._learnt()
        return per_codeword.labels[index].masked_fill(~learnt, -1), per_codeword.scores[index].masked_fill(~learnt, 0)

    def classify_by_views(
        self,
        embeddings: Tensor,  # [C, D]
        cameras: Iterable[Camera],
        *,
        decode: Decode = "latent",
    ) -> Votes:
        """The class of each Gaussian by a vote of segmented views, weighted by how much each view shows it.

        Args:
            embeddings: one row per class.
            cameras: which views vote; those that the field was trained on are the natural choice.
            decode: as in `segment`.

        Returns:
            Labels (-1 = no view shows the Gaussian, or fewer than seven votes in ten agree), the winner's share of the
            votes, and the votes cast.
        """
        self._check_embeddings(embeddings)
        views = ((camera, self.segment(camera, embeddings, decode=decode)) for camera in cameras)
        return vote_labels(self.gaussians, views, len(embeddings))

    def query(
        self,
        embedding: Tensor,  # [D]
        threshold: float | None = None,
        *,
        negatives: Tensor | None = None,  # [M, D]
        cameras: Iterable[Camera] | None = None,
        score: Score | None = None,
        logit_scale: float | str = "clip",
    ) -> Selection:
        """The Gaussians that are more similar to one target than a threshold (gamma of Sec. 3.4).

        The paper publishes no gamma: without one it is chosen from the scores, and the result says how. Both options
        make it better: on room_0 the selected Gaussians agree with the data set's labels (IoU, mean of 18 classes) at
        0.36 with neither, 0.37 with the other classes as negatives, 0.88 with cameras and 0.90 with both.

        Args:
            embedding: the target, in the teacher's space.
            threshold: gamma; a cosine, or with negatives a relevancy in [0, 1].
            negatives: what the target is to be told from, such as the scene's other classes (`labels.relevancy`).
            cameras: score each Gaussian by the mean of its pixels in these views, instead of by its own latent, which
                training constrains only in blends; those that the field was trained on are the natural choice.
            score: "cosine", "softmax" over the target and the negatives, or "relevancy" (`labels.text_scores`); when not
                given the relevancy with negatives, the cosine without.
            logit_scale: of the softmax: "raw", "lseg", "clip", or a number that multiplies the cosines.

        Raises:
            ValueError: if shapes disagree, a row is all-zero, `cameras` is empty, or an option is unknown.
        """
        self._check_text("embedding", embedding, ())
        self._check_text("negatives", negatives, ("M",))
        if cameras is None:
            features = self.quantized()
            return select_by_query(features, embedding, threshold, negatives, score=score, logit_scale=logit_scale)
        targets = embedding[None] if negatives is None else torch.cat([embedding[None], negatives])
        rows = unit_embeddings(targets, "embedding, negatives").to(self.features)
        views = ((camera, self._similarity_map(camera, rows)) for camera in cameras)
        values, weights = average_views(self.gaussians, views)
        against = None if negatives is None else values[:, 1:]
        return select_by_similarity(values[:, 0], against, threshold, weights > 0, score=score, logit_scale=logit_scale)

    def storage(self) -> int:
        """Bytes as Table 1 counts them: every attribute of the Gaussians, the decoder and the codebook, in float32.

        With no autoencoder the table's sizes hold no codebook or decoder; ours counts the codebook, which labelling needs.
        """
        decoder = 0 if self.autoencoder is None else self.autoencoder.decoder_parameters
        codebook = 0 if self.codebook is None else self.codebook.codewords.numel()
        return semantic_storage_bytes(len(self), self.channels, decoder, codebook)

    def summary(self) -> str:
        """A few lines for a person: counts, channels, codewords, size."""
        row = "just decouple" if self.codebook is None else "decouple+ADC"
        row += "+SC" if self.autoencoder is not None else ""
        codewords = "no codebook" if self.codebook is None else f"{self.codebook.size} codewords"
        teacher = self.info.get("teacher")
        lines = [
            f"semantic field ({row}): {len(self)} Gaussians, {self.channels} channels for {self.dim}, {codewords}",
            f"  size as Table 1 counts it: {self.storage() / MIB:.2f} MiB",
            *([f"  teacher: {teacher.get('name')}"] if isinstance(teacher, dict) else []),
            *(f"  {name}: {value}" for name, value in self.info.items() if not isinstance(value, list | dict)),
        ]
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """Write a folder with `field.safetensors` and `field.json`, whole or not at all; an older field is replaced.

        Raises:
            FileExistsError: if something else than a field lies at `path`.
            ValueError: if `info` is not JSON.
        """
        save_field(path, self.gaussians, self.codebook, self.autoencoder, self.info)

    @classmethod
    def load(cls, path: str | Path) -> SemanticField:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: if there is no field at `path`.
            ValueError: if it is damaged, from another version, or something else.
        """
        return cls(*load_field(path))

    def _codeword_index(self) -> Tensor:  # [N] int64
        """Each Gaussian's codeword; decoded in chunks, so [N, D] is never held."""
        assert self.codebook is not None
        return torch.cat([self.codebook.quantize(self.decode(part)) for part in self.features.split(CHUNK)])

    def _similarity_map(self, camera: Camera, rows: Tensor) -> Tensor:  # rows [M, D] unit -> [H, W, M]
        """The cosine of each pixel's codeword (or feature) with some rows; 0 where nothing was drawn."""
        rendering = self.render(camera)
        pixels = rendering.map.flatten(0, 1)
        with torch.no_grad():
            if self.codebook is None:
                similarity = torch.cat([unit_rows(part) @ rows.T for part in pixels.split(CHUNK)])
            else:
                if self.autoencoder is None:
                    index = torch.cat([self.codebook.quantize(part) for part in pixels.split(CHUNK)])
                else:
                    centres = self.autoencoder.encode(self.codebook.codewords)
                    index = nearest_codeword(pixels, centres.to(pixels))
                similarity = (unit_rows(self.codebook.codewords) @ rows.T)[index]
            return similarity.view(*camera.size, len(rows)) * (rendering.alpha > 0)[..., None]

    def _learnt(self) -> Tensor:  # [N] bool
        """Whether a Gaussian's features left their start at 0, which those that no view shows never do."""
        return self.features.any(dim=1)

    def _check_embeddings(self, embeddings: Tensor) -> None:
        self._check_text("embeddings", embeddings, ("C",))

    def _check_text(self, name: str, rows: Tensor | None, axes: tuple[str, ...]) -> None:
        """Refuse rows of another shape; where only D differs, they are mostly text of another teacher."""
        shape = tuple(getattr(rows, "shape", ()))
        if len(shape) == len(axes) + 1 and shape[-1] != self.dim:
            expected = ", ".join((*axes, str(self.dim)))
            raise ValueError(
                f"{name}: expected [{expected}], got {shape}: text of another teacher? Embed the words with the one whose "
                "features this field was fitted to"
            )
        check_shapes((name, rows, (*axes, self.dim)))
