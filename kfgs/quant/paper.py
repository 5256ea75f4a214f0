"""The paper's codebook (Sec. 3.3.1): it grows (Eq. 8), shrinks (Eq. 9), and its rows are optimised by Adam (Eq. 6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import Progress, check_range, check_whole
from .._rows import EPS, row_norms, unit_rows
from .codebook import Codebook, Nearest, coverage, with_report
from .maps import SAMPLES, all_zero

BETAS = (0.9, 0.999)  # Adam's usual decay rates; the paper names none
ADAM_EPS = 1e-9  # the released script's
BLOCK = 2048  # rows of a similarity matrix in memory at a time


@dataclass(frozen=True)
class PaperCodebook:
    """The paper's codebook with the paper's values; those of its released script if the paper gives none.

    Farthest-point sampling on the first image gives the first codewords. Then, image by image: quantise (Eq. 5), let badly
    represented features join (Eq. 8), gather the gradient of the class-balanced loss (Eq. 6-7), take an Adam step when one
    is due, and drop codewords that became too similar (Eq. 9). Codewords that survive keep Adam's moments.
    """

    maximum: int = 100
    """The most codewords (K_max)."""
    expand_below: float = 0.9
    """A feature joins when its similarity to its codeword is below this (alpha, Eq. 8)."""
    prune_above: float = 0.99
    """The later of two codewords is dropped when their similarity is above this (beta, Eq. 9)."""
    initial: int = 8
    """Codewords from farthest-point sampling on the first image (rho)."""
    joins_per_image: int | None = None
    """The most features of one image that join in one visit, the least similar first. None shares the free slots among the
    images, so that the first ones seen do not fill the codebook; the paper leaves its batches open."""
    epochs: int = 28
    """Passes over all maps, in random order."""
    learning_rate: float = 8e-4
    """Adam's, in units of the features. It fits features of a length of about 10, as LSeg's summed scales have."""
    eager_epochs: int = 2
    """Epochs at the start with a step after every image (script)."""
    step_every: int = 8
    """Images per step afterwards, their gradients averaged; an epoch's last step uses the rest."""
    samples: int = SAMPLES
    """The most features sampled per map: rows 1::2, columns 1::3 of 360 x 480 (script)."""

    def __post_init__(self) -> None:
        for name in ("initial", "epochs", "step_every", "samples"):
            check_whole(name, getattr(self, name), 1)
        check_whole("maximum", self.maximum, self.initial)
        check_whole("joins_per_image", 1 if self.joins_per_image is None else self.joins_per_image, 1)
        check_whole("eager_epochs", self.eager_epochs, 0)
        check_range("expand_below", self.expand_below, -1, 1)
        check_range("prune_above", self.prune_above, self.expand_below, 1)  # below it, what joins is pruned at once
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))

    def fit(self, read: Callable[[int], Tensor], maps: int, generator: torch.Generator, progress: Progress) -> Codebook:
        """See `fit_codebook`. `read` gives the sampled features [n, D] of a map, without all-zero ones."""
        first = next((features for features in map(read, range(maps)) if len(features)), None)
        if first is None:
            raise all_zero(maps)
        joins = self.joins_per_image or max(1, -(-(self.maximum - self.initial) // maps))
        book = EvolvingCodebook(first[farthest_points(first, self.initial)], self, joins)
        history: list[dict[str, Any]] = []
        bar = tqdm(range(self.epochs), desc="codebook", disable=progress is not True)
        for epoch in bar:
            before, pruned, visits = len(book.rows), 0, list[tuple[float, Tensor]]()
            period = 1 if epoch < self.eager_epochs else self.step_every
            order = torch.randperm(maps, generator=generator, device=generator.device).tolist()
            for seen, i in enumerate(order, start=1):
                features = read(i)
                if len(features):
                    visits.append(book.learn_from(features))
                if seen % period == 0 or seen == maps:
                    pruned += book.step()
            size, (losses, similarities) = len(book.rows), zip(*visits, strict=True)
            record: dict[str, Any] = {"epoch": epoch, "size": size, "added": size - before + pruned, "pruned": pruned}
            record |= {"loss": sum(losses) / len(losses)} | coverage(torch.cat(similarities), self.expand_below)
            history.append(record)
            bar.set_postfix(K=size, coverage=f"{record['coverage']:.3f}")
            if callable(progress):
                progress(dict(history[-1]))
        codebook = Codebook(book.rows)
        nearest = map(torch.cat, zip(*(codebook.nearest(read(i)) for i in range(maps)), strict=True))
        return with_report(codebook.codewords, history, Nearest(*nearest), self.expand_below)


def farthest_points(features: Tensor, count: int) -> Tensor:  # [n, D] -> [min(count, nonzero rows)] int64
    """Pick the `count` most diverse features: farthest-point sampling with cosine similarity as the measure.

    The first two are the least similar pair of all (the earlier one first), then `expand` continues: each further one is the
    feature whose largest similarity to those already picked is smallest. Ties go to the lowest row; all-zero rows are never
    picked. When nothing else is left, an equal feature may be picked; pruning (Eq. 9) takes it out again.
    """
    rows = (row_norms(features) > EPS).nonzero()[:, 0]
    unit = unit_rows(features[rows])
    if len(rows) < 2:
        return rows
    least, pair = float("inf"), (0, 1)
    for start in range(0, len(unit) - 1, BLOCK):  # the upper triangle, one block of rows at a time
        similarity = unit[start : start + BLOCK] @ unit[start:].T  # [b, n - start], starts on the diagonal
        row, column = divmod(int(similarity.fill_diagonal_(torch.inf).argmin()), similarity.shape[1])
        if float(similarity[row, column]) < least:
            least, pair = float(similarity[row, column]), (start + min(row, column), start + max(row, column))
    picked = torch.tensor(pair[:count], device=rows.device)
    largest = (unit @ unit[picked].T).amax(dim=1)
    largest[picked] = torch.inf  # never twice
    return rows[torch.cat([picked, expand(unit, largest, threshold=torch.inf, room=count - len(picked))])]


class EvolvingCodebook:
    """Codewords that are optimised by Adam (Kingma & Ba 2015), join and are dropped.

    Each row has its own moments and step count. torch.optim.Adam counts steps for the whole matrix, so a row that joins late
    would start with a jump of about three learning rates. For rows that are there from the start the two agree.
    """

    def __init__(self, codewords: Tensor, options: PaperCodebook, joins: int) -> None:  # [K, D], the most per image
        self.options, self.joins = options, joins
        self.state = _fresh(codewords)
        self.gathered = 0  # gradients since the last step

    @property
    def rows(self) -> Tensor:  # [K, D]
        """The codewords."""
        return self.state["rows"]

    def learn_from(self, features: Tensor) -> tuple[float, Tensor]:  # [n, D] of one image
        """Quantise, expand, and gather the gradient; the loss, and each feature's similarity to the codewords before [n]."""
        size = len(self.rows)
        index, similarity = Codebook(self.rows).nearest(features)
        room = min(self.joins, self.options.maximum - size)
        joining = features[expand(features, similarity, threshold=self.options.expand_below, room=room)]
        if len(joining):
            newest = Codebook(joining).nearest(features)
            index = torch.where(newest.similarity > similarity, newest.codeword + size, index)
            self.state = {name: torch.cat([self.state[name], value]) for name, value in _fresh(joining).items()}
        loss, gradient = class_balanced_loss(features, self.rows, index)
        self.state["gradient"] = self.state["gradient"] + gradient
        self.gathered += 1
        return float(loss), similarity

    def step(self) -> int:
        """An Adam step with the mean of the gathered gradients, then pruning; the number of dropped codewords."""
        if self.gathered == 0:  # every feature was zero
            return 0
        state, (decay1, decay2) = self.state, BETAS
        gradient, steps = state["gradient"] / self.gathered, state["steps"] + 1
        first, second = state["first"].lerp(gradient, 1 - decay1), decay2 * state["second"]
        second = second + (1 - decay2) * gradient.square()
        bias1, bias2 = ((1 - decay**steps).to(gradient.dtype) for decay in BETAS)
        rows = self.rows - self.options.learning_rate * (first / bias1) / ((second / bias2).sqrt() + ADAM_EPS)
        stays = prune(rows, threshold=self.options.prune_above)
        moved = _fresh(rows) | {"first": first, "second": second, "steps": steps}
        self.state, self.gathered = {name: value[stays] for name, value in moved.items()}, 0
        return len(rows) - len(stays)


def _fresh(rows: Tensor) -> dict[str, Tensor]:
    """Codewords without a step: zero moments and gradient, and steps in float64, because 1 - 0.999 ** t cancels in float32."""
    zeros = {name: torch.zeros_like(rows) for name in ("first", "second", "gradient")}
    return {"rows": rows, "steps": torch.zeros(len(rows), 1, dtype=torch.float64, device=rows.device), **zeros}


def expand(features: Tensor, similarity: Tensor, *, threshold: float, room: int) -> Tensor:  # [n, D], [n] -> [m] int64
    """Choose the features that join the codebook because no codeword is similar enough to them (Eq. 8).

    The least similar feature joins first; similarities are then updated, and so on until every feature is at least
    `threshold` (alpha) similar to a codeword, or `room` have joined: farthest-point sampling that starts from the codebook. So
    each feature is below the threshold at the moment it joins, and near-duplicates never fill the book.

    Returns:
        Rows of `features` in the order of joining. Ties go to the lowest row; all-zero rows never join.

    Note:
        The paper admits in batches every feature below alpha; its released script takes the least similar ones without
        updating similarities, and may exceed K_max by one.
    """
    rows = (similarity < threshold).nonzero()[:, 0][: None if room > 0 else 0]
    rows = rows[row_norms(features[rows]) > EPS]
    unit, best = unit_rows(features[rows]), similarity[rows].clone()
    chosen: list[int] = []
    while len(chosen) < room and best.numel() > 0:
        least = int(best.argmin())
        if not float(best[least]) < threshold:
            break
        chosen.append(least)
        best = torch.maximum(best, unit @ unit[least])
        best[least] = torch.inf  # present now, whatever rounding makes of its cosine with itself
    return rows[torch.tensor(chosen, dtype=torch.int64, device=rows.device)]


def prune(codewords: Tensor, *, threshold: float) -> Tensor:  # [K, D] -> [K'] int64, ascending
    """Choose the codewords that stay when the later of any two that are too similar is dropped (Eq. 9).

    Codewords are visited in order, and one is dropped if its cosine with an earlier one *that stays* exceeds `threshold`
    (the paper's beta). So each dropped codeword has a stand-in, and pruning twice changes nothing.

    Note:
        The paper drops f_g of a pair e < g, the released script f_e.
    """
    unit = unit_rows(codewords)
    close = (unit @ unit.T > threshold).triu(diagonal=1).cpu()  # K is small
    stays = torch.ones(len(codewords), dtype=torch.bool)
    for e in close.any(dim=1).nonzero()[:, 0].tolist():
        if stays[e]:
            stays &= ~close[e]
    return stays.nonzero()[:, 0].to(codewords.device)


def class_balanced_loss(
    features: Tensor,  # [n, D]
    codewords: Tensor,  # [K, D]
    index: Tensor,  # [n] int64
) -> tuple[Tensor, Tensor]:  # [], [K, D] its gradient by the codewords
    """Mean over the T classes present of the mean cosine distance within the class (Eq. 6-7).

    A class is a codeword that has features. With the mean m of its unit features, mean(1 - cos(u, s)) = 1 - m . s/|s|, so one
    matrix product gives both the loss and its gradient, without autograd (the tests compare them):

        dL/ds = -(m - (m . s/|s|) s/|s|) / (T |s|).
    """
    n, K = len(features), len(codewords)
    counts = torch.bincount(index, minlength=K)
    T = (counts > 0).sum().clamp_min(1)
    # Row tau holds 1 / (N_tau |f_i|) where feature i is of class tau: a product, because index_add_ is not
    # repeatable on a GPU and not faster on a CPU.
    weights = features.new_zeros(K, n)
    inverse = 1.0 / (row_norms(features).clamp_min(EPS) * counts[index])
    weights[index, torch.arange(n, device=index.device)] = inverse.to(weights.dtype)
    means = weights @ features  # [K, D] mean of the unit features of each class
    norms = row_norms(codewords).clamp_min(EPS)[:, None]
    unit = codewords / norms
    similarity = (means * unit).sum(dim=1, keepdim=True)  # [K, 1]
    loss = ((1.0 - similarity[:, 0]) * (counts > 0)).sum() / T
    return loss, (similarity * unit - means) / (norms * T)
