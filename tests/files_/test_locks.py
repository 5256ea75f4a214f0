import os
import signal
import subprocess
import sys

import pytest
from messages import tells

from kfgs._files import locked

HOLD = """
import sys, time, pathlib
from kfgs._files import locked
with locked(pathlib.Path(sys.argv[1]), "lock"):
    print("held", flush=True)
    time.sleep(100)
"""


def test_the_second_is_told_who_holds_it_and_a_kill_frees_it(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "run"], stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        with (
            pytest.raises(ValueError, match=tells(f"{tmp_path / 'run'}: ", f"process {first.pid} of", "wait")),
            locked(tmp_path / "run", "lock"),
        ):
            pass
        first.send_signal(signal.SIGKILL)
    with locked(tmp_path / "run", "lock"):
        assert f"process {os.getpid()} of" in (tmp_path / "run" / "lock").read_text()


def test_calls_of_one_process_exclude_each_other(tmp_path):
    with (
        locked(tmp_path, "lock"),
        pytest.raises(ValueError, match=tells("in use", os.getpid())),
        locked(tmp_path, "lock"),
    ):
        pass
    with locked(tmp_path, "lock"), locked(tmp_path, "other"):
        pass


def test_what_a_lock_file_says_is_shown_harmless_and_short(tmp_path):
    with locked(tmp_path, "lock"):
        (tmp_path / "lock").write_bytes(b"\x1b[31m\xff" + b"x" * 10_000)
        with pytest.raises(ValueError, match=tells("in use by \\x1b[31m")) as caught, locked(tmp_path, "lock"):
            pass
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(OSError, match=tells(f"{tmp_path / 'file' / 'run'}: ")),
        locked(tmp_path / "file" / "run", "lock"),
    ):
        pass


def link(place):
    place.symlink_to("../mine")


def dangling(place):
    place.symlink_to("../new")


def hard_link(place):
    os.link(place.parent.parent / "mine", place)


@pytest.mark.parametrize("make", [link, dangling, hard_link, os.mkfifo])
def test_a_lock_that_is_no_lock_file_is_named_and_nothing_is_written(tmp_path, make):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "run").mkdir()
    make(tmp_path / "run" / "lock")
    with (
        pytest.raises(ValueError, match=tells(tmp_path / "run" / "lock", "lock file", "delete it")),
        locked(tmp_path / "run", "lock"),
    ):
        pass
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (tmp_path / "new").exists()
