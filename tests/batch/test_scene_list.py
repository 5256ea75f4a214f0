"""Lists of scenes: what may be written, and what each wrong line says."""

import pytest
from messages import refused, tells

from kfgs.batch import read_scenes


@pytest.fixture
def listed(tmp_path):
    for name in ("kitchen", "hall", "attic/images", "cellar/images", "with blank"):
        (tmp_path / name).mkdir(parents=True)

    def write(text):
        (tmp_path / "scenes.txt").write_text(text)
        return tmp_path / "scenes.txt"

    return write


def test_folders_are_relative_to_the_list_and_name_their_runs(listed, tmp_path):
    text = f"# captures\n\nkitchen\n{tmp_path}/hall/  # a comment\nwith blank\nup = attic/images\n"
    places = {"kitchen": "kitchen", "hall": "hall", "with blank": "with blank", "up": "attic/images"}
    assert read_scenes(listed(text)) == {name: str(tmp_path / place) for name, place in places.items()}


def test_all_wrong_lines_are_named(listed):
    text = "kitchen\n\ngarden\nattic/images\ncellar/images\nscenes.txt\n.. = hall\n"
    parts = (
        ("line 3: ", "garden is not a folder", "line 5: 'images' is line 4's name; write `NAME = SCENE`"),
        ("line 6: ", "line 7: '..' cannot be the name of a run"),
    )
    with pytest.raises(ValueError, match=tells("scenes.txt", *parts[0], *parts[1])) as error:
        read_scenes(listed(text))
    assert "line 1" not in str(error.value)


@pytest.mark.parametrize("text", ["", "# nothing\n\n"])
def test_an_empty_list_is_refused(listed, text):
    refused(lambda: read_scenes(listed(text)), "expected an existing scene", "no scene")


def test_lists_of_other_systems_are_read(listed, tmp_path):
    path = listed("")
    path.write_bytes(b"\xef\xbb\xbfkitchen\r\n\r\n")
    assert read_scenes(path) == {"kitchen": str(tmp_path / "kitchen")}
    path.write_bytes("K\u00fcche\r\n".encode("latin-1"))
    refused(lambda: read_scenes(path), "scenes.txt", "UTF-8")
    refused(lambda: read_scenes(tmp_path / "none.txt"), "no such file", "a folder per line", error=FileNotFoundError)
    refused(lambda: read_scenes(tmp_path), "expected a text file", "got a folder")
