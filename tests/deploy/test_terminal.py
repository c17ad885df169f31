"""Outside text reaches the terminal as text, in every way that leads there."""

import ast
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.terminal import Description, Table, Terminal, line
from prior_sg.schemas.names import DIRECTIONS, shown
from tests.help.homes import marked_home
from tests.help.paths import ROOT

FULL = Path("/dev/full")
UNBUFFERED = {"PYTHONUNBUFFERED": "1"}
HOSTILE = [
    "tv corner [/den]",
    "lounge [east]",
    "sort [/x] bins",
    "[bold]x[/bold]",
    ":smile:",
    "[link=file:///]a[/link]",
]
COMMANDS = ["\x1b[31mred", "a\x9b2Jb", "\x00", "\x07", "\r over", "\u202etxt", "half \ud83d", "\u2028"]


def terminal(width: int = 120, **options) -> tuple[Terminal, io.StringIO]:
    file = io.StringIO()
    return Terminal(file=file, width=width, **options), file


def everywhere(text: str) -> str:
    """The text by every way to the terminal."""
    console, file = terminal(force_terminal=True, color_system=None)
    console.print(text)
    console.print(line("a ", (text, "bold")))
    table = Table(text, "b", title=text)
    table.add_row(text, "c")
    console.print(table)
    with console.status(text) as status:
        status.update(text)
        console.print(status.renderable)
    return file.getvalue()


@pytest.mark.parametrize("text", HOSTILE)
def test_markup_is_printed_literally(text):
    console, file = terminal()
    table = Table(text, title=text)
    table.add_row(text)
    console.print(text, line((text, "bold")), table)
    with console.status(text) as status:
        status.update(text)
        console.print(status.renderable)
    assert file.getvalue().count(text) == 6


@pytest.mark.parametrize("text", COMMANDS)
def test_what_a_terminal_would_obey_does_not_reach_it(text):
    console, file = terminal()
    table = Table(text, title=text)
    table.add_row(text)
    console.print(text, line(text), table)
    with console.status(text) as status:
        console.print(status.renderable)
    assert "?" in file.getvalue()
    assert not set(file.getvalue()) & (set(DIRECTIONS) | set(map(chr, {*range(32), *range(127, 160)} - {10})))
    file.getvalue().encode()


@settings(max_examples=60)
@given(st.text(st.characters(), max_size=30))
def test_any_text_can_be_printed(text):
    everywhere(text).encode()


def test_progress_takes_no_markup():
    class Row:
        description = "asking [/x] \x1b[2J"

    assert Description().render(Row()).plain == "asking [/x] ?[2J"


def test_what_the_encoding_lacks_is_a_question_mark():
    raw = io.BytesIO()
    console = Terminal(file=io.TextIOWrapper(raw, encoding="ascii", errors="replace", write_through=True))
    table = Table("Großküche")
    table.add_row("salon 🛋")
    console.print("30 m² ± 2", table)
    assert b"Gro?k?che" in raw.getvalue() and b"salon ?" in raw.getvalue()


def test_ordinary_text_of_any_language_stays():
    for text in ("Großküche", "café", "居間", "غرفة", "👩‍🍳 kitchen", "a\nb\tc"):
        assert shown(text) == text


def test_house_rule_nothing_else_makes_a_console_or_writes_markup():
    """A new print cannot bring the fault back: strings hold no tags, and there is one kind of console."""
    tag = re.compile(r"\[/?(?:bold|dim|italic|red|green|yellow|blue|magenta|cyan|white|/|link)\b[^\]]*\]|\[/\]")
    ours = ("rich.console", "rich.markup", "rich.status", "rich.table")
    found = []
    for path in sorted((ROOT / "deploy").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if path.name == "terminal.py":
                continue
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and tag.search(node.value):
                found.append(f"{path.name}:{node.lineno}: markup in a string")
            if isinstance(node, ast.ImportFrom) and node.module in ours:
                found.append(f"{path.name}:{node.lineno}: imports {node.module}; use prior_sg.deploy.terminal")
            if isinstance(node, ast.Name) and node.id == "TextColumn":
                found.append(f"{path.name}:{node.lineno}: use Description")
            if isinstance(node, ast.Attribute) and node.attr in ("from_markup", "from_ansi"):
                found.append(f"{path.name}:{node.lineno}: {node.attr}")
    assert not found


@pytest.mark.parametrize("more", [{}, UNBUFFERED])
def test_what_zenoh_says_is_on_standard_error_and_results_alone_on_standard_output(endpoint, more):
    command = [sys.executable, "-m", "prior_sg.deploy.cli.main", "health", "--json", "--connect", endpoint]
    environment = os.environ | {"RUST_LOG": "zenoh=info", "PYTHONUNBUFFERED": ""} | more
    done = subprocess.run(command, capture_output=True, check=False, text=True, timeout=60, env=environment)
    assert "processes" in json.loads(done.stdout)
    assert "zenoh::" in done.stderr


@pytest.mark.skipif(not FULL.exists(), reason="no file that is always full")
@pytest.mark.parametrize("more", [{}, UNBUFFERED])
@pytest.mark.parametrize(
    "words", [["topics"], ["query", "--json", "marker", "--scene"], ["query", "marker", "--scene"]]
)  # by Python's print, by the console
def test_a_full_disk_under_the_results_is_one_sentence(words, more, tmp_path):
    """Also where standard output has another file than Python gave it, and where it is written at the end."""
    path = tmp_path / "scene.json"
    Scene(marked_home()).save(path)
    command = [sys.executable, "-m", "prior_sg.deploy.cli.main", *words, *([path] if len(words) > 1 else [])]
    environment = os.environ | {"PYTHONUNBUFFERED": ""} | more
    with FULL.open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, check=False, text=True, timeout=60, env=environment
        )
    assert done.returncode == 1 and done.stderr.startswith("prior-sg: there is no space left")
    assert done.stderr.count("\n") == 1 and "--out" not in done.stderr, done.stderr  # which not all commands have


def test_a_reader_that_has_left_is_no_news():
    command = [sys.executable, "-m", "prior_sg.deploy.cli.main", "topics"]
    environment = os.environ | {"PYTHONUNBUFFERED": ""}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as asked:
        asked.stdout.close()
        assert asked.wait(60) == 1 and asked.stderr.read() == ""


def test_a_table_cuts_no_name_off():
    printed = io.StringIO()
    rows = Table("topic", "serves as")
    rows.add_row("/robot_1/camera/aligned_depth_to_color/image_raw", "depth")
    Terminal(file=printed, width=30).print(rows)
    first = "".join(row.split("│")[1].strip() for row in printed.getvalue().splitlines() if row.startswith("│"))
    assert first == "/robot_1/camera/aligned_depth_to_color/image_raw"


def test_a_column_that_may_not_be_wrapped_shows_where_it_had_to_be_cut():
    printed = io.StringIO()
    rows = Table("what")
    rows.add_column("digest", no_wrap=True)
    rows.add_row("x", "0123456789abcdef" * 4)
    Terminal(file=printed, width=30).print(rows)
    assert "…" in printed.getvalue()
