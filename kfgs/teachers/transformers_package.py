"""The package transformers: import it, silence it, and turn its errors into one line."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from .._card import error_line


def require_transformers() -> Any:
    """Import the package transformers; an ImportError if it is missing or broken.

    If torchvision is installed but does not import (built for another torch), every model class of transformers fails with
    a misleading message, so torchvision is checked first.
    """
    try:
        if importlib.util.find_spec("torchvision") is not None:
            importlib.import_module("torchvision")
    except Exception as error:  # RuntimeError: operator torchvision::nms does not exist, OSError, ...
        raise ImportError(
            f"torchvision: expected none, or the build that belongs to torch {torch.__version__}, got one that does not "
            f"import ({error_line(error)}), and transformers fails with it; run `pip uninstall torchvision` (kfgs does not "
            "need it), or install the build of this torch"
        ) from error
    try:
        return importlib.import_module("transformers")
    except Exception as error:  # missing, or broken, which may raise anything
        raise ImportError(
            f"transformers: expected it for this teacher, but it cannot be imported ({error_line(error)}); run "
            '`pip install --upgrade "kfgs[hf]"`'
        ) from error


def load_complete(name: str, source: Path | str, folder: Path | str | None, **options: Any) -> Any:
    """A model of transformers in float32, in evaluation mode, by `from_pretrained`, with every weight of it.

    Raises:
        ImportError: if transformers is missing, broken, or lacks the class `name`.
        ValueError: if weights are missing or of another shape: transformers would fill them with random values.
    """
    transformers = require_transformers()
    try:
        model_class = getattr(transformers, name)
    except Exception as error:
        raise ImportError(
            f"transformers: expected a version with {name}, got {transformers.__version__} ({error_line(error)}); run "
            '`pip install --upgrade "kfgs[hf]"`'
        ) from error
    with quiet(transformers):
        model, info = model_class.from_pretrained(folder, dtype=torch.float32, output_loading_info=True, **options)
    wrong = [str(key) for key in info["missing_keys"]] + [str(key[0]) for key in info["mismatched_keys"]]
    if wrong:
        raise ValueError(
            f"{source}: expected every weight of {name}, {len(wrong)} missing or of another shape, the first "
            f"{min(wrong)!r}; use weights and config of the same model"
        )
    return model.eval()


@contextmanager
def quiet(transformers: Any) -> Iterator[None]:
    """Turn off progress bars and warnings of transformers; `load_complete` reports missing weights better."""
    log = transformers.utils.logging
    level, bars = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        yield
    finally:
        log.set_verbosity(level)
        if bars:
            log.enable_progress_bar()


@contextmanager
def explained(kind: str, source: Path | str, what: str = "weights") -> Iterator[None]:
    """Turn transformers' errors while reading into one line that names the source."""
    try:
        yield
    except Exception as error:
        if str(error).startswith((f"{source}: ", "transformers: ", "torchvision: ")):  # of kfgs
            raise
        if isinstance(error, ImportError):  # sentencepiece, for instance
            raise ImportError(
                f"{source}: expected {what} of teacher {kind!r}, but a package is missing ({error_line(error)}); install it"
            ) from error
        where, advice = "they cannot be read", "download the whole repository again"
        if not isinstance(source, Path):
            where, advice = (
                "the hub cannot be reached (nor is it a local folder)",
                "download the folder and pass its path",
            )
        message = f"expected {what} of teacher {kind!r}, but {where} ({error_line(error)}); {advice}"
        raise ValueError(f"{source}: {message}") from error
