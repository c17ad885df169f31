"""Every command, asked without what it needs or with what it cannot use: one sentence, a status, an example."""

import argparse

import pytest

from prior_sg.deploy.cli.main import build_parser, main


def commands(parser, path=()):
    """All commands and groups of commands, with their parsers."""
    yield path, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, one in action.choices.items():
                yield from commands(one, (*path, name))


ALL = list(commands(build_parser()))
NEEDY = [
    path
    for path, parser in ALL
    if any(action.required if action.option_strings else action.nargs not in ("?", "*") for action in parser._actions)
]


@pytest.mark.parametrize(("path", "parser"), ALL, ids=lambda one: " ".join(one) if isinstance(one, tuple) else "")
def test_help_has_an_example(path, parser):
    assert f"prior-sg {' '.join(path)}".strip() in parser.format_help().split("example", 1)[1]


@pytest.mark.parametrize("path", NEEDY, ids=" ".join)
def test_what_is_missing_is_one_sentence_with_an_example(path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(list(path))
    out, err = capsys.readouterr()
    name = " ".join(("prior-sg", *path))
    assert ended.value.code == 2 and out == "" and err.count("\n") == 1
    assert err.startswith(f"{name}: error: the following arguments are required: ")
    assert f"; such as `{name}" in err and err.endswith(f" (see {name} --help)\n")


def test_what_cannot_be_used_is_told_shortly(capsys):
    for words in (["trace", "x" * 9999], ["nosuch"], ["keys", "add", "x" * 9999, "r"], ["run", "--workers", "many"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        err = capsys.readouterr().err
        assert ended.value.code == 2 and err.count("\n") == 1 and len(err) < 2000 and "; such as `prior-sg " in err


@pytest.mark.parametrize(
    "words",
    [
        ["priors", "import", "nosuch"],
        ["priors", "import", "/"],
        ["priors", "export", "--config", "nosuch", "--out", "x", "y"],
        ["doctor", "--config", "nosuch"],
        ["serve-api", "--token-file", "nosuch"],
        ["metrics", "--token-file", "/"],
    ],
    ids=" ".join,
)
def test_what_the_system_says_is_told_without_its_number_and_the_path_twice(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) != 0
    out, err = capsys.readouterr()
    told = " ".join((out + err).split())
    assert "Errno" not in told and ("o such file or directory" in told or "s a directory" in told)
