"""The page that shows the viewer: HTML with the style, the script, and what starts it."""

from __future__ import annotations

import html

from .scripts import APP, inline_script, read_text

# Nothing may be loaded: pictures and the worker are made in the page.
POLICY = "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; img-src blob: data:"
OFFLINE_START = """\
    const text = (id) => document.getElementById(id).textContent;
    const bytes = Uint8Array.from(atob(text("data")), (letter) => letter.charCodeAt(0));
    document.getElementById("data").remove();
    const header = JSON.parse(text("header"));
    const packed = { header, data: await kfgs.inflate(bytes, header) };
    window.viewer = await kfgs.mount(root, packed, new kfgs.OfflineLink(packed));"""
PYTHON_START = """\
    root.textContent = "Loading the scene…";
    const loaded = await fetch("pack").catch(() => null);
    root.textContent = "";
    if (!loaded?.ok) throw new Error("Python does not answer; its terminal says why.");
    const [header, data] = kfgs.readMessage(await loaded.arrayBuffer());
    const link = new kfgs.PythonLink(kfgs.callPage, header);
    const shown = loaded.headers.get("ETag"); // the scene may have been kept, and be outdated: then it is replaced
    const version = fetch("version").then((answer) => (answer.ok ? answer.text() : shown)).catch(() => shown);
    link.checked = version.then((text) => text === shown || new Promise(() => (sessionStorage.clear(), location.reload())));
    window.viewer = await kfgs.mount(root, { header, data }, link);"""
ROOT = '<div id="kfgs"></div>'
"""Holds the viewer, and shows that a page is one of kfgs."""
PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<link rel="icon" href="data:,">
<meta name="viewport" content="width=device-width, initial-scale=1">
{policy}
<title>{title}</title>
<style>
html, body {{ height: 100%; margin: 0; }}
{style}
</style>
</head>
<body>
{root}
{data}
<script>
{script}
addEventListener("DOMContentLoaded", async () => {{
  const root = document.getElementById("kfgs");
  try {{
{start}
  }} catch (error) {{
    if (!root.childElementCount) root.textContent = `This scene cannot be shown: ${{error.message}}`;
  }}
}});
</script>
</body>
</html>
"""


def document(title: str, start: str, data: str = "", policy: str = "") -> str:
    """The page: the viewer's script and style, and what starts it.

    Args:
        title: of the page.
        start: JavaScript that loads a scene and mounts the viewer in `root`.
        data: elements that it reads.
        policy: an element that says what may be loaded, where no server does.
    """
    parts = {"title": html.escape(title), "style": read_text("app.css"), "script": inline_script(APP)}
    return PAGE.format(root=ROOT, start=start, data=data, policy=policy, **parts)
