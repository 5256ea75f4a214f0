"""Load a model of transformers: check the package, find the folder or hub id, and check that the weights fit."""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from .._card import error_line
from .._files import as_path, digest_file, digest_value, read_json
from .transformers_table import TRANSFORMERS

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


def require_transformers() -> Any:
    """Import the package transformers.

    If torchvision is installed but does not import (built for another torch), every model class of transformers fails with
    a misleading message, so torchvision is checked first.

    Raises:
        ImportError: if transformers is missing or broken, or torchvision is broken.
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
            f"transformers: expected it for the teachers {', '.join(TRANSFORMERS)}, but it cannot be imported "
            f'({error_line(error)}); run `pip install --upgrade "kfgs[hf]"`'
        ) from error


def find_class(transformers: Any, name: str, kind: str) -> Any:
    """A class of transformers; an ImportError if this version lacks it, or its imports fail."""
    try:
        return getattr(transformers, name)
    except Exception as error:
        version = getattr(transformers, "__version__", "one without a version")
        raise ImportError(
            f"transformers: expected a version with {name} for teacher {kind!r}, got {version} ({error_line(error)}); run "
            '`pip install --upgrade "kfgs[hf]"`'
        ) from error


def find_source(kind: str, source: str | Path) -> Path | str:
    """The path if it exists, else `source` as a hub id; a FileNotFoundError if it cannot be one."""
    path = as_path(source)
    if path.exists():
        return path
    if isinstance(source, str) and _HUB_ID.fullmatch(source):
        return source
    raise FileNotFoundError(
        f"{source}: expected the weights of teacher {kind!r} (a folder as save_pretrained writes it, or a hub id "
        "owner/name), got a path where nothing lies; check its name"
    )


def read_config(kind: str, source: Path | str, *, local_only: bool) -> tuple[str, str | None]:
    """The model type in config.json, one of the kind's, and the hub's commit (None for a folder)."""
    if isinstance(source, Path):
        file = source / "config.json"
        if not file.is_file():
            what = "a file" if source.is_file() else "a folder without config.json"
            raise FileNotFoundError(
                f"{source}: expected a folder as save_pretrained writes it (config.json and weights) for teacher {kind!r}, "
                f"got {what}; download the whole repository"
            )
    else:
        require_transformers()
        with explained(kind, source):
            from huggingface_hub import hf_hub_download  # comes with transformers

            file = Path(hf_hub_download(source, "config.json", local_files_only=local_only))
    config = read_json(file)
    found = config.get("model_type") if isinstance(config, dict) else None
    expected = TRANSFORMERS[kind].models
    if found not in expected:
        others = [name for name, row in TRANSFORMERS.items() if found in row.models]
        hint = f"load it as teacher {' or '.join(map(repr, others))}" if others else "name the folder of such a model"
        raise ValueError(
            f"{source}: expected a model of type {' or '.join(map(repr, expected))} for teacher {kind!r}, got "
            f"{found!r}; {hint}"
        )
    return found, None if isinstance(source, Path) else file.parent.name  # .../snapshots/<commit>/config.json


def load_model(kind: str, source: Path | str, model_type: str, commit: str | None, *, local_only: bool) -> Any:
    """The model in float32; every weight must come from the files, none from random initialisation."""
    transformers = require_transformers()
    name = TRANSFORMERS[kind].models[model_type][0]
    model_class = find_class(transformers, name, kind)
    with explained(kind, source), quiet(transformers):
        model, info = model_class.from_pretrained(
            source,
            dtype=torch.float32,
            output_loading_info=True,
            local_files_only=local_only,
            **_revision(commit),
        )
    refuse_gaps(source, name, info)
    return model.eval()


def load_tokenizer_of(kind: str, source: Path | str, commit: str | None, *, local_only: bool) -> Any:
    """The tokenizer in the folder of the weights."""
    transformers = require_transformers()
    with explained(kind, source, "a tokenizer"), quiet(transformers):
        return transformers.AutoTokenizer.from_pretrained(
            source, local_files_only=local_only, trust_remote_code=False, **_revision(commit)
        )


def refuse_gaps(source: Path | str, name: str, info: dict[str, Any]) -> None:
    """Raise a ValueError if weights were missing or of another shape: transformers would fill them with random values."""
    gaps = sorted(map(str, info.get("missing_keys") or ())) + sorted(
        str(entry[0] if isinstance(entry, (tuple, list)) else entry) for entry in info.get("mismatched_keys") or ()
    )
    if gaps:
        raise ValueError(
            f"{source}: expected every weight of {name}, {len(gaps)} missing or of another shape, the first {gaps[0]!r}; "
            "use weights and config of the same model"
        )


def weights_of(source: Path | str, commit: str | None = None) -> str:
    """The identity of weights: a digest of the files of a folder (or of one file), or the hub's commit."""
    if isinstance(source, str):
        return f"commit {commit}"
    folder = source if source.is_dir() else source.parent
    weights = [source] if source.is_file() else sorted(source.glob("*.safetensors")) or sorted(source.glob("*.bin"))
    configs = [folder / name for name in ("config.json", "open_clip_config.json")]
    return digest_value([[file.name, digest_file(file)] for file in [*configs, *weights] if file.is_file()])


@contextmanager
def quiet(transformers: Any) -> Iterator[None]:
    """Turn off progress bars and warnings of transformers; `refuse_gaps` reports missing weights better."""
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
    except ImportError as error:  # sentencepiece, for instance
        raise ImportError(
            f"{source}: expected {what} of teacher {kind!r}, but a package is missing ({error_line(error)}); install it"
        ) from error
    except Exception as error:
        if isinstance(source, Path):
            hint = "download the whole repository again"
            message = f"expected {what} of teacher {kind!r}, but they cannot be read"
        else:
            hint = "download the folder and pass its path"
            message = f"expected {what} of teacher {kind!r}, could not reach them on the hub (nor is it a local folder)"
        raise ValueError(f"{source}: {message} ({error_line(error)}); {hint}") from error


def _revision(commit: str | None) -> dict[str, str]:
    return {} if commit is None else {"revision": commit}
