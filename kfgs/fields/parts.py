"""Helpers of `SemanticField`: its parts fit together, are decoded, and are described for people."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._check import as_tensor, check_shapes
from .._rows import check_directions, unit_rows
from ..gaussians import Gaussians
from ..labels import LabelSet
from ..labels.questions import Classes
from ..metrics import MIB, semantic_storage_bytes
from ..quant import Autoencoder, Codebook, LinearLatents
from .answers import Seen
from .remembered import scene_in_words

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB


def check_parts(
    gaussians: Gaussians,
    codebook: Codebook | None,
    autoencoder: Autoencoder | None,
    linear: LinearLatents | None,
    answers: Tensor | None,  # [N, e]
    seen: Seen | None,
) -> None:
    """Raise a ValueError unless these parts fit together; they are those of `SemanticField`."""
    features = gaussians.features
    if features is None:
        raise ValueError("gaussians: expected features [N, d], got None; fit them with fit_field")
    if seen is not None:
        pixels, agreement = ("seen.pixels", seen.pixels, "N"), ("seen.agreement", seen.agreement, "N")
        check_shapes(("gaussians.means", gaussians.means, "N 3"), pixels, agreement)
    if autoencoder is not None and codebook is None:
        raise ValueError("codebook: expected the one that the autoencoder was fitted to, got None; pass it as well")
    if linear is None and answers is not None:
        raise ValueError("linear: expected what the answers stand for, got None; pass it as well")
    if linear is not None:
        name, own = ("gaussians.features", features) if answers is None else ("answers", answers)
        check_shapes(("gaussians.means", gaussians.means, "N 3"), (name, own, ("N", linear.latent)))
        if answers is None and codebook is not None:
            raise ValueError("codebook: expected none for linear latents, got one; pass answers, or leave linear out")
    if codebook is None:
        return
    if autoencoder is not None and autoencoder.dim != codebook.dim:
        raise ValueError(
            f"autoencoder: expected {codebook.dim} decoded channels (from codebook), got {autoencoder.dim}; "
            "pass the autoencoder that was fitted to this codebook"
        )
    expected, channels = codebook.dim if autoencoder is None else autoencoder.latent, features.shape[1]
    if expected != channels:
        raise ValueError(
            f"gaussians: expected {expected} features each (from the codebook's latents), got {channels}; "
            "pass the codebook and autoencoder that this field was fitted with"
        )


def checked_classes(classes: Classes) -> Classes:
    """Return classes unchanged, an array or a list of rows as a tensor; a single name is an error."""
    if isinstance(classes, str):
        raise TypeError(
            f"classes: expected a LabelSet or embeddings [C, D], got the name {classes!r}; query({classes!r}) finds the "
            "Gaussians of one class"
        )
    rows = isinstance(classes, list | tuple) and not any(
        isinstance(one, str) for one in classes
    )  # names: see class_rows
    return as_tensor("classes", classes, floating=True) if rows or isinstance(classes, np.ndarray) else classes


def teacher_name(info: dict[str, Any]) -> str | None:
    """The name of the teacher in a field's `info`; None if unknown."""
    teacher = info.get("teacher")
    return str(teacher.get("name")) if isinstance(teacher, dict) else None


def info_lines(info: dict[str, Any]) -> list[str]:
    """A field's `info` for people, a line per entry; lists and dictionaries are left out."""
    teacher = teacher_name(info)
    lines = [] if teacher is None else [f"  teacher: {teacher}"]
    return [*lines, *(f"  {name}: {value}" for name, value in info.items() if not isinstance(value, list | dict))]


def classes_to_ask(field: Any, target: str | Tensor, negatives: Any) -> LabelSet | None:
    """The classes of a field that a query needs: to look up a name, or to compare with; None if there are none to compare."""
    compared = isinstance(negatives, str) and negatives != "none"
    if not isinstance(target, str) and not (compared and field.has_classes):
        return None
    try:
        found: LabelSet = field.label_set()
    except (FileNotFoundError, ValueError):
        if isinstance(target, str) or negatives != "auto":  # an embedding needs no classes
            raise
        return None
    return found


def decode_latents(field: Any, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
    """See `SemanticField.decode`."""
    if latents.ndim == 0 or latents.shape[-1] != field.channels:
        raise ValueError(
            f"latents: expected [..., d] with d = {field.channels} (from gaussians), got {tuple(latents.shape)}; "
            "pass maps or features of this field"
        )
    if field.method == "fused":
        decoded: Tensor = field.linear.decode(latents)
        return decoded
    return latents if field.autoencoder is None else field.autoencoder.decode(latents, chunk=CHUNK)


def latent_cosines(field: Any, unit: Tensor) -> Tensor:  # [M, D] of length 1 -> [N, M]
    """The cosines of the Gaussians' own latents with some rows, by the rule "paper" of `SemanticField.cosines`."""
    chunks = field.features.split(CHUNK)
    if field.codebook is None:
        check_directions("gaussians.features", field.features)
        return torch.cat([unit_rows(part) @ unit.T for part in chunks])
    per_codeword = field.codebook.unit.to(unit) @ unit.T  # [K, M]
    index = torch.cat([field.codebook.quantize(field.decode(part)) for part in chunks])
    cosines: Tensor = per_codeword[index] * field.features.any(dim=1)[:, None]
    return cosines


def storage_bytes(field: Any) -> int:
    """See `SemanticField.storage`."""
    decoder = 0 if field.autoencoder is None else field.autoencoder.decoder_parameters
    codebook = 0 if field.codebook is None else field.codebook.codewords.numel()
    basis = field.linear.basis.numel() if field.method == "fused" else 0
    return semantic_storage_bytes(len(field), field.channels, decoder, codebook + basis)


def card_facts(field: Any) -> dict[str, object]:
    """A field's facts for its card in a notebook."""
    facts: dict[str, object] = {"method": field.method, "Gaussians": len(field), "channels": field.channels}
    facts |= {
        "channels of the teacher": field.dim,
        "codewords": None if field.codebook is None else field.codebook.size,
    }
    facts |= {"training views": len(field.cameras), "size as Table 1 counts it": f"{field.storage() / MIB:.2f} MiB"}
    return facts | {
        "teacher": teacher_name(field.info),
        "folder": None if field.folder is None else str(field.folder),
    }


def summary_text(field: Any) -> str:
    """See `SemanticField.summary`."""
    codewords = "no codebook" if field.codebook is None else f"{field.codebook.size} codewords"
    channels = f"{field.channels} channels for {field.dim}"
    lines = [
        f"semantic field ({field.method}): {len(field)} Gaussians, {channels}, {codewords}",
        f"  size as Table 1 counts it: {field.storage() / MIB:.2f} MiB",
        *info_lines(field.info | scene_in_words(field.info, field.folder)),
    ]
    if field.words is not None:
        lines.append(f"  classes: {len(field.words)}, with their text table")
    noted = info if isinstance(info := field.info.get("rounded"), list) else []
    lines += [f"  rounded: precision {one.get('precision')!s:.20}" for one in noted if isinstance(one, dict)]
    return "\n".join(lines)
