import json
import math
import pickle
from dataclasses import replace
from functools import cache

import pytest
import torch

from kfgs import Camera, Gaussians
from kfgs.fields import SemanticField
from kfgs.metrics import MIB
from kfgs.quant.autoencoder import Autoencoder
from kfgs.quant.codebook import Codebook

DIM, CLASSES = 16, 3
MODES = ["decouple", "adc", "adc+sc"]


@cache
def codebook():
    """Four orthogonal directions; the last two share the third class's."""
    codewords = torch.zeros(4, DIM)
    codewords[0, 0], codewords[1, 1], codewords[2, 2], codewords[3, 3] = 2.0, 3.0, 1.0, 1.5
    return Codebook(codewords)


@cache
def embeddings():
    rows = torch.zeros(CLASSES, DIM)
    rows[0, 0], rows[1, 1] = 1.0, 1.0
    rows[2, 2] = rows[2, 3] = 1.0
    return rows


@cache
def autoencoder() -> Autoencoder:
    """Written down, not fitted: codeword i's latent is the i-th unit vector of four, and decodes to its direction."""
    into, out = torch.eye(4, DIM), torch.eye(DIM, 4)
    return Autoencoder(
        encoder=((into, torch.zeros(4)),),
        decoder=((out, torch.zeros(DIM)), (torch.eye(DIM), torch.zeros(DIM))),
        low=0.0,
        high=1.0,
    )


def field(mode="adc+sc", n=4):
    """Opaque balls side by side, the i-th at codeword i (mod 4) exactly."""
    features = codebook().codewords[torch.arange(n) % 4]
    if mode == "adc+sc":
        with torch.no_grad():
            features = autoencoder().encode(features)
    gaussians = Gaussians(
        means=torch.tensor([[i - (n - 1) / 2, 0.0, 5.0] for i in range(n)]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.2),
        opacities=torch.full((n,), 0.95),
        features=features,
    )
    book = None if mode == "decouple" else codebook()
    return SemanticField(gaussians, book, autoencoder() if mode == "adc+sc" else None, {"mode": mode, "seconds": 1.5})


def camera():
    return Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 8], [0, 0, 1]]), 40, 16)


# Ball i projects to column 40 (i - 1.5) / 5 + 20 = 8 + 8 i, row 8.
CENTRES = [8, 16, 24, 32]


@pytest.mark.parametrize("mode", MODES)
def test_segment_sees_each_ball_in_its_class(mode):
    labels = field(mode).segment(camera(), embeddings())
    assert labels.shape == (16, 40)
    assert labels[8, CENTRES].tolist() == [0, 1, 2, 2]
    assert labels[0].tolist() == [-1] * 40  # nothing was drawn there
    if mode == "adc+sc":
        latent = field(mode).segment(camera(), embeddings(), decode="latent")
        assert latent[8, CENTRES].tolist() == [0, 1, 2, 2]


@pytest.mark.parametrize("mode", MODES)
def test_classify_and_its_scores(mode):
    labels, scores = field(mode, n=6).classify(embeddings())
    assert labels.tolist() == [0, 1, 2, 2, 0, 1]
    torch.testing.assert_close(scores, torch.tensor([1.0, 1.0, 0.5**0.5, 0.5**0.5, 1.0, 1.0]))


@pytest.mark.parametrize("mode", MODES)
def test_query_with_and_without_threshold(mode):
    found = field(mode, n=8).query(embeddings()[2], 0.5)
    assert found.mask.tolist() == [False, False, True, True] * 2
    assert found.threshold == 0.5
    assert field(mode, n=8).query(embeddings()[2]).mask.tolist() == [False, False, True, True] * 2


@pytest.mark.parametrize("mode", MODES)
def test_query_by_views_and_with_negatives(mode):
    made = field(mode)
    by_views = made.query(embeddings()[0], 0.5, cameras=[camera()])
    assert by_views.mask.tolist() == [True, False, False, False]
    assert by_views.scores[0] > 0.99  # its own pixels all point at codeword 0; only those of its neighbour do not
    assert by_views.scores[2:].abs().max() < 0.01
    for cameras in (None, [camera()]):
        against = made.query(embeddings()[2], negatives=embeddings()[:2], cameras=cameras)
        assert against.mask.tolist() == [False, False, True, True]
        assert against.threshold == 0.5
    hidden = field(mode).gaussians
    hidden = hidden.replace(
        means=torch.cat([-hidden.means[:1], hidden.means[1:]])
    )  # the first stands behind the camera
    unseen = SemanticField(hidden, made.codebook, made.autoencoder).query(embeddings()[0], -1.0, cameras=[camera()])
    assert unseen.mask.tolist() == [False, True, True, True]
    with pytest.raises(ValueError, match="views: expected at least one camera, got none"):
        made.query(embeddings()[0], cameras=[])
    with pytest.raises(ValueError, match=r"negatives: expected \[M, 16\], got \(2, 5\)"):
        made.query(embeddings()[0], negatives=torch.ones(2, 5))


@pytest.mark.parametrize("mode", MODES)
def test_query_by_any_score(mode):
    """Each ball lies at a codeword, so its cosines with the three classes are 1, 0 or sqrt(1/2), and scores follow."""
    made, root = field(mode), 0.5**0.5
    against = {"negatives": embeddings()[:2], "cameras": None}
    cosine = made.query(embeddings()[2], 0.5, score="cosine", **against)
    torch.testing.assert_close(cosine.scores, torch.tensor([0, 0, root, root]))
    raw = made.query(embeddings()[2], 0.3, score="softmax", logit_scale="raw", **against)
    low, high = 1 / (2 + math.e), math.exp(root) / (math.exp(root) + 2)
    torch.testing.assert_close(raw.scores, torch.tensor([low, low, high, high]))
    assert raw.mask.tolist() == [False, False, True, True]
    relevant = made.query(embeddings()[2], score="relevancy", **against)
    torch.testing.assert_close(relevant.scores[2:], torch.sigmoid(torch.tensor([10 * root] * 2)))
    by_views = made.query(embeddings()[2], 0.3, score="softmax", negatives=embeddings()[:2], cameras=[camera()])
    assert by_views.mask.tolist() == [False, False, True, True]
    with pytest.raises(ValueError, match="negatives: expected some for score 'relevancy', got none"):
        made.query(embeddings()[2], score="relevancy")


def test_text_of_another_size_is_guessed_to_be_another_teachers():
    for ask in (
        lambda: field().query(torch.ones(7)),
        lambda: field().classify(torch.ones(2, 7)),
        lambda: field().segment(camera(), torch.ones(2, 7)),
        lambda: field().query(torch.ones(16), negatives=torch.ones(2, 7)),
    ):
        with pytest.raises(
            ValueError, match=r"16\], got \((2, )?7,?\): text of another teacher\? Embed the words with"
        ):
            ask()
    with pytest.raises(ValueError, match=r"embedding: expected \[16\], got \(1, 16\); pass a tensor"):
        field().query(torch.ones(1, 16))


@pytest.mark.parametrize("mode", MODES)
def test_feature_map_points_at_the_codewords(mode):
    features = field(mode).feature_map(camera())
    assert features.shape == (16, 40, DIM)
    similarity = codebook().similarity(features[8, CENTRES])
    assert similarity.argmax(dim=1).tolist() == [0, 1, 2, 3]
    assert field(mode).decode(torch.zeros(2, 3, field(mode).channels)).shape == (2, 3, DIM)


def test_decoding_in_chunks_changes_nothing(monkeypatch):
    whole = field(n=9).quantized()
    monkeypatch.setattr("kfgs.fields.semantic_field.CHUNK", 2)
    assert torch.equal(field(n=9).quantized(), whole)


def test_codeword_labels():
    assert field().codeword_labels(embeddings()).labels.tolist() == [0, 1, 2, 2]
    with pytest.raises(ValueError, match="codebook: expected one, got None in this field"):
        field("decouple").codeword_labels(embeddings())


def test_storage_as_table_1_counts_it():
    # Per Gaussian 14 + d float32; codebook 4 x 16; decoder 4-16-16 with biases.
    assert field("decouple", n=10).storage() == 4 * 10 * (14 + DIM)
    assert field("adc", n=10).storage() == 4 * (10 * (14 + DIM) + 4 * DIM)
    decoder = (4 * 16 + 16) + (16 * 16 + 16)
    assert field("adc+sc", n=10).storage() == 4 * (10 * (14 + 4) + 4 * DIM + decoder)


def test_summary_names_counts_and_size():
    text = field("adc+sc", n=10).summary()
    assert "decouple+ADC+SC" in text
    assert "10 Gaussians, 4 channels for 16, 4 codewords" in text
    assert f"{field('adc+sc', n=10).storage() / MIB:.2f} MiB" in text
    assert "seconds: 1.5" in text
    assert "teacher" not in text


def test_summary_names_the_teacher():
    known = replace(field("adc+sc", n=10), info={"teacher": {"name": "lseg", "weights": "3f2a"}})
    assert "\n  teacher: lseg" in known.summary()


@pytest.mark.parametrize("mode", MODES)
def test_save_then_load_is_the_same(tmp_path, mode):
    saved = field(mode, n=5)
    if mode == "adc":
        saved = SemanticField(
            saved.gaussians.replace(labels=torch.arange(5)), saved.codebook, None, {"nested": {"a": [1, None]}}
        )
    saved.save(tmp_path / "field")
    loaded = SemanticField.load(tmp_path / "field")
    for name, value in vars(saved.gaussians).items():
        other = getattr(loaded.gaussians, name)
        assert (value is None and other is None) or torch.equal(value, other), name
    assert loaded.info == saved.info
    assert torch.equal(loaded.segment(camera(), embeddings()), saved.segment(camera(), embeddings()))
    assert torch.equal(loaded.feature_map(camera()), saved.feature_map(camera()))
    assert sorted(file.name for file in (tmp_path / "field").iterdir()) == ["field.json", "field.safetensors"]


def test_saving_replaces_an_older_field_and_nothing_else(tmp_path):
    field(n=5).save(tmp_path / "field")
    field(n=3).save(tmp_path / "field")
    assert len(SemanticField.load(tmp_path / "field")) == 3
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter1.tex").write_text("...")
    with pytest.raises(FileExistsError, match="path: expected a new folder or an older field at .*thesis"):
        field().save(precious)
    assert (precious / "chapter1.tex").exists()
    with pytest.raises(FileExistsError, match="path: expected a new folder"):
        field().save(precious / "chapter1.tex")


def test_info_must_be_json(tmp_path):
    bad = SemanticField(field().gaussians, codebook(), autoencoder(), {"loss": float("nan")})
    with pytest.raises(ValueError, match="info: expected what JSON can hold"):
        bad.save(tmp_path / "field")
    assert not (tmp_path / "field").exists()


def test_missing_foreign_and_damaged_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected the folder of a saved field, found no field\.json"):
        SemanticField.load(tmp_path)
    path = tmp_path / "field"
    field().save(path)
    description = json.loads((path / "field.json").read_text())

    def rewrite(**changes):
        (path / "field.json").write_text(json.dumps(description | changes))

    rewrite(format="other")
    with pytest.raises(ValueError, match=r"expected a field \(kfgs\.semantic_field\), got 'other'"):
        SemanticField.load(path)
    rewrite(version=99)
    with pytest.raises(ValueError, match="expected format version 1, got 99"):
        SemanticField.load(path)
    (path / "field.json").write_text("{")
    with pytest.raises(ValueError, match="expected a JSON file"):
        SemanticField.load(path)
    rewrite()
    whole = (path / "field.safetensors").read_bytes()
    (path / "field.safetensors").write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ValueError, match=r"expected field\.safetensors as it was saved, got another"):
        SemanticField.load(path)
    (path / "field.safetensors").unlink()
    with pytest.raises(ValueError, match=r"expected field\.safetensors as it was saved, got none"):
        SemanticField.load(path)


def test_a_pickle_under_the_right_name_is_not_opened(tmp_path):
    import hashlib

    class Trap:
        def __reduce__(self):
            return (exec, ("raise SystemExit('unpickled')",))

    path = tmp_path / "field"
    field().save(path)
    content = pickle.dumps(Trap())
    (path / "field.safetensors").write_bytes(content)
    description = json.loads((path / "field.json").read_text())
    (path / "field.json").write_text(json.dumps(description | {"sha256": hashlib.sha256(content).hexdigest()}))
    with pytest.raises(ValueError, match="its parts do not fit together"):
        SemanticField.load(path)


def test_parts_must_belong_together():
    with pytest.raises(ValueError, match="gaussians: expected features"):
        SemanticField(field().gaussians.replace(features=None))
    with pytest.raises(ValueError, match="codebook: expected the one that the autoencoder was fitted to, got None"):
        SemanticField(field().gaussians, None, autoencoder())
    with pytest.raises(ValueError, match=r"gaussians: expected 16 features each .* got 4"):
        SemanticField(field().gaussians, codebook())
    with pytest.raises(ValueError, match=r"autoencoder: expected 5 decoded channels \(from codebook\), got 16"):
        SemanticField(field().gaussians, Codebook(torch.eye(5)), autoencoder())
    with pytest.raises(ValueError, match=r"gaussians: expected 4 features each .* got 16"):
        SemanticField(field("adc").gaussians, codebook(), autoencoder())


@pytest.mark.parametrize("mode", MODES)
def test_wrong_embeddings(mode):
    made = field(mode)
    with pytest.raises(ValueError, match=r"embeddings: expected \[C, 16\], got \(2, 5\)"):
        made.classify(torch.ones(2, 5))
    with pytest.raises(ValueError, match=r"embeddings: expected \[C, 16\], got \(2, 5\)"):
        made.segment(camera(), torch.ones(2, 5))
    with pytest.raises(ValueError, match=r"embedding: expected \[16\], got \(5,\)"):
        made.query(torch.ones(5))
    with pytest.raises(ValueError, match=r"latents: expected \[\.\.\., d\]"):
        made.decode(torch.ones(2, 99))
