import pytest
from messages import tells

from kfgs.scale import SceneEntry, read_scenes
from kfgs.scale.scene_list import as_entries


@pytest.fixture
def listed(tmp_path):
    for name in ("kitchen", "hall", "attic/images", "cellar/images", "with blank"):
        (tmp_path / name).mkdir(parents=True)

    def write(text):
        (tmp_path / "scenes.txt").write_text(text)
        return tmp_path / "scenes.txt"

    return write


def test_folders_are_relative_to_the_list_and_name_their_runs(listed, tmp_path):
    found = read_scenes(listed(f"# captures\n\nkitchen\n{tmp_path}/hall/  # a comment\nwith blank\n"))
    assert found == [SceneEntry(name, str(tmp_path / name)) for name in ("kitchen", "hall", "with blank")]


def test_urls_and_names(listed, tmp_path):
    found = read_scenes(listed("s3://captures/one/\ntwo = gs://captures/one\nup = attic/images\n"))
    assert [one.name for one in found] == ["one", "two", "up"]
    assert found[0].source == "s3://captures/one/"
    assert found[2].source == str(tmp_path / "attic" / "images")


def test_all_wrong_lines_are_named(listed):
    text = "kitchen\n\ngarden\nattic/images\ncellar/images\nscenes.txt\n.. = hall\n"
    with pytest.raises(ValueError, match="scenes.txt") as error:
        read_scenes(listed(text))
    message = str(error.value)
    assert "line 3: " in message
    assert "garden does not exist" in message
    assert "line 5: the run of line 4 is called 'images', too; write `NAME = SCENE`" in message
    assert "line 6: " in message
    assert "is a file" in message
    assert "line 7: '..' cannot be the name of a run" in message
    assert "line 1" not in message
    assert "line 4:" not in message


def test_a_list_from_windows_is_read(listed, tmp_path):
    path = listed("")
    path.write_bytes(b"\xef\xbb\xbfkitchen\r\n\r\nup = attic/images  # two rooms\r\n# the end\r\n")
    assert [(one.name, one.source) for one in read_scenes(path)] == [
        ("kitchen", str(tmp_path / "kitchen")),
        ("up", str(tmp_path / "attic" / "images")),
    ]
    path.write_bytes("kitchen\r\n".encode("utf-16"))  # as PowerShell writes it
    assert [entry.name for entry in read_scenes(path)] == ["kitchen"]
    path.write_bytes("K\u00fcche\r\n".encode("latin-1"))
    with pytest.raises(ValueError, match=tells("scenes.txt", "UTF-8")):
        read_scenes(path)


@pytest.mark.parametrize("text", ["", "# nothing\n\n"])
def test_an_empty_list_is_refused(listed, text):
    with pytest.raises(ValueError, match=tells("expected a scene", "got none")):
        read_scenes(listed(text))


def test_no_list_and_bytes_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=tells("no such file", "a folder or an URL per line")):
        read_scenes(tmp_path / "scenes.txt")
    (tmp_path / "scenes.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=tells("UTF-8")):
        read_scenes(tmp_path / "scenes.txt")


def test_scenes_in_python_have_different_names_too(tmp_path):
    assert as_entries(["a/one", "b/two"])[1].name == "two"
    with pytest.raises(ValueError, match=tells("scenes", "'one' more than once")):
        as_entries(["a/one", "b/one"])
    with pytest.raises(ValueError, match=tells("scenes", "none")):
        as_entries([])
    with pytest.raises(ValueError, match=tells("scenes", "list", "'a/one'")):
        as_entries("a/one")
