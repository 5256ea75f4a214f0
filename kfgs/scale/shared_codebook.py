"""One codebook for many scenes. New scenes append words; a word that is there never moves, so ids stay valid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_range, check_shapes
from .._rows import EPS, check_directions, row_norms, unit_rows
from .._typed import typed
from ..quant import LinearLatents
from ..quant.codebook import Nearest
from ..quant.grow import grow, nearest_cells

TOLERANCE = 0.9  # of a feature with its word; 96.5 % of room_0's Gaussians then keep the class of their own feature
SUPPORT = 20  # features within its tolerance that a new word needs: at borders, every blend has another direction
MOST = 500  # words that one scene may add
FINER, COVERAGE = 0.5, 0.9
"""A new word is split until 90 % of its features are within half the tolerance's distance (0.95): the word between two
classes with a cosine of 0.8 would be within 0.95 of both."""


@dataclass(frozen=True, eq=False)
class SharedCodebook:
    """K words of D channels that many scenes share. A word is a direction in the teacher's space; its id is its row.

    A feature has the word of largest cosine. `extended` appends words for what no word resembles and leaves all others
    where they are, so that ids which were given out keep their meaning.

    Example:
        >>> import torch
        >>> book = SharedCodebook.fit(torch.tensor([[2.0, 0, 0]] * 4))
        >>> book.extended(torch.tensor([[0.99, 0.1, 0], [0.0, 3.0, 0.0]] * 20)).words.tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """

    words: Tensor  # [K, D] unit rows
    tolerance: float = TOLERANCE
    """The least cosine of a feature with its word, in (0, 1); below it, a new word is made."""

    def __post_init__(self) -> None:
        words = as_tensor("words", self.words, floating=True).detach()
        check_shapes(("words", words, "K D"))
        check_directions("words", words)
        check_range("tolerance", self.tolerance, 0, 1, closed=(False, False))
        if bool(((row_norms(words) - 1).abs() > 1e-3).any()):
            raise ValueError("words: expected rows of length 1, got others; make a codebook with SharedCodebook.fit")
        object.__setattr__(self, "words", words)

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.words)

    @property
    def dim(self) -> int:
        """Channels of a word, D."""
        return int(self.words.shape[1])

    @classmethod
    def fit(cls, features: Tensor, tolerance: float = TOLERANCE) -> SharedCodebook:  # features: [n, D]
        """A codebook of some features, for instance samples of all scenes of a collection.

        Raises:
            ValueError: if no feature is longer than zero, or a number is not finite.
        """
        features = as_tensor("features", features, floating=True)
        check_shapes(("features", features, "n D"))
        return cls(features.new_zeros(0, features.shape[1]), tolerance).extended(features)

    @typed
    def nearest(
        self,
        features: Tensor,  # [n, D], or latents [n, d]
        linear: LinearLatents | None = None,
    ) -> Nearest:  # codeword [n] int64, similarity [n]
        """The word of each feature and their cosine. Ties go to the lowest id; an all-zero feature has word 0, cosine 0.

        Args:
            features: of any length; latents if `linear` is given.
            linear: decodes the latents. No feature is made of them: the cosine is taken among the latents.

        Raises:
            ValueError: if shapes disagree, or there is no word yet.
        """
        unit, words = self._both(features, linear)
        if len(words) == 0:
            raise ValueError("words: expected at least one, got none; extend the codebook with a scene first")
        cells = nearest_cells(unit, words)
        return Nearest(cells.index, cells.similarity)

    @typed
    def extended(
        self,
        features: Tensor,  # [n, D], or latents [n, d]
        linear: LinearLatents | None = None,
    ) -> SharedCodebook:
        """This codebook with words appended for those features that no word resembles. All old ids stay.

        Features within the tolerance of a word keep that word. The others are grouped (`quant.grow`), and a group whose
        centre is within the tolerance of an old word takes that one. A new word needs 20 features that are within its
        tolerance and of no other word, unless the codebook was empty. The same scene a second time adds no word.

        Args:
            features: of one scene, or of samples of many; all-zero rows are left out.
            linear: as in `nearest`.

        Raises:
            ValueError: if shapes disagree, a number is not finite, or the codebook would stay empty.
        """
        unit, words = self._both(features, linear)
        check_directions("features", unit)
        unit, old = unit[row_norms(unit) > 0.5], len(words)
        while True:
            far = unit if len(words) == 0 else unit[nearest_cells(unit, words).similarity < self.tolerance]
            room = MOST - (len(words) - old)
            if len(far) < (SUPPORT if len(words) else 1) or room <= 0:
                break
            generator = torch.Generator(device=unit.device).manual_seed(0)  # the same features give the same centres
            alpha = 1 - FINER * (1 - self.tolerance)
            centres = grow(far, room, alpha=alpha, coverage=COVERAGE, generator=generator).cells.centres
            if len(words):
                near = nearest_cells(far, centres)
                support = torch.bincount(near.index[near.similarity >= self.tolerance], minlength=len(centres))
                new = nearest_cells(centres, words).similarity < self.tolerance
                centres = centres[new & (support >= SUPPORT)]
            if len(centres) == 0:
                break
            words = torch.cat([words, centres])
        if len(words) == 0:
            raise ValueError(f"features: expected rows longer than {EPS:g}, got none; check the teacher")
        added = words[old:] if linear is None else linear.decode(words[old:])
        return replace(self, words=torch.cat([self.words, unit_rows(added).to(self.words)]))

    def _both(self, features: Tensor, linear: LinearLatents | None) -> tuple[Tensor, Tensor]:
        """Unit features, and the words in the same channels: words that lie outside the latents' span become shorter."""
        features = as_tensor("features", features, floating=True).detach()
        dim = self.dim if linear is None else linear.latent
        check_shapes(("features", features, ("n", dim)))
        words = self.words.to(features)
        if linear is not None:
            words = linear.encode(words)
        return unit_rows(features), words
