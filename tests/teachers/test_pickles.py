import io
import pickle
import struct
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kfgs.teachers import pickles
from kfgs.teachers.pickles import BrokenPickleError, Global, Inert, read_pickle, string_items

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


def test_too_many_opcodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "_STEPS", 10)
    assert read_pickle(io.BytesIO(b"(" * 8 + b"N."), {}) is None
    with pytest.raises(BrokenPickleError, match="more than 10 opcodes"):
        read_pickle(io.BytesIO(b"(" * 9 + b"N."), {})


def test_no_end() -> None:
    with pytest.raises(BrokenPickleError, match="STOP"):
        read_pickle(io.BytesIO(b"N"), {})


# --- work and memory: what one memoised object could multiply ---------------------------------------------------------------


def unicode(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text.encode()


def test_a_list_given_to_many_calls_is_refused_after_as_many_copies_as_opcodes() -> None:
    """200 pairs of 3 opcodes: three calls copy fewer elements than there were opcodes, four more."""
    pairs = b"".join(unicode(f"{i:03}") + b"N\x86" for i in range(200))
    calls = lambda n: b"\x80\x02](" + pairs + b"eq\x000(" + b"ccollections\nOrderedDict\nh\x00\x85R" * n + b"l."  # noqa: E731
    builders = {"collections.OrderedDict": lambda pairs: string_items(pairs)}
    assert [len(made) for made in read_pickle(io.BytesIO(calls(3)), builders)] == [200] * 3
    with pytest.raises(BrokenPickleError, match="it copies one list many times"):
        read_pickle(io.BytesIO(calls(4)), builders)


def test_a_long_tuple_of_arguments_is_not_unpacked() -> None:
    body = b"\x80\x02cbuiltins\ncomplex\n(" + b"N" * 65 + b"tR."
    assert isinstance(read_pickle(io.BytesIO(body), {}), Inert)
    with pytest.raises(BrokenPickleError, match="more than 64 arguments"):
        read_pickle(io.BytesIO(body), {"builtins.complex": lambda *parts: parts})


def test_the_name_of_a_global_is_short() -> None:
    """Else two memoised texts of a megabyte are joined, and kept, by each five bytes."""
    body = lambda n: b"\x80\x04" + unicode("a" * (n - 3)) + unicode("bcd") + b"\x93."  # noqa: E731
    assert read_pickle(io.BytesIO(body(255)), {}).name == "a" * 252 + ".bcd"
    with pytest.raises(BrokenPickleError, match="names a global by more than 256 characters"):
        read_pickle(io.BytesIO(body(257)), {})
    with pytest.raises(BrokenPickleError, match="names a global by more than 256 characters"):
        read_pickle(io.BytesIO(b"c" + b"a" * 300 + b"\nb\n."), {})


def test_names_of_many_words_are_refused() -> None:
    """Each word is looked up, and five bytes name a global again."""
    assert read_pickle(io.BytesIO(b"c" + b"a." * 30 + b"a\nb\n."), {}).name == "a." * 31 + "b"
    with pytest.raises(BrokenPickleError, match="names a global by more than 32 words"):
        read_pickle(io.BytesIO(b"c" + b"a." * 31 + b"a\nb\n."), {})


def test_long_keys_are_left_out() -> None:
    value = {"k" * 4096: 1, "k" * 4097: 2}
    assert read_pickle(io.BytesIO(pickle.dumps(value)), {}) == {"k" * 4096: 1}


def test_memory_is_in_proportion_to_the_bytes() -> None:
    """100 kB of each opcode that makes something from one byte, and of calls: below 90 bytes of memory for each."""
    call = unicode("a" * 120) + b"q\x000" + unicode("b" * 120) + b"q\x010" + b"h\x00h\x01\x93" * 20_000
    for many in (b"]" * 100_000, b"}" * 100_000, b"\x8f" * 100_000, b"(" * 100_000, b"N\x94" * 50_000, call):
        tracemalloc.start()
        read_pickle(io.BytesIO(b"\x80\x04" + many + b"N."), {})
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 90 * len(many), many[:1]


@pytest.mark.parametrize("function", [b"coperator\nattrgetter\n", b"cfunctools\npartial\n)R"])
def test_one_memoised_tuple_is_not_looked_through_again_and_again(function: bytes) -> None:
    """Attributes and arguments are compared with the dangerous names: 64 of them would be, for each three bytes."""
    body = function + b"p0\n0(" + b"Va\n" * 60 + b"tp1\n0" + b"g0\ng1\nR0" * 10 + b"N."
    with pytest.raises(BrokenPickleError, match="gives the same arguments many times"):
        read_pickle(io.BytesIO(body), {})
