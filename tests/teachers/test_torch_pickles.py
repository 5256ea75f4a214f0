import pytest
import torch

from kfgs.teachers.pickles import BrokenPickleError, Global
from kfgs.teachers.torch_pickles import Entry, Storage, Storages, Views

FLOATS = Storage("0", torch.float32, 5)
WHOLE = Entry(FLOATS, 0, (5,), (1,))


def make_file(first: int) -> torch.UntypedStorage:
    """64 bytes, with the floats 0, 1, 2, 3, 4 from byte `first`."""
    file = torch.zeros(64, dtype=torch.uint8)
    file[first : first + 20] = torch.arange(5.0).view(torch.uint8)
    return file.untyped_storage()


@pytest.mark.parametrize("first", [0, 4, 1, 7, 44])
def test_a_tensor_is_a_view_where_its_bytes_are_aligned(first: int) -> None:
    file = make_file(first)
    views = Views(file)
    found = views.tensor(WHOLE, first, 20)
    assert found.tolist() == [0, 1, 2, 3, 4]
    assert (found.data_ptr() == file.data_ptr() + first) == (first % 4 == 0)
    assert views.copied == (0 if first % 4 == 0 else 20)


def test_what_shared_a_misaligned_storage_shares_its_copy() -> None:
    views = Views(make_file(3))
    found = views.tensor(WHOLE, 3, 20)
    strided = views.tensor(Entry(FLOATS, 1, (2,), (2,)), 3, 20)
    view = views.tensor(Entry(Storage("0", torch.float32, 2, offset=3), 1, (1,), (1,)), 3, 20)  # as before torch 0.4
    assert (strided.tolist(), view.tolist()) == ([1, 3], [4])
    found.mul_(10)
    assert (strided.tolist(), view.tolist()) == ([10, 30], [40])
    assert views.copied == 20


def test_copies_are_never_larger_than_the_file() -> None:
    """Records of a zip archive may overlap: 64 bytes hold three storages of 20, and no fourth."""
    views = Views(make_file(1))
    for first in (1, 2, 3):
        views.tensor(WHOLE, first, 20)
    with pytest.raises(BrokenPickleError, match="lies in a storage that overlaps others"):
        views.tensor(WHOLE, 5, 20)


def test_the_key_of_a_storage_is_short() -> None:
    """Long equal keys would be compared by every tensor."""
    key = lambda n: ("storage", Global("torch.FloatStorage"), "1" * n, "cpu", 4)  # noqa: E731
    assert Storages()(key(256)).numel == 4
    with pytest.raises(BrokenPickleError, match="storage of unknown type"):
        Storages()(key(257))


@pytest.mark.parametrize(("size", "stride"), [((5, 2), (1, 0)), ((3, 3), (1, 1))])
def test_repeated_values_are_named(size: tuple[int, int], stride: tuple[int, int]) -> None:
    """An expanded tensor is honest, and not damaged: the user can save it otherwise."""
    with pytest.raises(BrokenPickleError, match="its values are repeated by strides; save it contiguous"):
        Views(make_file(0)).tensor(Entry(FLOATS, 0, size, stride), 0, 20)


def test_values_beyond_the_storage_are_not_called_repeated() -> None:
    with pytest.raises(BrokenPickleError, match="does not fit into the 5 values of its storage$"):
        Views(make_file(0)).tensor(Entry(FLOATS, 0, (6,), (1,)), 0, 20)
