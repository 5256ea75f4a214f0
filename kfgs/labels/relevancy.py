"""The relevancy of a query against negatives, as LERF has it."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_shapes
from .._rows import check_finite

TEMPERATURE = 10.0  # of the softmax, as LERF (Kerr 2023) uses it
CANONICAL = ("object", "things", "stuff", "texture")  # LERF's negatives where nothing is known of a scene


def relevancy(
    similarity: Tensor,  # [N]
    negatives: Tensor,  # [N, M]
) -> Tensor:  # [N] in (0, 1)
    """How much more like the query than like the most similar negative, as LERF has it (Kerr 2023, Sec. 3.4).

    min over j of the first entry of softmax(10 [s, n_j]), which is sigmoid(10 (s - max_j n_j)). Above 0.5 the query is
    more similar than every negative. LERF's negatives are the texts in `CANONICAL`; where the
    scene's other classes are known, they are the better ones.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each of M >= 1 negatives.

    Raises:
        ValueError: if shapes disagree, there is no negative, or a number is not finite.

    Example:
        >>> import torch
        >>> relevancy(torch.tensor([0.9, 0.3]), torch.tensor([[0.2, 0.9], [0.1, 0.2]])).tolist()
        [0.5, 0.7310585975646973]
    """
    check_shapes(("similarity", similarity, "N"), ("negatives", negatives, "N M"))
    if negatives.shape[1] == 0:
        raise ValueError("negatives: expected at least one column, got none; pass what the query should not find")
    check_finite("similarity", similarity)
    check_finite("negatives", negatives)
    return torch.sigmoid(TEMPERATURE * (similarity - negatives.amax(dim=1)))
