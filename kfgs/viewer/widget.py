"""The viewer as a notebook widget: anywidget carries the scene and the calls through the kernel."""

from __future__ import annotations

import base64
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..splat import rasterize
from ..viz.pictures import as_bytes
from .html import pack_view
from .pack import as_jpeg
from .scripts import APP, inline_script, read_text
from .server import answer_call
from .session import Session
from .state import Exploration

if TYPE_CHECKING:
    from anywidget import AnyWidget

    from ..scenes import Scene

HEIGHT = 640  # CSS pixels
STILL = 800  # pixels: the longer edge of the picture where widgets cannot run
PALE = 0.6  # share of white in the grey of what a question did not select
START = """
export default {
  async render({ model, el }) {
    const root = document.createElement("div");
    root.style.height = `${model.get("height")}px`;
    root.dataset.lmSuppressShortcuts = "true"; // JupyterLab's keys would act on cells
    el.append(root);
    const raw = model.get("data");
    const bytes = new Uint8Array(raw.buffer, raw.byteOffset, raw.byteLength);
    const header = model.get("header");
    const packed = { header, data: await kfgs.inflate(bytes, header) };
    const link = new kfgs.PythonLink(kfgs.callWidget(model), header);
    const app = await kfgs.mount(root, packed, link);
    const ask = () => app.ask(model.get("question"));
    model.on("change:question", ask);
    return () => {
      model.off("change:question", ask);
      app.dispose();
    };
  },
};
"""


def require_widget() -> None:
    """Raise an ImportError with the install line if anywidget is missing."""
    try:
        import anywidget  # noqa: F401
    except ImportError:
        raise ImportError(
            'where: expected the package anywidget for a notebook, got none; pip install "kfgs[notebook]"'
        ) from None


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this program."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


def make_widget(
    exploration: Exploration,
    *,
    title: str = "kfgs",
    scene: Scene | None = None,
    out: str | Path = "kfgs_view",
    height: int = HEIGHT,
) -> AnyWidget:
    """The viewer of an exploration as a widget for Jupyter, VS Code and Colab; display it as a cell's last value.

    Where widgets cannot run, on a page of GitHub for instance, a picture from the first camera is shown.

    Args:
        exploration: the widget opens with its question, gamma, lambda and hidden classes; set `widget.question` to ask another.
        title: shown in the widget.
        scene: as in `save_html`.
        out: folder for files that are saved from the widget, on the kernel's machine.
        height: CSS pixels.

    Raises:
        ImportError: if anywidget is missing.
    """
    require_widget()
    import anywidget
    import traitlets

    session = Session(exploration, out)
    packed = pack_view(exploration, title=title, scene=scene)

    class Viewer(anywidget.AnyWidget):  # type: ignore[misc]
        """The viewer; see `make_widget`."""

        _esm = inline_script(APP) + START
        _css = read_text("app.css")
        header = traitlets.Dict().tag(sync=True)
        data = traitlets.Bytes().tag(sync=True)
        question = traitlets.Unicode().tag(sync=True)
        height = traitlets.Int().tag(sync=True)

        def _repr_mimebundle_(self, **options: Any) -> Any:
            found = super()._repr_mimebundle_(**options)
            bundle = found[0] if isinstance(found, tuple) else found
            if bundle is not None and exploration.cameras:
                bundle["image/jpeg"] = still(exploration)
            return found

    widget = Viewer(
        header=packed.header,
        data=packed.compressed(),
        question="" if exploration.asked is None else exploration.asked.words,
        height=height,
    )

    def answer(_: Any, message: Any, buffers: list[Any]) -> None:
        found, more = answer_call(session.call, lambda: (message, bytes(buffers[0]) if buffers else b""))
        widget.send({"id": message.get("id"), "answer": found}, [more])

    widget.on_msg(answer)
    return widget


def still(exploration: Exploration) -> str:
    """What the first camera sees, in the colours that the viewer opens with: a JPEG file in base64, as notebooks hold it.

    After a question, what it did not select is pale.
    """
    side = exploration.sides[-1]
    camera = exploration.cameras[0].fitted(STILL)
    cloud = exploration.cloud(side)
    if exploration.asked is not None or exploration.show != "rgb" or cloud.sh is None:
        colors = torch.from_numpy(exploration.colors(side)).to(cloud.means) / 255
        if exploration.asked is not None:
            rest = ~torch.from_numpy(exploration.selected(side)).to(colors.device)
            colors[rest] = PALE + (1 - PALE) * colors[rest].mean(dim=1, keepdim=True)
        cloud = cloud.replace(features=colors, sh=None)
    with torch.no_grad():
        picture = as_bytes(rasterize(cloud.replace(labels=None), camera, background=cloud.means.new_ones(3)).map)
    return base64.b64encode(as_jpeg(picture)).decode("ascii")
