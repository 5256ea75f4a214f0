"""What lies in a folder, so that a state after a kill can be compared with the old one and with the new one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

TIMES = {"seconds", "saved", "mtime_ns", "time", "when", "elapsed", "bytes", "digest", "rate"}
"""Keys in JSON that tell when or how quickly something was made (and the digest of a file that tells it)."""

State = dict[str, str]


def state_of(folder: Path, loose: tuple[str, ...] = (), skip: tuple[str, ...] = ()) -> State:
    """A digest for each visible file by its name. Of `loose` files only what does not tell the time counts.

    Folders in `skip` are left out.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if any(part.startswith(".") for part in Path(name).parts) or any(name.startswith(f"{one}/") for one in skip):
            continue
        if path.is_file():
            found[name] = _loosely(path) if name.endswith(loose) and loose else _digest(path.read_bytes())
    return found


def hidden_in(folder: Path) -> list[str]:
    """Files and folders that begin with a dot, except locks, which stay on purpose."""
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
    return sorted(
        name for name in names if any(part.startswith(".") for part in Path(name).parts) and not name.endswith("lock")
    )


def field_state(folder: Path) -> str:
    """A digest of all numbers of a field, as its reader finds them; `none` if there is no field."""
    from kfgs.fields import SemanticField
    from kfgs.fields.store import find_field

    if find_field(folder) is None:
        return "none"
    field = SemanticField.load(folder)
    parts = [field.gaussians.means, field.gaussians.scales, field.gaussians.opacities, field.features]
    parts += field.decoder.to_tensors().values()
    rows = b"".join(part.contiguous().numpy().tobytes() for part in parts)
    return _digest(rows + json.dumps(_timeless(dict(field.info)), sort_keys=True, default=str).encode())


def _loosely(path: Path) -> str:
    """A file that tells the time: JSON without the times, of others that they are whole."""
    data = path.read_bytes()
    if path.suffix == ".json":
        return _digest(json.dumps(_timeless(json.loads(data)), sort_keys=True).encode())
    if path.suffix == ".html" and not data.rstrip().endswith(b"</html>"):
        return "half a page"
    if path.suffix == ".png":
        from PIL import Image

        with Image.open(path) as picture:
            picture.load()
    return "whole"


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(one) for key, one in value.items() if key not in TIMES}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
