"""What the documents name exists: files, functions in them, commands with their options, settings, links.

A function is named as `file.py::function` or `file.py::Class.method`, the file from the root or from its room.
"""

import argparse
import ast
import importlib
import re
import shlex
import tomllib
import typing
from functools import cache

import msgspec
import pytest

from prior_sg.deploy.cli.main import build_parser
from prior_sg.services.registry import BY_NAME
from tests.help.paths import ROOT

DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
OURS = {path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith(".")} - {"out", "build"}
SOURCES = [
    file for folder in ("deploy", "schemas", "services", "tests", "examples") for file in ROOT.glob(f"{folder}/**/*")
]
FENCE = re.compile(r"```[^\n]*\n(.*?)```", re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
PLACEHOLDER = re.compile(r"<\w+>|\bNAME\b")


def spans(text):
    """What stands in single backticks, outside of fences."""
    return [span.replace("\n", " ") for span in re.findall(r"`([^`]+)`", FENCE.sub("", text))]


def is_path(span):
    """Files and folders of the repository, also named from within their room; not those of users."""
    if not re.fullmatch(r"[\w./<>*-]+", span):
        return False
    return (span.split("/")[0] in OURS and "/" in span) or bool(re.fullmatch(r"[\w/<>-]+\.py", span))


def files_of(path):
    """The files or folders that a path means: from the root, else, of code, from any room."""
    found = list(ROOT.glob(PLACEHOLDER.sub("*", path.rstrip("/"))))
    return found or [file for file in SOURCES if path.endswith(".py") and str(file).endswith("/" + path)]


def lacking(document):
    """Paths and functions that a document names and nobody finds."""
    for span in spans(document.read_text(encoding="utf-8")):
        path, _, name = span.partition("::")
        if is_path(path) and not any(not name or name in names_in(file) for file in files_of(path)):
            yield span


@cache
def names_in(file):
    """Functions, classes and methods of a file, as `name` or `Class.method`."""
    found = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        found |= {node.name} if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) else set()
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{inner.name}" for inner in node.body if hasattr(inner, "name")}
    return found


def commands_in(text):
    """Every `prior-sg COMMAND …` of a text, in backticks or in fences, as words."""
    code = [*spans(text), *(line for fence in FENCE.findall(text) for line in fence.replace("\\\n", " ").splitlines())]
    for line in code:
        for call in re.findall(r"(?:^|[\s/])prior-sg ([^#|]+)", line):
            yield call.split()


def subparsers(parser):
    found = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return found[0].choices if found else {}


def unknown(words, parser, said):
    """What of a call the parser does not know; words in capitals stand for anything."""
    if inner := subparsers(parser):
        word = re.match(r"[a-z-]*", words[0]).group() if words else ""
        if word in inner:
            return unknown(words[1:], inner[word], f"{said} {word}")
        return [f"{said} {word}"] if word else []
    options = re.findall(r"(?:^|\s)(--[a-z][a-z-]*)", " ".join(words))
    return [f"{said} {option}" for option in options if option not in parser._option_string_actions]


def has_setting(config, names):
    """Whether a config has this field, in groups one level per name."""
    fields = {field.name: field.type for field in msgspec.structs.fields(config)}
    if names[0] not in fields:
        return False
    inner = fields[names[0]]
    if len(names) == 1:
        return True
    if typing.get_origin(inner) is dict:
        return len(names) == 2
    return isinstance(inner, type) and issubclass(inner, msgspec.Struct) and has_setting(inner, names[1:])


def settings_in(text):
    """Every SERVICE.FIELD that stands in code, without its value."""
    code = "\n".join([*spans(text), *FENCE.findall(text)])
    services = "|".join(BY_NAME)
    return set(re.findall(rf"(?<![\w./])(?:{services})(?:\.[a-z_0-9]+)+(?![\w/(])", code))


def anchors(text):
    """What a link may point to: headings as they are turned into anchors."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def leads_nowhere(document, target):
    if re.match(r"\w+://", target):
        return False
    path, _, anchor = target.partition("#")
    file = document.parent / path if path else document
    return not file.exists() or (bool(anchor) and anchor not in anchors(file.read_text(encoding="utf-8")))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_files_and_functions_exist(document):
    assert list(lacking(document)) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_and_options_exist(document):
    calls = commands_in(document.read_text(encoding="utf-8"))
    assert [fault for words in calls for fault in unknown(words, build_parser(), "prior-sg")] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_settings_exist(document):
    named = [name.split(".") for name in settings_in(document.read_text(encoding="utf-8"))]
    assert [".".join(names) for names in named if not has_setting(BY_NAME[names[0]].config, names[1:])] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document):
    targets = LINK.findall(FENCE.sub("", document.read_text(encoding="utf-8")))
    assert [target for target in targets if leads_nowhere(document, target)] == []


def test_the_readme_leads_to_every_page():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = set(LINK.findall(readme))
    assert [page.name for page in (ROOT / "docs").glob("*.md") if f"docs/{page.name}" not in targets] == []


def test_the_map_of_the_rooms_is_complete():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = re.search(r"```text\n(.*?)```", page, re.DOTALL)[1]
    named = {line.split()[0].rstrip("/") for line in rooms.splitlines()}
    packages = {str(file.parent.relative_to(ROOT)) for file in SOURCES if file.name == "__init__.py"}
    assert sorted(packages - named) == []
    assert [room for room in sorted(named) if not (ROOT / room).is_dir()] == []


def test_what_does_not_exist_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "`services/registry.py` `services/gone.py` `energy/solver.py` `moves.py` `services/<name>/service.py`\n"
        "`a/b.json` "
        "`services/intent.py::hear` `services/intent.py::heed` `deploy/api/client.py::Client.task`\n"
        "`prior-sg run PATH --task x` `prior-sg walk` `prior-sg run --tusk x` `prior-sg priors list`\n"
        "`prior-sg COMMAND` "
        "`segmenter.beta` `segmenter.balance.limit` `segmenter.gone` `segmenter.balance.gone` `segmenter.experts`\n"
        "[a](page.md#top) [b](gone.md) [c](page.md#bottom) [d](https://example.org)\n# Top\n"
    )
    text = page.read_text()
    assert list(lacking(page)) == ["services/gone.py", "moves.py", "services/intent.py::heed"]
    faults = [fault for words in commands_in(text) for fault in unknown(words, build_parser(), "prior-sg")]
    assert faults == ["prior-sg walk", "prior-sg run --tusk"]
    named = sorted(settings_in(text))
    wrong = [name for name in named if not has_setting(BY_NAME["segmenter"].config, name.split(".")[1:])]
    assert wrong == ["segmenter.balance.gone", "segmenter.gone"]
    assert [target for target in LINK.findall(text) if leads_nowhere(page, target)] == ["gone.md", "page.md#bottom"]


CAPITALS = re.compile(r"(?<![\w.])[A-Z][A-Z_]+(?![\w.])|[…\[\]]|\.\.\.")  # placeholders, and parts left out


def shell_lines(text):
    """Lines of fences that a shell would take, as words; continued ones joined, comments and redirections left out."""
    for kind, fence in re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL):
        if kind in ("sh", "bash", "console"):
            yield from (line for line in fence.replace("\\\n", " ").splitlines() if line.strip())


def misused(text):
    """Calls in fences that no placeholder leaves open and that the command would refuse."""
    for line in shell_lines(text):
        for call in re.findall(r"(?:^|[;&|] *|bin/)prior-sg ([^#|>]+)", line):
            if CAPITALS.search(call) or ("'" in line and call.count("'") % 2):
                continue
            words = shlex.split(call.split(" && ")[0].split("; ")[0].rstrip("& "))
            try:
                build_parser().parse_args(words)
            except SystemExit as ended:
                if ended.code:
                    yield call.strip()


def nowhere(text):
    """Targets of make, modules, extras and files that fences name and that do not exist."""
    code = "\n".join(shell_lines(text))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in code.splitlines():
        for words in re.findall(r"(?:^|[;&] *)make ((?:[a-z-]+ ?)+)", line.partition("#")[0]):
            yield from (f"make {word}" for word in words.split() if word not in targets)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for names in re.findall(r"(?:prior-sg|'\.|\"\.|\s\.)\[([a-z0-9,-]+)\]", text):
        yield from (f"[{name}]" for name in names.split(",") if name not in project["optional-dependencies"])
    for module in re.findall(r"python3? -m ((?:prior_sg|tests)[\w.]*)", text):
        path = module.replace("prior_sg.", "src/prior_sg/", 1).replace(".", "/")
        if not ((ROOT / f"{path}.py").is_file() or (ROOT / path / "__main__.py").is_file()):
            yield f"python -m {module}"
    for path in re.findall(r"(?<![\w/.-])((?:deploy|tests|docs|examples|services|schemas)/[\w./@-]*\w)", code):
        if not (ROOT / path).exists():
            yield path


def pythons(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_calls_in_fences_would_be_taken(document, capsys):
    assert list(misused(document.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_what_fences_name_is_there(document):
    assert list(nowhere(document.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_python_in_fences_imports_what_exists(document):
    for code in pythons(document.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("prior_sg"):
                module = importlib.import_module(node.module)
                assert [name.name for name in node.names if not hasattr(module, name.name)] == []
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "prior_sg":
                assert node.attr in dir(importlib.import_module("prior_sg"))


def test_what_fences_say_wrongly_is_found(capsys):
    text = (
        "```sh\nprior-sg query near 1 2 3 --what house\nprior-sg fleet robot1\nprior-sg trace twelve | less\n"
        "prior-sg run PATH --task x\nprior-sg health  # all\nmake demo tests\npip install -e '.[api,apy]'\n"
        "python -m tests.fuzzy --inputs 2\npytest tests/services/segmenter tests/services/segmentor\n```\n"
    )
    refused = [call.split()[0] for call in misused(text)]
    assert refused == ["query", "fleet", "trace"]
    assert list(nowhere(text)) == ["make tests", "[apy]", "python -m tests.fuzzy", "tests/services/segmentor"]
