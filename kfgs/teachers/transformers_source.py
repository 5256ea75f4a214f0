"""Where a teacher of transformers comes from: a folder as `save_pretrained` writes it, or a hub id."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from .._files import as_path, digest_file, digest_value, read_json
from .transformers_package import explained, quiet, require_transformers
from .transformers_table import TRANSFORMERS

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


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
    """The class of the model by config.json, one of the kind's, and the hub's commit (None for a folder)."""
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
    model_type = config.get("model_type") if isinstance(config, dict) else None
    expected = TRANSFORMERS[kind].models
    if model_type not in expected:
        others = [name for name, row in TRANSFORMERS.items() if model_type in row.models]
        hint = f"load it as teacher {' or '.join(map(repr, others))}" if others else "name the folder of such a model"
        raise ValueError(
            f"{source}: expected a model of type {' or '.join(map(repr, expected))} for teacher {kind!r}, got "
            f"{model_type!r}; {hint}"
        )
    return expected[model_type], None if isinstance(
        source, Path
    ) else file.parent.name  # .../snapshots/<commit>/config.json


def load_tokenizer_of(kind: str, source: Path | str, **options: Any) -> Any:
    """The tokenizer in the folder of the weights."""
    transformers = require_transformers()
    with explained(kind, source, "a tokenizer"), quiet(transformers):
        return transformers.AutoTokenizer.from_pretrained(source, trust_remote_code=False, **options)


def weights_of(source: Path | str, commit: str | None = None) -> str:
    """The identity of weights: a digest of the files of a folder (or of one file), or the hub's commit."""
    if isinstance(source, str):
        return f"commit {commit}"
    folder = source if source.is_dir() else source.parent
    weights = [source] if source.is_file() else sorted(source.glob("*.safetensors")) or sorted(source.glob("*.bin"))
    configs = [folder / name for name in ("config.json", "open_clip_config.json")]
    return digest_value([[file.name, digest_file(file)] for file in [*configs, *weights] if file.is_file()])
