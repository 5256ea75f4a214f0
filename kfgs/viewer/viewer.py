"""`explore`, and `Viewer`: an exploration in the WebGL viewer, as a page, a notebook widget, or one file to share."""

from __future__ import annotations

import base64
import sys
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path, PureWindowsPath
from tempfile import TemporaryDirectory
from threading import Event
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from .._check import check_choice
from .._files import atomic_path
from ..cameras import Camera, as_cameras
from ..fields import SemanticField
from ..formats import read_splats
from ..gaussians import Gaussians
from ..labels import LabelSet
from ..labels.transfer import as_cloud
from ..scenes import Scene
from ..viz.films import show_cloud
from ..viz.pictures import check_suffix
from ..viz.plotter import has_display
from .meaning import FieldMeaning, Meaning, SplatMeaning
from .pack import as_jpeg, pack_scene
from .page import APP, document, inline_script, read_text
from .server import Call, PageServer, answer_call, pack_message
from .session import Session
from .shared import Shared
from .state import Exploration
from .things import pack_thing
from .window import Explorer

if TYPE_CHECKING:
    from anywidget import AnyWidget

Where = Literal["auto", "window", "browser", "notebook", "picture"]
STILL = 800  # pixels: the longer edge of the picture where widgets cannot run
PALE = 0.6  # share of white in the grey of what a question did not select


def explore(
    source: SemanticField | Gaussians,
    color: Gaussians | None = None,
    *,
    classes: LabelSet | None = None,
    cameras: Sequence[Camera] = (),
    embed: Callable[[str], Tensor] | None = None,
    distance: float | None = None,
    where: Where = "auto",
    out: str | Path = "kfgs_view",
    height: int = 640,
) -> Explorer | Viewer:
    """Explore a scene: search by text, change gamma and lambda, pick and select Gaussians, edit, save.

    A selection in the semantic cloud also lights up in the colour cloud: each colour Gaussian takes the label of the
    nearest semantic one within lambda (Sec. 3.4). A window and a picture are drawn by pyvista (`Explorer`), with both clouds
    side by side, a page and a notebook by the browser (`Viewer`).

    Args:
        source: a semantic field (search by text) or a labelled splat (search by class).
        color: the colour scene, in the same frame; None shows the source alone.
        classes: names and embeddings in the teacher's space; None: those that the field remembers. A splat has its own.
        cameras: views to look from; empty: the field's own. A field without fused features computes them from these.
        embed: the teacher's text encoder, text -> [D], to search for more than the classes.
        distance: lambda, world units; None: from the clouds' spacing.
        where: `window` (blocks until you close it), `browser` (a page that only this machine can open; blocks until
            Ctrl-C), `notebook` (a widget, as the last value of a cell), or `picture` (opens nothing). `auto`: the notebook if
            there is one, else the browser if there is a display, else a picture.
        out: folder for saved pictures and selections.
        height: of the window or the widget, pixels.

    Raises:
        ImportError: if anywidget is missing for `notebook`.
        RuntimeError: if nothing can be drawn here, or there is no display for a window.
    """
    check_choice("where", where, ("auto", "window", "browser", "notebook", "picture"))
    if where == "auto":
        where = "notebook" if in_notebook() else "browser" if has_display() else "picture"
    if where == "notebook":
        require_widget()
    meaning: Meaning
    cameras = as_cameras(cameras or getattr(source, "cameras", ()))
    if isinstance(source, SemanticField):
        meaning = FieldMeaning(source, classes, cameras=cameras, embed=embed)
    else:
        meaning = SplatMeaning(as_cloud(source, "source"))
        if classes is not None or embed is not None:
            raise ValueError("classes, embed: expected none with a splat, which has its own, got one; leave it out")
    color = None if color is None else as_cloud(color, "color")
    state = Exploration(meaning, color, cameras=cameras, distance=distance)
    if where in ("browser", "notebook"):
        state.set_show(state.first_show)
        viewer = Viewer(state, out=out, height=height)
        if where == "browser":
            viewer.serve()
        return viewer
    explorer = Explorer(state, out=out, height=height, off_screen=where != "window")
    if where == "window":
        explorer.show()
    return explorer


class Viewer(Shared):
    """The WebGL viewer of an exploration. As the last value of a notebook's cell it is a widget.

    `question`, `gamma`, `distance`, `hidden`, `side`, `selection`, `edits`, `picked`, `tape` and `camera` are what a person sees
    in the widget. Set one, and the widget shows it, also if it is drawn later; `viewer.observe(act, "selection")` calls
    `act(change)` when one changes (traitlets). A page of its own opens with the state's question, gamma, lambda and colours;
    after that, page and Python are independent. `scene` has the photos of the cameras, found by name; `out` is the folder for
    files, on the machine of this program; `height` of the widget is in CSS pixels.

    `viewer.gamma = 0.6` moves the slider, and `splat[viewer.selection]` is what was selected by hand or by the question.
    """

    def __init__(
        self,
        exploration: Exploration,
        *,
        title: str = "kfgs",
        scene: Scene | None = None,
        out: str | Path = "kfgs_view",
        height: int = 640,
    ) -> None:
        super().__init__(exploration)
        self.title, self.scene, self.height = title, scene, height
        self.session = Session(exploration, out)
        self._widget: Any = None

    def ask(self, words: str | None) -> None:
        """Set `question`: search for a class or a phrase; None clears the search. A selection by hand goes."""
        self.change("question", words)

    def add(self, name: str, thing: Any, *, color: Any = None) -> None:
        """Show something with the scene: in the widget at once, in a page and an exported file that are made afterwards.

        Points and meshes are hidden by Gaussians in front of them, and hide those behind; boxes and labels stand over
        the picture. Places are in the world.

        Args:
            name: its name; a thing of this name is replaced.
            thing: points [N, 3]; a mesh, of pyvista (`PolyData`) or with `vertices` and `faces` (trimesh); `Part`, `OrientedBox`
                or a list of them; or one place [3], where the name is written.
            color: of points or a mesh: "#c04040", a CSS name, or [N, 3], bytes or in [0, 1]. None: its own, or blue.

        Raises:
            ValueError, TypeError: if it cannot be shown.
        """
        self.state.things[str(name)] = pack_thing(thing, color, self.state.cloud("semantic").origin)
        self.tell()

    def remove(self, name: str) -> None:
        """Show something no more that was added; a ValueError if nothing has this name."""
        check_choice("name", name, self.state.things)
        del self.state.things[name]
        self.tell()

    def tell(self) -> None:
        """Show in the widget what was set; it does so by itself."""
        if self._widget is not None:
            wire = {part: value for part, value in self.wire.items() if part != "view"}
            self._widget.wire, self._widget.view = wire, self.wire["view"]  # a moving camera sends the second alone
            self._widget.things = dict(self.state.things)

    def serve(self, host: str = "127.0.0.1", port: int = 0, *, report: Callable[[str], object] | None = None) -> None:
        """Open the page in the browser, and serve it until Ctrl-C.

        Args:
            host: address to listen on. With one that other machines can reach, everyone who has the link can look and save.
            port: 0: a free one.
            report: called with the link and hints, line by line; None: standard error.
        """
        say = report or (lambda line: sys.stderr.write(line + "\n"))
        with self.open_page(host, port) as page:
            say(f"the viewer is open at {page.url}")
            if not page.local:
                say(
                    "note: everyone who reaches this address and has the link can look, and save pictures and selections into "
                    f"{self.session.out}; nothing on the way is encrypted"
                )
            say("Ctrl-C ends it; closing the tab does not")
            if has_display():  # without a display, Python would open a browser in the terminal
                webbrowser.open(page.url)
            with suppress(KeyboardInterrupt):
                Event().wait()

    def open_page(self, host: str = "127.0.0.1", port: int = 0) -> PageServer:
        """Serve the page from a thread: `url` of the result is its link, `close()` ends it. Otherwise as `serve`."""
        return PageServer(*self._served(), host, port, open_file=self._open_file)

    def _served(self) -> tuple[str, bytes, Call]:
        packed = pack_message(*pack_scene(self.state, title=self.title, scene=self.scene))
        return document(self.title), packed, self.session.call

    def _open_file(self, name: str, content: bytes) -> tuple[str, bytes, Call]:
        """Serve the Gaussians of a file that a person dropped on the page; nothing of it stays on the disk."""
        name = PureWindowsPath(name).name or "file"  # without folders of any system
        with TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            try:
                state = Exploration(SplatMeaning(read_splats(path)))
            except ValueError as error:
                raise ValueError(str(error).replace(str(path), name)) from None
        state.set_show(state.first_show)
        return Viewer(state, title=Path(name).stem, out=self.session.out)._served()

    def save_html(self, path: str | Path) -> Path:
        """Write one file with the scene and the viewer, which opens in any browser with a double click, offline.

        Classes can be searched, gamma and lambda changed, Gaussians selected and edited. New phrases need Python.
        """
        target = check_suffix(path, ".html")
        with atomic_path(target) as temporary:
            packed = pack_scene(self.state, title=self.title, scene=self.scene)
            temporary.write_text(document(self.title, packed), encoding="utf-8")
        return target

    @property
    def widget(self) -> AnyWidget:
        """The notebook widget (anywidget), made when it is first wanted. Where widgets cannot run, it is a picture."""
        if self._widget is not None:
            return self._widget
        require_widget()
        import anywidget
        import traitlets

        state, session = self.state, self.session
        packed = pack_scene(state, title=self.title, scene=self.scene)

        class Widget(anywidget.AnyWidget):  # type: ignore[misc]
            _esm = inline_script(APP) + "export default { render: kfgs.startWidget };\n"
            _css = read_text("app.css")
            header = traitlets.Dict().tag(sync=True)
            data = traitlets.Bytes().tag(sync=True)
            wire = traitlets.Dict().tag(sync=True)
            view = traitlets.Dict().tag(sync=True)
            things = traitlets.Dict().tag(sync=True)
            height = traitlets.Int().tag(sync=True)

            def _repr_mimebundle_(self, **options: Any) -> Any:
                made = super()._repr_mimebundle_(**options)
                bundle = made[0] if isinstance(made, tuple) else made
                if bundle is not None and state.cameras:
                    bundle["image/jpeg"] = still(state)
                return made

        header = packed.header | {"things": {}}  # they have a trait of their own
        self._widget = widget = Widget(header=header, data=packed.compressed(), height=self.height)
        self.tell()
        widget.observe(lambda change: self.hear(change["new"]), "wire")
        widget.observe(lambda change: self.hear({"view": change["new"]}), "view")

        def answer(_: Any, message: Any, buffers: list[Any]) -> None:
            answered, more = answer_call(session.call, lambda: (message, b"".join(buffers)))
            widget.send({"id": message.get("id"), "answer": answered}, [more])

        widget.on_msg(answer)
        return widget

    def close(self) -> None:
        """Close the widget, if there is one."""
        if self._widget is not None:
            self._widget.close()

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)


def require_widget() -> None:
    """Raise an ImportError with the install line if anywidget is missing."""
    if find_spec("anywidget") is None:
        raise ImportError('where: expected anywidget for a notebook, got none; pip install "kfgs[notebook]"')


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this program."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


def still(state: Exploration) -> str:
    """What the first camera sees, a JPEG file in base64, as notebooks hold it; what a question did not select is pale."""
    side, camera = state.sides[-1], state.cameras[0].fitted(STILL)
    cloud, colors = state.cloud(side), state.colors(side)
    if state.asked is not None:
        rest = ~state.selected(side)
        colors = colors.copy()  # the state keeps its own
        colors[rest] = 255 * PALE + (1 - PALE) * colors[rest].mean(axis=1, keepdims=True)
    own = state.asked is None and state.show == "rgb" and cloud.sh is not None
    draw = show_cloud(cloud, color_by="rgb" if own else colors)
    return base64.b64encode(as_jpeg(draw(camera))).decode("ascii")
