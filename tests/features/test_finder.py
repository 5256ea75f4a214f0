from kfgs.features.finder import MapFinder
from kfgs.features.manifest import Manifest, MapRecord


def touch(folder, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def names(folder, files) -> list[str]:
    return [file.relative_to(folder).as_posix() for file in files]


def test_lists_what_is_a_map_and_nothing_else(tmp_path):
    touch(tmp_path, "b.npy", "a_fmap_CxHxW.pt", "a.npy", ".c.npy", "d.png", "e_s.npy", "e_f.npy", "f_f.npy", "g/h.npy")
    found = MapFinder(tmp_path).listed()
    assert sorted(found) == ["a", "b", "e", "f_f"]  # f_f has no partner, so it is a map of its own
    assert names(tmp_path, found["a"]) == ["a_fmap_CxHxW.pt", "a.npy"]
    assert names(tmp_path, found["e"]) == ["e_s.npy"]
    assert names(tmp_path, MapFinder(tmp_path).listed(deep=True)["g/h"]) == ["g/h.npy"]


def test_a_dot_in_the_name_is_no_ending_of_a_picture(tmp_path):
    touch(tmp_path, "frame.0001.npy", "frame.0002.png.npy")
    assert sorted(MapFinder(tmp_path).listed()) == ["frame.0001", "frame.0002"]
    found = MapFinder(tmp_path).find(["frame.0002", "frame.0001", "frame.0003"])
    assert [names(tmp_path, files) for files in found.values()] == [["frame.0002.png.npy"], ["frame.0001.npy"], []]


def test_the_stem_itself_goes_before_the_whole_name(tmp_path):
    touch(tmp_path, "a.png.npy", "a.npy", "b.jpg.npy", "b.png.npy")
    found = MapFinder(tmp_path).find(["a", "b"])
    assert [names(tmp_path, files) for files in found.values()] == [["a.npy"], ["b.jpg.npy"]]


def test_what_kfgs_wrote_is_a_map_whatever_the_picture_is_called(tmp_path):
    touch(tmp_path, "a_s.npy", "a_f.npy", "b_s.npy", "b_f.npy", "c_s.npy", "c_f.npy", "d.png.npy")
    own = ("a_s.npy", "a_f.npy", "b_f.npy", "d.png.npy")
    records = {name: MapRecord(name, (1, 1, 1), 0, 0, "", "", "", 0.0) for name in own}
    Manifest({"name": "t"}, records).save(tmp_path)
    finder = MapFinder(tmp_path)
    assert sorted(finder.listed()) == ["a_f", "a_s", "b_f", "b_s", "c", "d.png"]
    found = finder.find(["a_s", "a_f", "a", "b_s", "c"])
    assert [names(tmp_path, files) for files in found.values()] == [
        ["a_s.npy"],
        ["a_f.npy"],
        [],
        ["b_s.npy"],
        ["c_s.npy"],
    ]


def test_what_to_do_about_missing_maps_depends_on_who_makes_them(tmp_path):
    touch(tmp_path, "x.npy")
    text = MapFinder(tmp_path).explain_missing(["a"], ["a"])
    assert text.endswith("(1) are called x, but the pictures a: rename the maps to the names of the pictures")
    Manifest({"name": "t"}).save(tmp_path)
    text = MapFinder(tmp_path).explain_missing(["a"], ["a"])
    assert text.startswith(
        "expected a feature map for each of 1 views, 1 missing: a.npy; make them with `kfgs features ... "
    )
    assert f"--split all --out {tmp_path}`" in text


def test_a_map_is_found_by_a_name_that_is_spelled_otherwise(tmp_path):
    touch(tmp_path, "Ku\u0308che.npy", "Left/A.npy", "b.npy", "B2.npy")
    found = MapFinder(tmp_path).find(["K\u00fcche", "left/a", "b", "B", "c"])
    assert [names(tmp_path, files) for files in found.values()] == [
        ["Ku\u0308che.npy"],
        ["Left/A.npy"],
        ["b.npy"],
        [],
        [],
    ]
    found = MapFinder(tmp_path).find(["images/b2", "images/c"])  # by the last part, as nothing else is found
    assert [names(tmp_path, files) for files in found.values()] == [["B2.npy"], []]
