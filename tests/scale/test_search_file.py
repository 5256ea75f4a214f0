"""The file of the index: damage, other versions, two writers, kills; and that a class is found without torch."""

import json
import os
import struct
import subprocess
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
from cases_search import save_scenes, scene
from messages import tells
from safetensors.numpy import load_file, save_file

from kfgs._files import locked
from kfgs.scale import SearchIndex
from kfgs.scale.search_file import COLUMNS, NAME, Contents, read_index, write_index
from kfgs.scale.search_update import LOCK


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = save_scenes(
        tmp_path_factory.mktemp("runs"),
        a=scene([("wall", 0.0), ("chair", 0.0)], 1),
        b=scene([("wall", 0.0), ("lamp", 0.0), ("boat", 0.0)], 2),
    )
    SearchIndex.open(folder).update()
    return folder


def rewritten(source, target, change, kind="search index", version=1):
    """A copy of an index file with changed tensors or metadata."""
    tensors = load_file(source)
    change(tensors)
    save_file(tensors, target, metadata={"kfgs": json.dumps({"kind": kind, "version": version})})
    return target


def test_what_is_written_is_read_and_equal_content_gives_equal_bytes(runs, tmp_path):
    found = read_index(runs / NAME)
    write_index(tmp_path / "again", found)
    assert (tmp_path / "again").read_bytes() == (runs / NAME).read_bytes()
    again = read_index(tmp_path / "again")
    for name, entry in found.entries.items():
        for kind, columns in COLUMNS.items():
            for column in columns:
                assert np.array_equal(entry.rows[kind][column], again.entries[name].rows[kind][column])
    write_index(tmp_path / "empty", Contents())
    assert read_index(tmp_path / "empty").entries == {}


def test_another_version_or_kind_is_named(runs, tmp_path):
    newer = rewritten(runs / NAME, tmp_path / "newer", lambda tensors: None, version=2)
    with pytest.raises(
        ValueError, match=tells(newer, "version 1", "version 2", "use the kfgs that wrote it", "delete it")
    ):
        read_index(newer)
    other = rewritten(runs / NAME, tmp_path / "other", lambda tensors: None, kind="semantic field")
    with pytest.raises(ValueError, match=tells(other, "search index", "'semantic field'", "move it away")):
        read_index(other)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("atoms.word", 10_000),
        ("atoms.word", -1),
        ("atoms.views", 99),
        ("atoms.count", 0),
        ("atoms.count", 121),  # of 120
        ("atoms.count", -(1 << 31)),
        ("parts.count", 121),
        ("classes.count", 121),
        ("classes.count", -1),
        ("links.pair", 1 << 20),
        ("parts.label", 77),
        ("parts.view", -2),
        ("atoms.start", 1),
        ("atoms.center", np.nan),
        ("words.0", np.inf),
    ],
)
def test_numbers_that_point_elsewhere_are_refused(runs, tmp_path, name, value):
    def change(tensors):
        assert tensors[name].size
        tensors[name].flat[0] = value

    bad = rewritten(runs / NAME, tmp_path / "bad", change)
    with pytest.raises(ValueError, match=tells(bad, "damaged", "delete it")):
        read_index(bad)


def test_a_few_bytes_that_claim_many_gaussians_take_no_memory_for_each(runs, tmp_path):
    """Gamma of a cosine follows from the scores of all Gaussians: it is found without a row for each."""
    honest = SearchIndex.open(runs).search("chair", score="cosine", negatives="none")

    def change(tensors):
        about = json.loads(tensors["description"].tobytes())
        for one in about["fields"]:
            one["gaussians"] *= 10**7
        tensors["description"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
        tensors["atoms.count"] *= 10**7

    (tmp_path / "runs").mkdir()
    rewritten(runs / NAME, tmp_path / "runs" / NAME, change)
    tracemalloc.start()
    found = SearchIndex.open(tmp_path / "runs").search("chair", score="cosine", negatives="none")
    assert [one.count for one in found.scenes] == [one.count * 10**7 for one in honest.scenes]
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50e6


@pytest.mark.parametrize("name", ["description", "atoms.word", "atoms.start", "classes.0", "words.0"])
def test_missing_and_misshapen_tensors_are_refused(runs, tmp_path, name):
    bad = rewritten(runs / NAME, tmp_path / "bad", lambda tensors: tensors.pop(name))
    with pytest.raises(ValueError, match=tells(bad, "damaged")):
        read_index(bad)
    bad = rewritten(runs / NAME, tmp_path / "bad", lambda tensors: tensors.update({name: tensors[name][:-1]}))
    with pytest.raises(ValueError, match=tells(bad, "damaged")):
        read_index(bad)


def test_cut_and_flipped_bytes_are_one_error_or_an_index(runs, tmp_path):
    whole = (runs / NAME).read_bytes()
    bad = tmp_path / NAME
    (length,) = struct.unpack("<Q", whole[:8])
    for cut in (0, 7, 8, 100, 8 + length, len(whole) - 1):
        bad.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=tells(bad, "delete it")):
            SearchIndex.open(tmp_path)
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 200).tolist():
        data = bytearray(whole)
        data[place] ^= 1 << int(rng.integers(8))
        bad.write_bytes(bytes(data))
        with suppress(ValueError):  # damaged, or: no such class
            SearchIndex.open(tmp_path).search("chair")


def test_a_damaged_index_stops_an_update_and_is_made_again_when_deleted(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    (tmp_path / NAME).write_bytes(b"what is this")
    with pytest.raises(ValueError, match=tells(tmp_path / NAME, "delete it")):
        SearchIndex.open(tmp_path)
    (tmp_path / NAME).unlink()
    assert SearchIndex.open(tmp_path).update()[0].search("chair").scenes


def test_the_second_writer_is_told_and_loses_nothing(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    first = SearchIndex.open(tmp_path)
    second = SearchIndex.open(tmp_path)  # both read the same old state
    with locked(tmp_path, LOCK), pytest.raises(ValueError, match=tells("in use", os.getpid(), "wait")):
        second.update()
    first, _ = first.update()
    save_scenes(tmp_path, b=scene([("table", 0.0), ("lamp", 0.0)], 2))
    second, changes = second.update()  # it begins with what the first one wrote, not with what it had read
    assert changes.added == ("b/field",)
    words = first.contents.spaces[0].words
    assert (second.contents.spaces[0].words[: len(words)] == words).all()
    assert second.fields == ("a/field", "b/field")


WRITER = """
import sys
from kfgs.scale import SearchIndex
for _ in range(100):
    try:
        SearchIndex.open(sys.argv[1]).update()
        break
    except ValueError as error:
        assert "in use" in str(error), error
"""


def test_a_folder_in_place_of_the_index_is_named_before_the_work(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0)], 1))
    (tmp_path / NAME).mkdir()
    with pytest.raises(ValueError, match=tells(tmp_path / NAME, "search index", "a folder", "move it away")):
        SearchIndex.open(tmp_path)


def test_searches_go_on_while_the_index_is_replaced(runs, tmp_path):
    """Readers find one of two whole indices at any moment."""
    both = read_index(runs / NAME)
    one = Contents(both.spaces, both.tables, {"a/field": both.entries["a/field"]})
    write_index(tmp_path / NAME, both)
    found = set()
    with ThreadPoolExecutor(1) as pool:
        writing = pool.submit(lambda: [write_index(tmp_path / NAME, (one, both)[i % 2]) for i in range(60)])
        while not writing.done():
            index = SearchIndex.open(tmp_path)
            found.add((len(index), len(index.search("chair").scenes), len(index.search("wall").scenes)))
        writing.result()
    assert found <= {(1, 1, 1), (2, 1, 2)}
    assert found


def test_two_processes_that_write_at_once_make_one_whole_index(tmp_path):
    save_scenes(tmp_path, **{f"s{i}": scene([("wall", 0.0), ("chair", 0.0)], i) for i in range(6)})
    both = [subprocess.Popen([sys.executable, "-c", WRITER, tmp_path]) for _ in range(2)]
    assert 0 in [one.wait(timeout=250) for one in both]
    index = SearchIndex.open(tmp_path)
    assert index.is_current()
    assert len(index.search("chair").scenes) == 6


def test_a_class_is_found_without_torch(runs):
    code = (
        "import sys; from kfgs.cli import main; assert main(sys.argv[1:]) == 0; "
        "print(sorted({'torch', 'scipy', 'kornia', 'pyvista'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, "search", "chair", str(runs)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines[0] == "chair: in 1 of 2 scenes, 57 Gaussians in 1 part"
    assert lines[-1] == "[]"
