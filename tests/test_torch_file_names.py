"""Names that attacks use, however they are reached: a file with them is refused in one line, or read without running it."""

import re
import sys
from pathlib import Path

import pytest
from pickled import archive, legacy, pickled, tensor, text

from kfgs._torch_files import TorchFileError, load_torch_file

NAMES = [
    "os.system",
    "posix.system",
    "nt.system",
    "subprocess.Popen",
    "sys.modules",
    "pty.spawn",
    "runpy.run_path",
    "shutil.rmtree",
    "socket.socket",
    "webbrowser.open",
    "importlib.import_module",
    "ctypes.CDLL",
    "pickle.loads",
    "builtins.eval",
    "builtins.exec",
    "builtins.compile",
    "builtins.open",
    "builtins.__import__",
    "__builtin__.eval",
    "builtins.object.__class__.getattr",
    "operator.methodcaller",
    "_operator.call",
    "types.FunctionType",
    "io.open",
    "torch.serialization.os.system",
    "collections.sys.modules",
    "torch.__dict__",
    "numpy.f2py.subprocess.run",
    "code.interact",
    "timm.models.os",
    "torch.os",
    "random._os",
    "tempfile._os.unlink",
    "tempfile._shutil.rmtree",
    "tempfile._io.open",
    "random._os.system",
    "zipfile.shutil.rmtree",
    "torch.serialization.pickle.loads",
    "logging.io.open",
    "torch.builtins.getattr",
    "pydoc.locate",
    "pydoc.pipepager",
    "_frozen_importlib._gcd_import",
    "_frozen_importlib_external.SourceFileLoader",
    "unittest.mock._importer",
    "_posixsubprocess.fork_exec",
    "distutils.spawn.spawn",
    "setuptools.distutils.spawn",
    "numpy.testing._private.utils.runstring",
    "torch.utils.cpp_extension.load_inline",
    "trace.Trace.run",
    "uuid._get_command_stdout",
    "torch.load",
    "torch.serialization.load",
    "torch.serialization._legacy_load",
    "timm.models.torch.load",
    "torch.hub.load",
    "numpy.load",
    "torch.utils.data.np.load",
    "dill.loads",
    "joblib.load",
    "cloudpickle.loads",
    "pandas.read_pickle",
    "codecs.open",
    "gzip.open",
    "pathlib.Path.open",
    "pathlib.Path.write_text",
    "pathlib.Path.unlink",
    "hydra.utils.instantiate",
    "torch.fx.graph_module.reduce_graph_module",
    "torch.types.FunctionType",
    "inspect.getattr_static",
    "pkgutil.resolve_name",
    "logging.config.listen",
]

GETATTR = b"cbuiltins\ngetattr\n"
PARTIAL = b"cfunctools\npartial\n(cbuiltins\nlen\ntR"
WAYS = {
    "module of a module": GETATTR + b"(ctorch\nserialization\nVos\ntR.",
    "through a module": GETATTR + b"(ctorch\nos\nVsystem\ntR.",
    "protocol 4": b"\x80\x04\x8c\x05torch\x8c\x09os.system\x93.",
    "module on the way": b"\x80\x04\x8c\x05torch\x8c\x0bshutil.move\x93.",
    "of a call's result": GETATTR + b"(cpathlib\nPath\n)RV__class__\ntR.",
    "dotted": GETATTR + b"(ctorch\nx\nVa.__globals__\ntR.",
    "computed": GETATTR + b"(ctorch\nx\ncoperator\nadd\n(Vo\nVs\ntRtR.",
    "handed to partial": b"cfunctools\npartial\n(" + GETATTR + b"ctorch\nx\ntR.",
    "by reduce": b"cfunctools\nreduce\n(" + GETATTR + b"(Vos\nVsystem\nlctorch\nx\ntR.",
    "attrgetter": b"coperator\nattrgetter\n(Vname\nVos.system\ntR.",
    "by new": b"\x80\x02" + GETATTR + b"(ctorch\nx\nVos\nt\x81.",
    "as obj": b"(" + GETATTR + b"ctorch\nx\nVos\no.",
    "as inst": b"(ctorch\nx\nVos\ni__builtin__\ngetattr\n.",
    "through an alias": GETATTR + b"(crandom\nRandom\nV_os\ntR.",
    "spawn": GETATTR + b"(ctorch\nx\nVspawnlp\ntR.",
    "torch.load in two": GETATTR + b"(ctimm\ntorch\nVload\ntR.",
    "attrgetter of an alias": b"coperator\nattrgetter\n(V_os.spawnlp\ntR.",
    "attrgetter called": b"coperator\nattrgetter\n(Va\ntR(ctorch\nx\ntR.",
    "itemgetter called": b"coperator\nitemgetter\n(Va\ntR(ctorch\nx\ntR.",
    "many attributes": b"coperator\nattrgetter\n(" + b"Va\n" * 65 + b"tR.",
    "no attributes": GETATTR + b"(ctorch\nx\ntR.",
    "arguments not made": b"\x80\x04" + GETATTR + b"\x8fR.",
    "given to an inert": b"cfunctools\npartial\n)R(Vsystem\ntR.",
    "in a state": PARTIAL + b"(" + GETATTR + b"(ctorch\nx\nt}}tb.",
    "as a state": PARTIAL + GETATTR + b"b.",
    "attrgetter in a state": PARTIAL + b"(coperator\nattrgetter\n)}}tb.",
    "in a nested tuple": b"\x80\x02cfunctools\nreduce\n(" + GETATTR + b"Va\n\x86tR.",
    "in a tuple of one": b"\x80\x02" + GETATTR + b"\x85.",
    "in a tuple of three": b"\x80\x02NN" + GETATTR + b"\x87.",
    "in a list": b"]" + GETATTR + b"a.",
    "in a longer list": b"](N" + GETATTR + b"e.",
    "in a marked list": b"(" + GETATTR + b"l.",
    "in a dict": b"}Va\n" + GETATTR + b"s.",
    "in a longer dict": b"}(Va\n" + GETATTR + b"u.",
    "as a key": b"(" + GETATTR + b"Nd.",
    "in a set": b"\x80\x04\x8f(" + GETATTR + b"\x90.",
    "in a frozen set": b"\x80\x04(" + GETATTR + b"\x91.",
    "from the memo": GETATTR + b"p0\n0]g0\na.",
    "to obj": b"(cfunctools\npartial\n" + GETATTR + b"o.",
    "to inst": b"(" + GETATTR + b"ifunctools\npartial\n.",
    "as keywords": b"\x80\x04cfunctools\npartial\n)" + GETATTR + b"\x92.",
    "as a persistent id": b"\x80\x02" + GETATTR + b"Q.",
}


def open_all(folder: Path, bodies: list[bytes]) -> set[str]:
    """Open each as both kinds of files; the names of modules that were imported meanwhile."""
    honest = folder / "honest.pt"
    honest.write_bytes(archive(pickled({"a": tensor(size=(1,))}), bytes(16)))
    load_torch_file(honest)  # torch imports some modules when it reads the first file
    modules = set(sys.modules)
    for i, body in enumerate(bodies):
        for container in (archive, legacy):
            path = folder / f"{i}.pt"
            path.write_bytes(container(body))
            try:
                load_torch_file(path)
            except TorchFileError as error:
                assert str(error).isprintable(), body  # noqa: PT017
                assert len(str(error)) < 300, body  # noqa: PT017
    return {name for name in set(sys.modules) - modules if not name.startswith("encodings.")}  # pickletools reads text


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_neither_called_nor_imported(tmp_path: Path, name: str) -> None:
    """However module and path are divided: `c` writes them as `torch` and `os.system`, or `torch.os` and `system`."""
    words = name.split(".")
    marker = tmp_path / "ran"
    splits = [(".".join(words[:i]), ".".join(words[i:])) for i in range(1, len(words))]
    call = b"(" + text(f"touch {marker}") + b"tR."
    assert not open_all(tmp_path, [f"c{module}\n{rest}\n".encode() + call for module, rest in splits])
    assert not marker.exists()


@pytest.mark.parametrize("way", WAYS)
def test_a_way_around_a_name_leads_nowhere(tmp_path: Path, way: str) -> None:
    body = re.sub(rb"V([^\n]*)\n", lambda found: text(found[1].decode()), WAYS[way])  # torch reads no opcode V
    assert not open_all(tmp_path, [body, WAYS[way]])
