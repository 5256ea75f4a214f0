"""The small networks that turn splatted values into features, built from the weights in a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from kfgs._rows import unit_rows

Layer = tuple[Tensor, Tensor]  # weight [out, in], bias [out]


class Perceptron:
    """Linear layers with ReLU between them.

    Args:
        layers: weights and biases, in order.
    """

    def __init__(self, layers: list[Layer]) -> None:
        self.layers = layers

    @property
    def inputs(self) -> int:
        """Channels that go in."""
        return int(self.layers[0][0].shape[1])

    @property
    def outputs(self) -> int:
        """Channels that come out."""
        return int(self.layers[-1][0].shape[0])

    def __call__(self, values: Tensor) -> Tensor:  # [M, inputs] -> [M, outputs]
        """Apply the layers."""
        for i, (weight, bias) in enumerate(self.layers):
            values = torch.nn.functional.linear(values.relu() if i else values, weight, bias)
        return values


class CodeSum:
    """LangSplatV2's codebook: the product with the weights of the codes.

    Args:
        codes: [K, D].
    """

    def __init__(self, codes: Tensor) -> None:
        self.codes = codes

    def __call__(self, weights: Tensor) -> Tensor:  # [M, K] -> [M, D]
        """Add the codes up."""
        return weights @ self.codes


class CodeMixture:
    """LEGaussians' query: an index network on unit vectors, then a mixture of the codebook's raw codes.

    Args:
        network: from values to a logit per code.
        codes: [K, D], the language half of the codebook.
        hard: the most likely code instead of the mixture (their `com_type = argmax`).
    """

    def __init__(self, network: Perceptron, codes: Tensor, hard: bool = False) -> None:
        self.network, self.codes, self.hard = network, codes, hard

    def __call__(self, values: Tensor) -> Tensor:  # [M, d] -> [M, D]
        """Mix the codes by the softmax of the logits."""
        logits = self.network(unit_rows(values))
        return self.codes[logits.argmax(-1)] if self.hard else logits.softmax(-1) @ self.codes


def perceptron_from_state(path: Path, state: Mapping[str, Tensor], pattern: str, inputs: int) -> Perceptron:
    """The layers of a state dict whose names match, in the order of the number in their names.

    1x1 convolutions [out, in, 1, 1] are linear layers.

    Args:
        path: for messages.
        state: tensors by name.
        pattern: a regular expression of a layer's name without `.weight`; its first group, if any, is the number.
        inputs: channels that the Gaussians have.

    Raises:
        ValueError: if there is no such layer, a bias is missing, or the sizes do not fit together.
    """
    numbered = []
    for name, weight in state.items():
        match = re.fullmatch(pattern + r"\.weight", name)
        if match:
            numbered.append((int(match[1]) if match.re.groups else 0, name, weight))
    layers, size = [], inputs
    for _, name, weight in sorted(numbered, key=lambda entry: entry[0]):
        flat = weight.flatten(1) if weight.ndim == 4 else weight
        bias = state.get(name.removesuffix("weight") + "bias")
        if flat.ndim != 2 or flat.shape[1] != size or bias is None or tuple(bias.shape) != (len(flat),):
            raise ValueError(
                f"{path}: expected {name} of {size} inputs with a bias (the layer before, or the Gaussians, has {size} "
                f"channels), got {list(weight.shape)}; is this decoder of another run?"
            )
        layers.append((flat, bias))
        size = len(flat)
    if not layers:
        known = ", ".join(list(state)[:6]) or "no tensor"
        raise ValueError(f"{path}: expected layers named {pattern}, got {known}; give the file with the decoder")
    return Perceptron(layers)
