"""The help of every command, and the command lines that docs and help show: true, and in the words of the command line."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import kfgs
from kfgs import cli

REPOSITORY = Path(kfgs.__file__).parents[1]
SHOWN = [
    *sorted(path.name for path in REPOSITORY.glob("*.md") if path.name != "CHANGELOG.md"),  # it names what is gone
    *sorted(
        str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("docs/**/*.md") if "_build" not in path.parts
    ),
    *sorted(str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("notebooks/*_*.py")),
]


def help_of(command, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


def command_lines(text):
    """The lines that run kfgs, also as `-m kfgs`, without their comments and without what follows `&&`."""
    return [
        shlex.split(line, comments=True)
        for line in re.findall(r"(?:^ *|-m )(kfgs [a-z].*?)(?: *&& .*)?$", text.replace("\\\n", " "), re.MULTILINE)
    ]


def run_nothing(monkeypatch):
    """Commands that read their options and do no more; returns the names of those that were called."""
    called = []

    def stub(command):
        def run(**options):
            called.append(command.__name__)

        run.__name__, run.__doc__, run.__annotations__ = command.__name__, command.__doc__, command.__annotations__
        run.__wrapped__ = command
        return run

    monkeypatch.setattr(cli, "COMMANDS", {name: stub(command) for name, command in cli.COMMANDS.items()})
    return called


@pytest.mark.parametrize("command", sorted(cli.COMMANDS))
def test_help_is_short_and_has_no_python_in_it(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(command, capsys)
    assert "None" not in text
    assert "(default: )" not in text
    positionals = [name for name in cli.shown_names(cli.COMMANDS[command]).values() if name.isupper()]
    usage = re.sub(r"[\[\]]", "", text.splitlines()[0])
    assert re.sub(r" --\S+( (?!--)\S+)?", "", usage).endswith(" ".join(positionals))
    main_options = text.split("─ options ─")[1].split("╰")[0] if "─ options ─" in text else ""
    assert len(re.findall(r"^│ --", main_options, re.MULTILINE)) <= 8
    assert max(map(len, text.split("Examples:")[0].splitlines()[1:])) <= 80  # without tyro's usage
    assert f"kfgs {command} " in text.split("Examples:")[1] or command == "demo"


@pytest.mark.parametrize("command", sorted(cli.COMMANDS))
def test_examples_are_understood(command, capsys, monkeypatch):
    lines = command_lines(help_of(command, capsys))
    assert lines
    called = run_nothing(monkeypatch)
    for line in lines:
        assert cli.main(line[1:]) == 0
    assert called == [line[1] for line in lines]
    assert command in called


@pytest.mark.parametrize("name", SHOWN)
def test_command_lines_in_the_docs_are_understood(name, monkeypatch):
    if not (REPOSITORY / name).is_file():
        pytest.skip("kfgs is installed without its repository")
    called = run_nothing(monkeypatch)
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    quoted = [one for one in re.findall(r"`(kfgs [a-z]+ [^`]*)`", text.replace("\n", " ")) if "..." not in one]
    lines = [line for block in blocks for line in command_lines(block)]
    complete = [shlex.split(one) for one in quoted if "--out" in one or "--color" in one]
    for line in lines + complete:
        assert cli.main(line[1:]) == 0, line
    assert len(called) == len(lines) + len(complete)
    for line in (line for line in map(str.split, quoted)):
        known = cli.shown_names(cli.COMMANDS[line[1]]).values()
        assert {word for word in line if word.startswith("--")} <= {*known, "--help"}, line


# of SplatTransform, Dask, gsplat
OF_OTHERS = {"--spz-version", "--nthreads", "--no-normalize-world-space"}
OF_BENCHMARKS = {"--kinds", "--quick", "--room-0", "--whole", "--atoms", "--copies", "--compare", "--check"}


@pytest.mark.parametrize("name", SHOWN)
def test_an_option_that_the_docs_name_exists(name):
    known = {"--help", "--version", cli.STRICT, *OF_OTHERS, *OF_BENCHMARKS}
    for command in cli.COMMANDS.values():
        known |= {word for word in cli.shown_names(command).values() if word.startswith("--")}
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    named = {
        word
        for code in re.findall(r"`((?:--|kfgs )[^`\n]+)`", text)
        for word in re.findall(r"(?<!\S)--[a-z][\w-]*", code)
    }
    assert {word for word in named if word not in known and word.replace("--no-", "--", 1) not in known} == set()


def test_a_home_folder_is_understood_everywhere(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "words.txt").write_text("wall\nfloor\n")
    words = ["--words", "~/words.txt", "--teacher", "cases_text:TEACHER", "--out=~/t.safetensors"]
    assert cli.main(["features", *words]) == 0
    assert (tmp_path / "t.safetensors").is_file()
    assert cli.main(["convert", "~/nothing"]) == 1
    assert f"{tmp_path}/nothing" in capsys.readouterr().err


def test_version_and_overview(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"kfgs {kfgs.__version__}\n"
    assert cli.main(["--help"]) == 0
    said = capsys.readouterr().out
    for command in cli.COMMANDS:
        assert f"\n  {command} " in said
    for given, hint in ((["fitt"], "did you mean 'fit'?"), ([], "`kfgs --help` lists them")):
        with pytest.raises(SystemExit) as stop:
            cli.main(given)
        assert stop.value.code == 2
        assert hint in capsys.readouterr().err


def test_a_wrong_choice_is_told_the_words_that_can_be_given(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        cli.main(["fit", "scene", "--out", "run", "--method", "fast"])
    assert stop.value.code == 2
    said = capsys.readouterr()
    told = re.search(r"Expected one of \((.*?)\)", said.out + said.err)
    assert re.findall(r"'(.*?)'", told[1]) == ["uplift", "paper", "paper-full", "grown", "adc", "decouple"]


@pytest.mark.parametrize("flags", [(), ("-OO",)])
def test_help_is_there_without_docstrings(flags, capsys):
    """PYTHONOPTIMIZE=2 and -OO leave docstrings out, which are the texts of help."""
    words = [sys.executable, *flags, "-m", "kfgs", "--help"]
    env = {**os.environ, "PYTHONOPTIMIZE": "" if flags else "2", "COLUMNS": "100"}
    shown = subprocess.run(words, env=env, capture_output=True, text=True, check=True).stdout
    assert "Find the Gaussians of a class or phrase" in shown


def test_a_folder_called_kfgs_does_not_hide_the_command(tmp_path):
    (tmp_path / "kfgs").mkdir()
    (tmp_path / "kfgs" / "__init__.py").touch()
    words = [sys.executable, "-P", "-c", "import sys, kfgs.__main__ as m; sys.exit(m.run())", "--version"]
    env = {**os.environ, "PYTHONOPTIMIZE": "2"}
    assert subprocess.run(words, env=env, cwd=tmp_path, capture_output=True, check=True).stdout.startswith(b"kfgs ")
