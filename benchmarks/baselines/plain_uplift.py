"""Plain uplift, as LUDVIG does it: the mean feature of all pixels that show a Gaussian, by rendering weight. No training."""

from __future__ import annotations

from dataclasses import dataclass

from kfgs.fields import UpliftConfig, uplift_maps

from .common import FLOAT, Clock, Fitted, Task
from .methods import LinearDecoder, RenderedMethod


@dataclass(frozen=True)
class PlainUpliftConfig:
    """kfgs's own average: no correction, every Gaussian kept, as linear latents."""

    pixels: int = 80_000
    """Most pixels of a working view."""
    keep: float = 0.995
    """Share of the features' variation that the latents hold."""

    @staticmethod
    def published() -> PlainUpliftConfig:
        """Views at the pictures' size, up to a million pixels, and all but a thousandth of the variation."""
        return PlainUpliftConfig(1_000_000, 0.999)

    @staticmethod
    def short() -> PlainUpliftConfig:
        """Views of 80,000 pixels."""
        return PlainUpliftConfig()

    medium = short


def storage_bytes(gaussians: int, latents: int, channels: int) -> int:
    """The latents, and the basis that decodes them."""
    return FLOAT * (gaussians * latents + latents * channels)


def fit(task: Task, config: PlainUpliftConfig) -> Fitted:
    """Average the maps onto a frozen cloud."""
    clock, options = Clock(), UpliftConfig(corrections=0, pixels=config.pixels, keep=config.keep)
    with clock.stage("uplift"):
        found = uplift_maps(
            task.frozen, task.cameras, task.maps, options, generator=task.generator(), progress=task.progress
        )
    basis, own = found.decoder.basis, found.gaussians.features
    assert own is not None
    method = RenderedMethod("plain uplift", found.gaussians, LinearDecoder(basis))
    storage = storage_bytes(len(own), own.shape[1], len(basis))
    tensors = {"features": own, "basis": basis}
    latents = found.decoder
    return Fitted(
        method,
        str(own.shape[1]),
        storage,
        tensors,
        clock.seconds,
        codec=lambda rows: latents.decode(latents.encode(rows)),
    )
