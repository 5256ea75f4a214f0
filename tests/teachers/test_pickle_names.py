import argparse
import functools
import io
import operator
import pickle
import re
import signal
from pathlib import Path

import numpy as np
import pytest

from kfgs.teachers.pickle_names import is_unsafe, is_unsafe_attribute
from kfgs.teachers.pickles import BrokenPickleError, Global, Inert, UnsafePickleError, read_pickle


@pytest.mark.parametrize(
    "name",
    [
        "argparse.Namespace",
        "pathlib.PosixPath",
        "functools.partial",
        "types.SimpleNamespace",
        "io.BytesIO",
        "datetime.datetime",
        "builtins.set",
        "builtins.slice",
        "__builtin__.object",
        "copyreg._reconstructor",
        "__main__.Config",
        "torch.device",
        "torch.nn.modules.linear.Linear",
        "numpy.core.multiarray.scalar",
        "numpy.dtype",
        "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint",
        "omegaconf.dictconfig.DictConfig",
        "modules.lseg_module.LSegModule",
        "timm.models.vision_transformer.VisionTransformer",
        "numpy.random._pickle.__generator_ctor",
        "numpy._core.numeric._frombuffer",
        "_codecs.encode",
        "re._compile",
        "signal.Signals",
        "uuid.UUID",
        "logging.getLogger",
        "torch.serialization._get_layout",
        "torch._dynamo.eval_frame.OptimizedModule",
        "lightning.fabric.plugins.io.torch_io.TorchCheckpointIO",
        "lightning.pytorch.strategies.launchers.multiprocessing._MultiProcessingLauncher",
        "torchvision.io.image.ImageReadMode",
        "project.eval.Metric",
        "project.test.Dataset",
        "builtins.getattr",
        "__builtin__.getattr",
        "operator.itemgetter",
        "operator.attrgetter",
        "_operator.or_",
        "types.GenericAlias",
    ],
)
def test_settings_are_not_taken_for_attacks(name: str) -> None:
    assert not is_unsafe(name)


@pytest.mark.parametrize(
    "name",
    [
        *("os.system", "posix.system", "nt.system", "subprocess.Popen", "sys.modules", "pty.spawn", "runpy.run_path"),
        *(
            "shutil.rmtree",
            "socket.socket",
            "webbrowser.open",
            "importlib.import_module",
            "ctypes.CDLL",
            "pickle.loads",
        ),
        *(
            "builtins.eval",
            "builtins.exec",
            "builtins.compile",
            "builtins.open",
            "builtins.__import__",
        ),
        *(
            "__builtin__.eval",
            "builtins.object.__class__.getattr",
            "operator.methodcaller",
            "_operator.call",
            "types.FunctionType",
            "io.open",
        ),
        *(
            "torch.serialization.os.system",
            "collections.sys.modules",
            "torch.__dict__",
            "numpy.f2py.subprocess.run",
            "code.interact",
        ),
    ],
)
def test_attacks_are_known_by_name(name: str) -> None:
    assert is_unsafe(name)
    module, _, last = name.rpartition(".")
    with pytest.raises(UnsafePickleError, match=name):
        read_pickle(io.BytesIO(f"c{module}\n{last}\n.".encode()), {})


KNOWN_ATTACKS = [
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


@pytest.mark.parametrize("name", KNOWN_ATTACKS)
def test_dangerous_words_count_anywhere_in_the_path(name: str) -> None:
    """However module and path are divided: `c` writes them as `torch` and `os.system`, or `torch.os` and `system`."""
    assert is_unsafe(name)
    words = name.split(".")
    for i in range(1, len(words)):
        with pytest.raises(UnsafePickleError, match=re.escape(name)):
            read_pickle(io.BytesIO(f"c{'.'.join(words[:i])}\n{'.'.join(words[i:])}\n.".encode()), {})


class Outer:
    class Inner:
        class Deep:
            pass

    def method(self) -> None:
        pass

    @classmethod
    def apply(cls) -> None:
        pass


class Keywords:
    """Is made by a call of `partial(cls.__new__, cls, a=2)` before protocol 4."""

    def __new__(cls, *, a: int = 1) -> "Keywords":
        return object.__new__(cls)

    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, int]]:
        return (), {"a": 2}


class Settings:  # stands for `Namespace`
    def __init__(self, value: object) -> None:
        self.value = value


HONEST = {
    "nested class": Outer.Inner,
    "class in it": Outer.Inner.Deep,
    "its instance": Outer.Inner(),
    "method": Outer().method,
    "class method": Outer.apply,
    "method of a type": str.upper,
    "item": operator.itemgetter(1),
    "items": operator.itemgetter("name", "os"),
    "attribute": operator.attrgetter("lr.value"),
    "partial": functools.partial(print, 1),
    "alias": list[int],
    "union": int | str,
    "keywords": Keywords(),
    "scalar": np.float32(2),
    "generator": np.random.default_rng(0),
    "random state": np.random.RandomState(0),
    "namespace": argparse.Namespace(lr=1),
    "method of a text": "a".join,
    "signal": signal.SIGTERM,
    "regular expression": re.compile("a"),
}


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", HONEST)
def test_what_settings_hold_is_inert(kind: str, protocol: int) -> None:
    body = pickle.dumps({"a": 1, "settings": Settings(HONEST[kind])}, protocol)
    found = read_pickle(io.BytesIO(body), {})
    assert found["a"] == 1
    assert isinstance(found["settings"], Inert)


@pytest.mark.parametrize("protocol", [2, 4])
def test_getattr_of_a_global_is_the_name_of_another(protocol: int) -> None:
    found = read_pickle(io.BytesIO(pickle.dumps(Outer.Inner.Deep, protocol)), {})
    assert isinstance(found, Global)
    assert found.name == f"{__name__}.Outer.Inner.Deep"


GETATTR = b"cbuiltins\ngetattr\n"
PARTIAL = b"cfunctools\npartial\n(cbuiltins\nlen\ntR"
ATTACKS = {
    "module of a module": (GETATTR + b"(ctorch\nserialization\nVos\ntR.", "torch.serialization.os"),
    "through a module": (GETATTR + b"(ctorch\nos\nVsystem\ntR.", "torch.os"),
    "protocol 4": (b"\x80\x04\x8c\x05torch\x8c\x09os.system\x93.", "torch.os.system"),
    "module on the way": (b"\x80\x04\x8c\x05torch\x8c\x0bshutil.move\x93.", "torch.shutil.move"),
    "of a call's result": (GETATTR + b"(cpathlib\nPath\n)RV__class__\ntR.", "pathlib.Path.__class__"),
    "dotted": (GETATTR + b"(ctorch\nx\nVa.__globals__\ntR.", "torch.x.a.__globals__"),
    "computed": (GETATTR + b"(ctorch\nx\ncoperator\nadd\n(Vo\nVs\ntRtR.", "builtins.getattr of a name"),
    "handed to partial": (b"cfunctools\npartial\n(" + GETATTR + b"ctorch\nx\ntR.", "builtins.getattr"),
    "by reduce": (b"cfunctools\nreduce\n(" + GETATTR + b"(Vos\nVsystem\nlctorch\nx\ntR.", "builtins.getattr"),
    "attrgetter": (b"coperator\nattrgetter\n(Vname\nVos.system\ntR.", "os.system"),
    "by new": (b"\x80\x02" + GETATTR + b"(ctorch\nx\nVos\nt\x81.", "torch.x.os"),
    "as obj": (b"(" + GETATTR + b"ctorch\nx\nVos\no.", "torch.x.os"),
    "as inst": (b"(ctorch\nx\nVos\ni__builtin__\ngetattr\n.", "torch.x.os"),
    "through an alias": (GETATTR + b"(crandom\nRandom\nV_os\ntR.", "random.Random._os"),
    "spawn": (GETATTR + b"(ctorch\nx\nVspawnlp\ntR.", "torch.x.spawnlp"),
    "torch.load in two": (GETATTR + b"(ctimm\ntorch\nVload\ntR.", "timm.torch.load"),
    "attrgetter of an alias": (b"coperator\nattrgetter\n(V_os.spawnlp\ntR.", "_os.spawnlp"),
    "attrgetter called": (b"coperator\nattrgetter\n(Va\ntR(ctorch\nx\ntR.", "operator.attrgetter, called"),
    "itemgetter called": (b"coperator\nitemgetter\n(Va\ntR(ctorch\nx\ntR.", "operator.itemgetter, called"),
    "many attributes": (
        b"coperator\nattrgetter\n(" + b"Va\n" * 65 + b"tR.",
        "operator.attrgetter of a name that it hides",
    ),
    "no attributes": (GETATTR + b"(ctorch\nx\ntR.", "builtins.getattr of a name that it hides"),
    "arguments not made": (b"\x80\x04" + GETATTR + b"\x8fR.", "builtins.getattr of a name that it hides"),
    "given to an inert": (b"cfunctools\npartial\n)R(Vsystem\ntR.", "system"),
    "in a state": (PARTIAL + b"(" + GETATTR + b"(ctorch\nx\nt}}tb.", "builtins.getattr"),
    "as a state": (PARTIAL + GETATTR + b"b.", "builtins.getattr"),
    "attrgetter in a state": (PARTIAL + b"(coperator\nattrgetter\n)}}tb.", "operator.attrgetter"),
    "in a nested tuple": (b"\x80\x02cfunctools\nreduce\n(" + GETATTR + b"Va\n\x86tR.", "builtins.getattr"),
    "in a tuple of one": (b"\x80\x02" + GETATTR + b"\x85.", "builtins.getattr"),
    "in a tuple of three": (b"\x80\x02NN" + GETATTR + b"\x87.", "builtins.getattr"),
    "in a list": (b"]" + GETATTR + b"a.", "builtins.getattr"),
    "in a longer list": (b"](N" + GETATTR + b"e.", "builtins.getattr"),
    "in a marked list": (b"(" + GETATTR + b"l.", "builtins.getattr"),
    "in a dict": (b"}Va\n" + GETATTR + b"s.", "builtins.getattr"),
    "in a longer dict": (b"}(Va\n" + GETATTR + b"u.", "builtins.getattr"),
    "as a key": (b"(" + GETATTR + b"Nd.", "builtins.getattr"),
    "in a set": (b"\x80\x04\x8f(" + GETATTR + b"\x90.", "builtins.getattr"),
    "in a frozen set": (b"\x80\x04(" + GETATTR + b"\x91.", "builtins.getattr"),
    "from the memo": (GETATTR + b"p0\n0]g0\na.", "builtins.getattr"),
    "to obj": (b"(cfunctools\npartial\n" + GETATTR + b"o.", "builtins.getattr"),
    "to inst": (b"(" + GETATTR + b"ifunctools\npartial\n.", "builtins.getattr"),
    "as keywords": (b"\x80\x04cfunctools\npartial\n)" + GETATTR + b"\x92.", "builtins.getattr"),
    "as a persistent id": (b"\x80\x02" + GETATTR + b"Q.", "builtins.getattr"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_ways_around_a_name_are_refused(attack: str) -> None:
    body, name = ATTACKS[attack]
    with pytest.raises(UnsafePickleError, match=re.escape(name)):
        read_pickle(io.BytesIO(body), {})


def test_a_whole_chain_would_have_run(tmp_path: Path) -> None:
    """`getattr(getattr(torch.serialization, "os"), "mkdir")(...)`: elsewhere it runs, here it is refused by its name."""
    marker = tmp_path / "ran"
    module = GETATTR + b"(ctorch\nserialization\nVos\ntR"
    body = GETATTR + b"(" + module + b"Vmkdir\ntR(V" + str(marker).encode() + b"\ntR."
    pickle.loads(body)
    assert marker.exists()
    with pytest.raises(UnsafePickleError, match=r"torch\.serialization\.os"):
        read_pickle(io.BytesIO(body), {})


@pytest.mark.parametrize("path", ["Inner", "apply", "types", "compile", "upper", "lr.value", "__init__"])
def test_attributes_of_classes_are_let_be(path: str) -> None:
    assert not is_unsafe_attribute(path)


def test_a_partial_rebuilt_from_its_state_would_have_run(tmp_path: Path) -> None:
    """`partial(len)` gets the state of `partial(getattr, torch.os)`, then "mkdir": a known attack on lists of names."""
    marker = tmp_path / "ran"
    state = b"(" + GETATTR + b"(cshutil\nos\nt}}tb"
    body = PARTIAL + state + b"(Vmkdir\ntR(V" + str(marker).encode() + b"\ntR."
    pickle.loads(body)
    assert marker.exists()
    with pytest.raises(UnsafePickleError, match=r"builtins\.getattr"):
        read_pickle(io.BytesIO(body.replace(b"cshutil\nos", b"ctorch\nnn")), {})


def test_calls_of_inert_objects_have_few_arguments() -> None:
    body = b"cfunctools\npartial\n)R(" + b"N" * 65 + b"tR."
    with pytest.raises(BrokenPickleError, match="calls something with more than 64 arguments"):
        read_pickle(io.BytesIO(body), {})
