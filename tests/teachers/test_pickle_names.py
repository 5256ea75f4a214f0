import functools
import io
import operator
import pickle
import re
from pathlib import Path

import pytest

from kfgs.teachers.pickle_names import is_unsafe, is_unsafe_attribute
from kfgs.teachers.pickles import Global, Inert, UnsafePickleError, read_pickle


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
        "timm.models.os",
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


class Outer:
    class Inner:
        class Deep:
            pass

    def method(self) -> None:
        pass

    @classmethod
    def apply(cls) -> None:
        pass


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
ATTACKS = {
    "module of a module": (GETATTR + b"(ctorch\nserialization\nVos\ntR.", "torch.serialization.os"),
    "through a module": (GETATTR + b"(ctorch\nos\nVsystem\ntR.", "torch.os.system"),
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
