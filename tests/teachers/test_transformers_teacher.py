"""Every teacher of the table, from tiny models through the real `save_pretrained` and `from_pretrained`."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

transformers = pytest.importorskip("transformers")

from messages import refused  # noqa: E402
from oracles_transformers import clip_features, siglip_features  # noqa: E402
from tiny_transformers import CHANNELS, KINDS, write_teacher  # noqa: E402

from kfgs.teachers.protocol import Teacher, identify  # noqa: E402
from kfgs.teachers.transformers_table import TRANSFORMERS  # noqa: E402
from kfgs.teachers.transformers_teacher import load_transformers_teacher  # noqa: E402

TEXT = [name for name in CHANNELS if TRANSFORMERS[KINDS.get(name, name)].text]
BLIND = [name for name in CHANNELS if name not in TEXT]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("teachers")
    transformers.utils.logging.disable_progress_bar()
    found = {name: write_teacher(root / name, name) for name in CHANNELS}
    transformers.utils.logging.enable_progress_bar()
    return found


@pytest.fixture(scope="module")
def load(folders):
    return lambda name, **options: load_transformers_teacher(KINDS.get(name, name), folders[name], **options)


def picture(height=40, width=56, seed=0):
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


def test_every_row_of_the_table_is_tested():
    assert {KINDS.get(name, name) for name in CHANNELS} == set(TRANSFORMERS)
    assert TRANSFORMERS["radio"].normalisation == ((0, 0, 0), (1, 1, 1))  # the others': in the tests below
    models = {model for row in TRANSFORMERS.values() for model in row.models}
    assert models == {"clip", "siglip", "tipsv2", "dinov2", "dinov2_with_registers", "dinov3_vit", "radio"}


@pytest.mark.parametrize("name", CHANNELS)
def test_map_has_one_feature_per_patch(load, name):
    teacher = load(name)
    assert isinstance(teacher, Teacher)
    assert teacher.name == KINDS.get(name, name)
    features = teacher.encode_image(picture())
    assert features.shape == (CHANNELS[name], 5, 7)
    assert features.dtype == torch.float32
    assert features.flatten(1).std(dim=1).min() > 1e-3  # it sees the picture
    assert not teacher.model.training
    assert teacher.to("cpu") is teacher


def test_clip_gives_projected_values_of_its_last_block(load):
    teacher = load("clip")
    image = picture(32, 32)
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073])[:, None, None]
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711])[:, None, None]
    with torch.no_grad():
        pixels = ((image - mean) / std)[None]
        states = teacher.model.vision_model(pixels, output_hidden_states=True).hidden_states
    hidden = states[-2][0].double().numpy()  # what enters the last block
    expected = clip_features(hidden, teacher.model.state_dict(), 1, 1e-5)
    got = teacher.encode_image(image).flatten(1).T.numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_tips_and_dino_give_the_last_hidden_state_without_prefix(load):
    for name, prefix in (("tipsv2", 2), ("dinov2", 1), ("dinov2-registers", 5), ("dinov3", 5)):
        teacher = load(name)
        imagenet = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)) if name != "tipsv2" else ((0.0,), (1.0,))
        mean, std = (torch.tensor(values)[:, None, None] for values in imagenet)
        with torch.no_grad():
            tower = getattr(teacher.model, "vision_model", teacher.model)
            hidden = tower(((picture() - mean) / std)[None]).last_hidden_state[0]
        assert hidden.shape[0] == prefix + 35
        got = teacher.encode_image(picture()).flatten(1).T
        torch.testing.assert_close(got, hidden[prefix:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["siglip", "siglip2"])
def test_siglip_sends_each_patch_through_the_pooling_head(load, name):
    teacher = load(name)
    with torch.no_grad():
        hidden = teacher.model.vision_model((picture()[None] - 0.5) / 0.5, interpolate_pos_encoding=True)
    hidden = hidden.last_hidden_state[0].double().numpy()
    expected = siglip_features(hidden, teacher.model.state_dict(), 1e-6)
    got = teacher.encode_image(picture()).flatten(1).T.numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TEXT)
def test_text_rows_are_the_normalised_text_features(load, name):
    teacher = load(name)
    rows = teacher.encode_text(["wall", "a red chair"])
    assert rows.shape == (2, CHANNELS[name])
    torch.testing.assert_close(rows.norm(dim=1), torch.ones(2))
    tokenizer = transformers.AutoTokenizer.from_pretrained(teacher.model.name_or_path)
    rule = TRANSFORMERS[teacher.name].text
    padding = {"padding": "max_length", "max_length": 16} if rule.pad else {"padding": True}
    found = tokenizer(["wall", "a red chair"], return_tensors="pt", padding_side="right", **padding)
    named = {"attention_mask": found["attention_mask"]} if rule.mask else {}
    with torch.no_grad():
        expected = teacher.model.get_text_features(input_ids=found["input_ids"], **named).pooler_output
    torch.testing.assert_close(rows, normalize(expected, dim=1))


@pytest.mark.parametrize("name", TEXT)
def test_text_rows_do_not_depend_on_company_or_capitals(load, name):
    teacher = load(name)
    refused(lambda: teacher.encode_text([]), "prompts:", "got none")
    refused(lambda: teacher.encode_text(["a", "abcdefghijklmnopqrst"]), "prompts:", "16", f"'{teacher.name}'", "got 2")
    rows = teacher.encode_text(["wall"] * 70 + ["a red chair"])  # more than one chunk, shorter beside longer
    torch.testing.assert_close(teacher.encode_text(["Wall"])[0], rows[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(teacher.encode_text(["a red chair"])[0], rows[70], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", BLIND)
def test_teachers_without_text_say_so(load, name):
    refused(lambda: load(name).encode_text(["wall"]), "text encoder", "clip, openclip", error=NotImplementedError)


def test_identity_tells_weights_and_options_apart_but_not_folders(load, folders, tmp_path):
    plain = identify(load("dinov2"))
    assert plain == identify(load("dinov2"))
    assert set(plain) == {"name", "options", "weights"}
    assert plain != identify(load("dinov2", size=80))
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for file in folders["dinov2"].iterdir():
        (moved / file.name).write_bytes(file.read_bytes())
    assert identify(load_transformers_teacher("dinov2", moved)) == plain
    weights = transformers.Dinov2Model.from_pretrained(moved)
    with torch.no_grad():
        weights.layernorm.bias[0] += 1
    weights.save_pretrained(moved)
    assert identify(load_transformers_teacher("dinov2", moved))["weights"] != plain["weights"]


def test_options_that_do_not_suit_are_refused(load, folders):
    refused(lambda: load("clip", size=1.5), "size:", "got 1.5")
    refused(lambda: load_transformers_teacher("clap", folders["clip"]), "kind:", "'clip'", "got 'clap'")
