"""A type in a signature leads to its page: `kfgs.gaussians.Gaussians` is shown as `kfgs.Gaussians`."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, child: nodes.TextElement) -> Any:
    """The place of a public name that a reference means by its last part; plain text for what has no page."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    name = target.rsplit(".", 1)[-1]
    domain = env.domains.python_domain
    for full in (f"kfgs.{name}", *sorted(known for known in domain.objects if known.endswith(f".{name}"))):
        entry = domain.objects.get(full)
        plain = node["reftype"] == "obj" and (target != name or entry is None or not name[:1].isupper())
        if entry is not None and not plain and entry.objtype in ("class", "function", "exception"):
            builder = app.builder
            place = builder.get_relative_uri(node.get("refdoc", env.docname), entry.docname) + "#" + entry.node_id
            return nodes.reference("", "", child.deepcopy(), internal=True, refuri=place)
    if target == f"kfgs.{name}":  # a page means a public name that has no page
        return None
    return child.deepcopy() if node["reftype"] in ("class", "obj", "data", "exc") else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
