"""One folder of maps filled by several calls, each with a part of the pictures."""

import json

import pytest
from messages import tells
from small_batch import timeless

from kfgs._files import InUseError, digest_file, locked
from kfgs.features import FeatureFolder, Picture, extract_features, join_features, read_manifest
from tests.features.test_extract import Counting, paint

STEMS = ["d", "b", "sub/c", "a"]


@pytest.fixture
def pictures(tmp_path):
    found = [Picture(stem, tmp_path / "images" / f"{stem}.png") for stem in STEMS]
    for i, picture in enumerate(found):
        paint(picture.path, i)
    return found


def files(folder):
    found = {
        file.relative_to(folder).as_posix(): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()
    }
    return {
        name: timeless(data) if name.endswith(".json") else data for name, data in found.items() if "lock" not in name
    }


def test_parts_in_any_order_join_to_what_one_call_writes(pictures, tmp_path):
    extract_features(Counting(), pictures, tmp_path / "one")
    for part in (1, 0):
        extract_features(Counting(), pictures[2 * part : 2 * part + 2], tmp_path / "many", part=str(part))
    assert read_manifest(tmp_path / "many") is None
    join_features(tmp_path / "many", STEMS)
    assert files(tmp_path / "many") == files(tmp_path / "one")
    assert sorted(path.name for path in (tmp_path / "many").glob(".*")) == [".features.lock"]
    assert list(json.loads((tmp_path / "many" / "features.json").read_text())["maps"]) == STEMS


def test_a_part_goes_on_where_a_killed_call_stopped(pictures, tmp_path):
    class Dying(Counting):
        def encode_image(self, image):
            if len(self.calls) == 1:
                raise KeyboardInterrupt
            return super().encode_image(image)

    with pytest.raises(KeyboardInterrupt):
        extract_features(Dying(), pictures[:2], tmp_path / "maps", part="0")
    (tmp_path / "maps" / "b.npy").write_bytes(b"left by the killed process, without a record")
    teacher = Counting()
    extract_features(teacher, pictures[:2], tmp_path / "maps", part="0")
    assert len(teacher.calls) == 1


def test_a_joined_folder_is_known_to_its_parts_and_to_one_call(pictures, tmp_path):
    extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")
    join_features(tmp_path / "maps", STEMS[:2])
    teacher = Counting()
    extract_features(teacher, pictures[1:], tmp_path / "maps", part="0")
    assert len(teacher.calls) == 2  # b was known
    assert set(join_features(tmp_path / "maps", STEMS).maps) == set(STEMS)
    extract_features(teacher, pictures, tmp_path / "maps")
    assert len(teacher.calls) == 2
    assert len(FeatureFolder(tmp_path / "maps", STEMS).digests()) == 4


def test_a_part_locks_itself_alone(pictures, tmp_path):
    with locked(tmp_path / "maps", ".features.part-0.lock"):
        extract_features(Counting(), pictures[2:], tmp_path / "maps", part="1")
        with pytest.raises(InUseError, match=tells("folder", "in use by")):
            extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")


def test_a_view_that_no_part_made_and_parts_of_two_teachers_are_refused(pictures, tmp_path):
    extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")
    with pytest.raises(ValueError, match=tells("stems", "'sub/c'", "2 in all")):
        join_features(tmp_path / "maps", STEMS)
    extract_features(Counting(weights="w2"), pictures[2:], tmp_path / "maps", part="1")
    with pytest.raises(ValueError, match=tells("different teachers")):
        join_features(tmp_path / "maps", STEMS)
    assert read_manifest(tmp_path / "maps", "0") is not None


@pytest.mark.parametrize(("part", "overwrite"), [("a/b", False), ("", False), ("0", True)])
def test_a_word_that_is_no_part_is_refused(pictures, tmp_path, part, overwrite):
    with pytest.raises(ValueError, match=tells("part", repr(part))):
        extract_features(Counting(), pictures, tmp_path / "maps", part=part, overwrite=overwrite)


def test_maps_of_other_programs_are_not_overwritten_by_a_part(pictures, tmp_path):
    extract_features(Counting(), pictures, tmp_path / "maps")
    (tmp_path / "maps" / "features.json").unlink()
    with pytest.raises(ValueError, match=tells("other programs", "d.npy")):
        extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")


def test_another_division_of_the_pictures_goes_on_without_loss(pictures, tmp_path):
    """Two parts of two pictures, of which the second was killed after a map; then a part of three pictures, and one of one."""
    extract_features(Counting(), pictures, tmp_path / "one")
    extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")
    extract_features(Counting(), pictures[2:3], tmp_path / "maps", part="1")
    (tmp_path / "maps" / "a.npy").write_bytes(b"left by the killed process, without a record")
    teacher = Counting()
    extract_features(teacher, pictures[1:], tmp_path / "maps", part="other")
    extract_features(teacher, pictures[:1], tmp_path / "maps", part="last")
    assert len(teacher.calls) == 1
    join_features(tmp_path / "maps", STEMS)
    assert files(tmp_path / "maps") == files(tmp_path / "one")
    assert sorted(path.name for path in (tmp_path / "maps").glob(".*")) == [".features.lock"]


def test_of_two_divisions_the_map_that_was_written_last_is_joined(pictures, tmp_path):
    extract_features(Counting(), pictures, tmp_path / "maps", part="z")
    paint(pictures[0].path, 9)
    teacher = Counting()
    extract_features(teacher, pictures[:2], tmp_path / "maps", part="a")
    assert len(teacher.calls) == 1
    joined = join_features(tmp_path / "maps", STEMS)
    assert joined.maps["d"].image_digest == digest_file(pictures[0].path)
    assert joined.maps["d"].doubt(tmp_path / "maps" / "d.npy", read=False) is None


def test_a_part_of_another_division_by_another_teacher_is_refused_at_once(pictures, tmp_path):
    extract_features(Counting(), pictures[:2], tmp_path / "maps", part="0")
    with pytest.raises(ValueError, match=tells("same teacher", "w2", "use another folder, or delete this one")):
        extract_features(Counting(weights="w2"), pictures[1:], tmp_path / "maps", part="other")
