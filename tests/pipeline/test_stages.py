import pytest

from kfgs.pipeline.stages import Run


def test_a_finished_stage_is_found_again_by_its_name_and_inputs(tmp_path):
    lines = []

    def made(text, inputs):
        return Run(tmp_path, lines.append).stage("a", inputs, lambda folder: (folder / "value").write_text(text))

    first, other, again = made("one", {"x": 1}), made("two", {"x": 2}), made("three", {"x": 1})
    assert again == first
    assert other.key != first.key
    assert [(stage.folder / "value").read_text() for stage in (first, other)] == ["one", "two"]
    assert [line.split(" in ")[0] for line in lines] == ["a: working", "a: done"] * 2 + ["a: found"]


def test_a_killed_stage_leaves_nothing_and_is_made_again(tmp_path):
    def dies(folder):
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    run = Run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run.stage("a", {}, dies)
    assert list((tmp_path / "stages").iterdir()) == []
    stage = run.stage("a", {}, lambda folder: (folder / "value").write_text("whole"))
    assert sorted(path.name for path in stage.folder.iterdir()) == ["stage.json", "value"]


@pytest.mark.parametrize("text", ["[]", "{}", "{", "", "null", "[1]"])
def test_a_damaged_cache_of_digests_is_made_again(tmp_path, text):
    (tmp_path / "a.npy").write_text("a")
    whole = Run(tmp_path / "run").digests([tmp_path / "a.npy"])
    kept = (tmp_path / "run" / "digests.json").read_text()
    (tmp_path / "run" / "digests.json").write_text(text)
    assert Run(tmp_path / "run").digests([tmp_path / "a.npy"]) == whole
    assert (tmp_path / "run" / "digests.json").read_text() == kept
