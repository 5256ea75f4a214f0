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
    is due, and drop codewords that are too similar (Eq. 9). Codewords that stay keep Adam's moments, and their gradients
    gathered since the last step.

    The result depends on the unit of the features: those times 10 give codewords times 10 only with 10 times the rate.
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
    """None, as printed (Eq. 8): every feature of an image whose cosine with its codeword is below alpha joins at once, up to
    K_max; if more qualify than there is room for, the least similar (the paper gives no order, this one is the script's).
    A number: at most so many features of an image, each the one least similar to all codewords including those that joined
    just before. With ceil((K_max - rho) / images), neither one image nor copies of one feature fill the codebook."""
    epochs: int = 28
    """Passes over all maps, in random order."""
    learning_rate: float = 8e-4
    """Adam's, in units of the features: a step moves each channel of a codeword by about this much, whatever its length. The
    paper's value is for its own features, LSeg's sum over four scales; features of length 10 turn ten times slower than
    those of length 1."""
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
        book = EvolvingCodebook(first[farthest_points(first, self.initial)], self)
        history: list[dict[str, Any]] = []
        bar = tqdm(range(self.epochs), desc="codebook", disable=progress is not True)
        for epoch in bar:
            size, pruned, visits = len(book.rows), 0, list[tuple[float, Tensor]]()
            period = 1 if epoch < self.eager_epochs else self.step_every
            order = torch.randperm(maps, generator=generator, device=generator.device).tolist()
            for seen, i in enumerate(order, start=1):
                features = read(i)
                if len(features):
                    visits.append(book.learn_from(features))
                if seen % period == 0 or seen == maps:
                    book.step()
                pruned += book.prune()
            losses, similarities = zip(*visits, strict=True)
            counts = {"size": len(book.rows), "added": len(book.rows) - size + pruned, "pruned": pruned}
            reached = {"loss": sum(losses) / len(losses)} | coverage(torch.cat(similarities), self.expand_below)
            history.append({"epoch": epoch, **counts, **reached})
            bar.set_postfix(K=counts["size"], coverage=f"{reached['coverage']:.3f}")
            if callable(progress):
                progress(dict(history[-1]))
        codebook = Codebook(book.rows)
        nearest = map(torch.cat, zip(*(codebook.nearest(read(i)) for i in range(maps)), strict=True))
        return with_report(codebook.codewords, history, Nearest(*nearest), self.expand_below)


def farthest_points(features: Tensor, count: int) -> Tensor:  # [n, D], none all-zero -> [min(count, n)] int64
    """Pick the `count` most diverse features: farthest-point sampling with cosine similarity as the measure.

    The first two are the least similar pair of all (the earlier one first), then `farthest_first` continues. Ties go to the
    lowest row. When nothing else is left, an equal feature may be picked; pruning (Eq. 9) takes it out again.
    """
    unit = unit_rows(features)
    least, pair = float("inf"), (0, 1)
    for start in range(0, len(unit) - 1, BLOCK):  # the upper triangle, one block of rows at a time
        similarity = unit[start : start + BLOCK] @ unit[start:].T  # [b, n - start], starts on the diagonal
        row, column = divmod(int(similarity.fill_diagonal_(torch.inf).argmin()), similarity.shape[1])
        if float(similarity[row, column]) < least:
            least, pair = float(similarity[row, column]), (start + min(row, column), start + max(row, column))
    picked = torch.tensor(pair[: min(count, len(unit))], device=unit.device)
    largest = (unit @ unit[picked].T).amax(dim=1)
    largest[picked] = torch.inf  # never twice
    return torch.cat([picked, farthest_first(unit, largest, torch.inf, count - len(picked))])


def farthest_first(unit: Tensor, similarity: Tensor, below: float, count: int) -> Tensor:  # [n, D], [n] -> [m] int64
    """The row of least similarity, then again after similarities are updated by it; at most `count`, each below the limit."""
    best, chosen = similarity.clone(), list[int]()
    for _ in range(min(count, len(best))):
        least = int(best.argmin())
        if float(best[least]) >= below:
            break
        chosen.append(least)
        best = torch.maximum(best, unit @ unit[least])
        best[least] = torch.inf  # present now, whatever rounding makes of its cosine with itself
    return torch.tensor(chosen, dtype=torch.int64, device=unit.device)


class EvolvingCodebook:
    """Codewords that are optimised by Adam (Kingma & Ba 2015), join and are dropped.

    Each row has its own moments and step count. torch.optim.Adam counts steps for the whole matrix, so a row that joins late
    would start with a jump of about three learning rates. For rows that are there from the start the two agree.
    """

    def __init__(self, codewords: Tensor, options: PaperCodebook) -> None:  # [K, D]
        self.options, self.state = options, _fresh(codewords)
        self.gathered = 0  # gradients since the last step

    @property
    def rows(self) -> Tensor:  # [K, D]
        """The codewords."""
        return self.state["rows"]

    def learn_from(self, features: Tensor) -> tuple[float, Tensor]:  # [n, D] of one image
        """Quantise, expand, and gather the gradient; the loss, and each feature's similarity to the codewords before [n]."""
        size = len(self.rows)
        index, similarity = Codebook(self.rows).nearest(features)
        joining = features[self.expand(features, similarity)]
        if len(joining):
            newest = Codebook(joining).nearest(features)
            index = torch.where(newest.similarity > similarity, newest.codeword + size, index)
            self.state = {name: torch.cat([self.state[name], value]) for name, value in _fresh(joining).items()}
        loss, gradient = class_balanced_loss(features, self.rows, index)
        self.state["gradient"] = self.state["gradient"] + gradient
        self.gathered += 1
        return float(loss), similarity

    def expand(self, features: Tensor, similarity: Tensor) -> Tensor:  # [n, D], [n] -> [m] int64
        """The features that join because no codeword is similar enough to them (Eq. 8), in the order of joining.

        Ties go to the lowest row. (The released script may exceed K_max by one.)
        """
        alpha, most = self.options.expand_below, self.options.joins_per_image
        room = self.options.maximum - len(self.rows)
        rows = (similarity < alpha).nonzero()[:, 0][: None if room else 0]
        if most is None:
            return rows[similarity[rows].argsort(stable=True)[:room]]
        return rows[farthest_first(unit_rows(features[rows]), similarity[rows], alpha, min(room, most))]

    def step(self) -> None:
        """An Adam step with the mean of the gathered gradients."""
        if self.gathered == 0:  # every feature was zero
            return
        state, (decay1, decay2) = self.state, BETAS
        gradient, steps = state["gradient"] / self.gathered, state["steps"] + 1
        first, second = state["first"].lerp(gradient, 1 - decay1), decay2 * state["second"]
        second = second + (1 - decay2) * gradient.square()
        bias1, bias2 = ((1 - decay**steps).to(gradient.dtype) for decay in BETAS)
        rows = self.rows - self.options.learning_rate * (first / bias1) / ((second / bias2).sqrt() + ADAM_EPS)
        self.state = _fresh(rows) | {"first": first, "second": second, "steps": steps}
        self.gathered = 0

    def prune(self) -> int:
        """Drop codewords that are too similar (Eq. 9); their number."""
        size, stays = len(self.rows), prune(self.rows, threshold=self.options.prune_above)
        self.state = {name: value[stays] for name, value in self.state.items()}
        return size - len(stays)


def _fresh(rows: Tensor) -> dict[str, Tensor]:
    """Codewords without a step: zero moments and gradient, and steps in float64, because 1 - 0.999 ** t cancels in float32."""
    zeros = {name: torch.zeros_like(rows) for name in ("first", "second", "gradient")}
    return {"rows": rows, "steps": torch.zeros(len(rows), 1, dtype=torch.float64, device=rows.device), **zeros}


def prune(codewords: Tensor, *, threshold: float) -> Tensor:  # [K, D] -> [K'] int64, ascending
    """Choose the codewords that stay when the later of any two that are too similar is dropped (Eq. 9).

    All pairs e < g of the codebook count, as printed: f_g goes if its cosine with any earlier f_e exceeds `threshold` (beta),
    even if f_e goes as well. (The released script drops f_e.) Pruning twice changes nothing.
    """
    unit = unit_rows(codewords)
    return (~(unit @ unit.T > threshold).triu(diagonal=1).any(dim=0)).nonzero()[:, 0]


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
