"""Options of a training with changes in any of its parts, by one list of keywords."""

from dataclasses import fields, replace

from kfgs.fields import Densify, Rates, Training

DENSIFY = {field.name for field in fields(Densify)}
RATES = {field.name for field in fields(Rates)}


def changed(training: Training, **changes) -> Training:
    """Names are those of `Training`, `Rates` (with `_rate`: `scales_rate=0.01`) and `Densify`."""
    rates = {name: changes.pop(f"{name}_rate") for name in RATES if f"{name}_rate" in changes}
    densify = {name: changes.pop(name) for name in DENSIFY if name in changes}
    if densify:
        changes["densify"] = replace(training.densify, **densify)
    return replace(training, rates=replace(training.rates, **rates), **changes)
