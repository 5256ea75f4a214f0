import pytest
import torch
from lseg_layout import TINY, random_state
from messages import tells

from kfgs.teachers.lseg.keys import network_from_state, text_from_state

HEAD = "net.scratch.head1.weight"
POSITIONS = "net.pretrained.model.pos_embed"
QKV = "net.pretrained.model.blocks.2.attn.qkv.weight"


@pytest.fixture
def state():
    return random_state(TINY, torch.Generator().manual_seed(7))


@pytest.fixture
def x():
    return 2 * torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(8)) - 1


def test_single_precision_is_shared_and_half_is_cast(state):
    network = network_from_state(state, TINY, source="a")
    assert network.head.weight.data_ptr() == state[HEAD].data_ptr()
    assert network.vit.encoder.blocks[2][0].fn[1].qkv.weight.data_ptr() == state[QKV].data_ptr()
    half = network_from_state({**state, HEAD: state[HEAD].half()}, TINY, source="a")
    assert torch.equal(half.head.weight, state[HEAD].half().float())


def test_a_memory_mapped_file_is_not_copied(state, tmp_path):
    torch.save(state, tmp_path / "a.pt")
    mapped = torch.load(tmp_path / "a.pt", mmap=True, weights_only=True)
    network = network_from_state(mapped, TINY, source="a.pt")
    assert network.head.weight.data_ptr() == mapped[HEAD].data_ptr()


def test_prefix_and_unused_tensors_may_be_missing(state, x):
    expected = network_from_state(state, TINY, source="a")(x)
    unused = ("clip_pretrained.", "pretrained.model.norm", "pretrained.model.head", "scratch.refinenet4.resConfUnit1")
    bare = {name.removeprefix("net."): value for name, value in state.items()}
    bare = {n: v for n, v in bare.items() if not n.startswith(unused) and not n.endswith("num_batches_tracked")}
    assert len(state) - len(bare) > 60
    assert torch.equal(network_from_state(bare, TINY, source="a")(x), expected)


def test_positions_are_resized_bilinearly_about_pixel_centres(state):
    side, grid = 3, 4
    table = state[POSITIONS][0, 1:].reshape(side, side, -1).double()
    expected = torch.empty(grid, grid, table.shape[2], dtype=torch.float64)
    for i in range(grid):
        for j in range(grid):
            total = 0.0
            for a in range(side):
                for b in range(side):  # a hat of width 1 about the clamped sample, centres at + 0.5
                    y = min(max((i + 0.5) * side / grid - 0.5, 0), side - 1)
                    u = min(max((j + 0.5) * side / grid - 0.5, 0), side - 1)
                    total = total + max(0.0, 1 - abs(y - a)) * max(0.0, 1 - abs(u - b)) * table[a, b]
            expected[i, j] = total
    found = network_from_state(state, TINY, source="a").vit.patch_embedding.positions
    torch.testing.assert_close(found[1:].double(), expected.reshape(grid * grid, -1), rtol=1e-5, atol=1e-6)
    assert torch.equal(found[0], state[POSITIONS][0, 0])


def test_each_tensor_matters(state, x):
    """Every tensor of the image network, moved a little, moves the features: none is taken for another."""
    expected = network_from_state(state, TINY, source="a")(x)
    generator = torch.Generator().manual_seed(10)
    for name, value in state.items():
        if "clip_pretrained" in name or "model.norm" in name or "model.head" in name or "num_batches" in name:
            continue
        other = value + 0.3 * torch.randn(value.shape, generator=generator)
        changed = network_from_state({**state, name: other}, TINY, source="a")(x)
        moved = float((changed - expected).abs().max())
        assert (moved == 0) == ("refinenet4.resConfUnit1" in name), name


def test_missing_unknown_and_misshapen_tensors_are_counted_and_named(state):
    del state[HEAD], state[QKV]
    state["net.scratch.extra"] = torch.zeros(2)
    state[POSITIONS] = torch.zeros(1, 17, 32)
    with pytest.raises(ValueError, match=tells("my.ckpt:", "clip_vitl16_384")) as caught:
        network_from_state(state, TINY, source="my.ckpt")
    message = str(caught.value)
    assert (
        "2 missing (pretrained.model.blocks.2.attn.qkv.weight (96, 32); scratch.head1.weight (24, 16, 1, 1))" in message
    )
    assert "1 unknown (scratch.extra)" in message
    assert "1 of another shape or type (pretrained.model.pos_embed: expected (1, 10, 32), got (1, 17, 32)" in message
    assert message.endswith("use the file as its authors published it")
    assert "\n" not in message


def test_a_file_without_text_is_refused_only_for_text(state):
    image = {name: value for name, value in state.items() if "clip_pretrained" not in name}
    network_from_state(image, TINY, source="a")
    with pytest.raises(ValueError, match=tells("a:", "text tower", "clip_pretrained.*")):
        text_from_state(image, TINY, source="a")


def named(*names, shape=(4,)):
    return {name: torch.zeros(shape) for name in names}


@pytest.mark.parametrize(
    ("found", "what"),
    [
        ({}, ("got another network of 0 tensors", "missing")),
        (named("net.pretrained.model.pos_embed", shape=(1, 145, 768)), ("of 1 tensors", "of another shape")),
        (named("a\nb"), ("1 unknown (a\\nb)",)),
        (named("fc.weight"), ("of 1 tensors", "missing (pretrained.model.cls_token", "1 unknown (fc.weight")),
    ],
)
def test_the_file_of_another_network_is_named(found, what):
    with pytest.raises(ValueError, match=tells("other.pt:", "LSeg", *what)):
        network_from_state(found, TINY, source="other.pt")
