import pytest

from kfgs.pipeline.stages import Run


def _maker(calls: list[str], name: str):
    def make(folder):
        calls.append(name)
        (folder / "value").write_text(name)
        return 0.0

    return make


def test_a_finished_stage_is_found_again_by_another_process(tmp_path):
    calls: list[str] = []
    first = Run(tmp_path).stage("a", {"x": 1}, _maker(calls, "one"))
    again = Run(tmp_path).stage("a", {"x": 1}, _maker(calls, "two"))
    assert calls == ["one"]
    assert again.key == first.key
    assert again.seconds == first.seconds
    assert (again.folder / "value").read_text() == "one"


def test_other_inputs_make_another_stage_and_keep_the_first(tmp_path):
    calls: list[str] = []
    run = Run(tmp_path)
    one = run.stage("a", {"x": 1}, _maker(calls, "one"))
    two = run.stage("a", {"x": 2}, _maker(calls, "two"))
    assert calls == ["one", "two"]
    assert one.key != two.key
    assert (one.folder / "value").read_text() == "one"


def test_a_killed_stage_leaves_nothing_and_is_made_again(tmp_path):
    def dies(folder):
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    run = Run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run.stage("a", {}, dies)
    assert list((tmp_path / "stages").iterdir()) == []
    calls: list[str] = []
    stage = run.stage("a", {}, _maker(calls, "whole"))
    assert sorted(path.name for path in stage.folder.iterdir()) == ["stage.json", "value"]


def test_reports_say_what_was_made_and_what_was_found(tmp_path):
    lines: list[str] = []
    Run(tmp_path, lines.append).stage("a", {}, lambda folder: None)
    Run(tmp_path, lines.append).stage("a", {}, lambda folder: None)
    assert [line.split(" in ")[0] for line in lines] == ["a: working", "a: done", "a: found"]


@pytest.mark.parametrize("text", ["[]", "{}", "{", "", "null", "[1]"])
def test_a_damaged_cache_of_digests_is_made_again(tmp_path, text):
    (tmp_path / "a.npy").write_text("a")
    whole = Run(tmp_path / "run").digests([tmp_path / "a.npy"])
    kept = (tmp_path / "run" / "digests.json").read_text()
    (tmp_path / "run" / "digests.json").write_text(text)
    assert Run(tmp_path / "run").digests([tmp_path / "a.npy"]) == whole
    assert (tmp_path / "run" / "digests.json").read_text() == kept
