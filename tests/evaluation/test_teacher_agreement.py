import cases_methods as cases
import numpy as np
import pytest
from messages import refused

from kfgs.evaluation.teacher_agreement import MERGED, SIZE, TeacherAgreement, ade20k_words


def test_texts_and_merges_are_the_published_ones():
    words = ade20k_words()
    assert len(words) == 150
    assert [i for i, name in enumerate(words, 1) if name == "screen"] == [59, 131]
    assert [(words.index(old), words.index(new)) for old, new in MERGED] == [(89, 14), (28, 3), (57, 39)]


def agreement(teacher, student, most=7):
    """Accuracy and mIoU of the most frequent labels, pixel by pixel."""
    equal, known, counts = 0, 0, {}
    for t, s in zip(teacher.ravel(), student.ravel(), strict=True):
        if t < 0:
            continue
        known += 1
        equal += t == s
        for label in (t, s):
            if label >= 0:
                counts[int(label)] = counts.get(int(label), 0) + 1
    frequent = sorted(counts, key=lambda label: (-counts[label], label))[:most]
    ious = []
    for label in frequent:
        both = either = 0
        for t, s in zip(teacher.ravel(), student.ravel(), strict=True):
            if t >= 0:
                both += t == label and s == label
                either += t == label or s == label
        ious.append(both / either)
    return equal / known, float(np.mean(ious))


def _methods(texts, stems, height, width):
    rng = np.random.default_rng(3)
    teacher = cases.Numbers(texts, cases.random_maps(rng, stems, texts, 1, height, width))
    maps = {s: {t: m + 0.05 * rng.normal(size=m.shape) for t, m in one.items()} for s, one in teacher.maps.items()}
    return teacher, cases.Numbers(texts, maps)


def test_the_whole_protocol_against_loops():
    """Labels are merged, then resized as torch's "nearest" does: row y of 119 reads row y 24 // 119."""
    words = ade20k_words()
    texts = list(dict.fromkeys(words))
    stems = [f"rgb_{i}" for i in range(12)]
    teacher, student = _methods(texts, stems, 24, 32)
    views = [cases.view(stem, 24, 32) for stem in sorted(stems)]  # as text: rgb_0, rgb_1, rgb_10, ...
    report = TeacherAgreement().score(student, teacher, views, teacher.encode)
    scores = []
    for stem in ("rgb_2", "rgb_10"):  # by number: indices 2 and 10
        maps = []
        for method in (teacher, student):
            labels = np.argmax([method.maps[stem][text][0] for text in words], axis=0)
            for old, new in ((89, 14), (28, 3), (57, 39)):
                labels[labels == old] = new
            rows, columns = np.arange(SIZE[0]) * 24 // SIZE[0], np.arange(SIZE[1]) * 32 // SIZE[1]
            maps.append(labels[np.ix_(rows, columns)])
        scores.append(agreement(*maps))
    assert [row["view"] for row in report.rows] == ["rgb_2", "rgb_10"]
    assert (report["accuracy"], report["mIoU"]) == pytest.approx(np.mean(scores, 0), abs=1e-9)
    assert str(report).endswith("(feature3dgs-teacher/1)")
    (note,) = report.notes
    assert note == "2 of 12 views are scored: one in 8 from index 2, in the order of the numbers in their names"


def test_other_texts_and_views():
    texts = ["a", "b", "c"]
    teacher, student = _methods(texts, ["x", "y"], 360, 480)
    wide = [cases.view("x", 720, 960), cases.view("y", 720, 960)]  # scored at 360x480
    report = TeacherAgreement(texts=("a", "b", "c"), split=None).score(teacher, teacher, wide, teacher.encode)
    assert report.scores == {"mIoU": 1.0, "accuracy": 1.0}
    assert len(report.rows) == 2
    assert report.notes == ()
    score = TeacherAgreement().score
    refused(lambda: score(student, teacher, wide, teacher.encode), "expected more than 2, got 2; pass split=None")
