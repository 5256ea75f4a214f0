import io
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kfgs.teachers import pickles
from kfgs.teachers.pickles import BrokenPickleError, Global, Inert, UnsafePickleError, is_unsafe, read_pickle

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: (
        st.lists(inner) | st.tuples(inner, inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner)
    ),
    max_leaves=20,
)


@settings(deadline=None)
@given(PLAIN, st.sampled_from([3, 4, 5]))  # before 3, bytes were calls
def test_plain_data_is_read_as_pickle_reads_it(value: object, protocol: int) -> None:
    source = io.BytesIO(pickle.dumps(value, protocol) + b"next")
    assert read_pickle(source, {}) == value
    assert source.read() == b"next"


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_old_protocols(protocol: int) -> None:
    value = {"a": [1, 2.5, None, True, (1, "é\n", 10**30)], "b": {"c": ()}}
    assert read_pickle(io.BytesIO(pickle.dumps(value, protocol)), {}) == value


def test_the_same_object_twice_is_one() -> None:
    shared = [1]
    a, b = read_pickle(io.BytesIO(pickle.dumps([shared, shared])), {})
    assert a is b


def test_calls_go_to_the_builders_and_nowhere_else() -> None:
    body = pickle.dumps([complex(1, 2), frozenset({1}), range(3)])
    built, frozen, inert = read_pickle(io.BytesIO(body), {"builtins.complex": lambda *parts: ("built", parts)})
    assert built == ("built", (1.0, 2.0))
    assert isinstance(frozen, Inert)
    assert isinstance(inert, Inert)
    assert inert.name == "builtins.range"


def test_a_global_is_only_a_name() -> None:
    found = read_pickle(io.BytesIO(pickle.dumps(int)), {})
    assert isinstance(found, Global)
    assert found.name == "builtins.int"


def test_keys_other_than_text_are_left_out() -> None:
    assert read_pickle(io.BytesIO(pickle.dumps({"a": 1, 2: 3, (4,): 5})), {}) == {"a": 1}


def test_persistent_ids_of_both_kinds() -> None:
    assert read_pickle(io.BytesIO(b"K\x07Q."), {}, lambda key: ("got", key)) == ("got", 7)
    assert read_pickle(io.BytesIO(b"Pkey\n."), {}, lambda key: ("got", key)) == ("got", "key")


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
            "builtins.getattr",
        ),
        *(
            "__builtin__.eval",
            "builtins.object.__class__.getattr",
            "operator.attrgetter",
            "types.FunctionType",
            "io.open",
        ),
        *("torch.serialization.os.system", "collections.sys.modules", "numpy.f2py.subprocess.run", "code.interact"),
    ],
)
def test_attacks_are_known_by_name(name: str) -> None:
    assert is_unsafe(name)
    module, _, last = name.rpartition(".")
    with pytest.raises(UnsafePickleError, match=name):
        read_pickle(io.BytesIO(f"c{module}\n{last}\n.".encode()), {})


def test_too_many_opcodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "_STEPS", 10)
    assert read_pickle(io.BytesIO(b"(" * 8 + b"N."), {}) is None
    with pytest.raises(BrokenPickleError, match="more than 10 opcodes"):
        read_pickle(io.BytesIO(b"(" * 9 + b"N."), {})


def test_no_end() -> None:
    with pytest.raises(BrokenPickleError, match="STOP"):
        read_pickle(io.BytesIO(b"N"), {})
