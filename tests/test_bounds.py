"""The table of bounds in docs/operations.md says what the code does, and leaves out nothing of the kinds it lists."""

import importlib
import re
from pathlib import Path

import msgspec
import pytest

from prior_sg.schemas import topics
from prior_sg.schemas.topics import TOPICS
from prior_sg.services.registry import BY_NAME, SERVICES
from tests.help.paths import ROOT

ROW = re.compile(r"\| .+ \| (\d+) \| `([^`]+)`(?: in `([^`]+)`)? \| .+ \|")
BOUND = re.compile(r"(\w*_mb|kept_\w+|history_last|remembered_\w+|window|archive_patience)")
ENDLESS = re.compile(r"\bdeque\(\)|SimpleQueue\(\)|\bQueue\(\)|lru_cache\(maxsize=None\)|@cache\b")
MAY_GROW = {  # what is emptied by its owner, or holds one entry for each type, topic or part of the program
    "schemas/codec.py",
    "services/feature_pyramid/encoders/onnx_session.py",
    "services/ingest/core/ros/assembly.py",
    "services/ingest/sources/ros/reader.py",
    "services/ingest/sources/recording.py",
    "services/runtime/record.py",
    "services/runtime/jobs/board.py",
    "services/runtime/jobs/dispatcher.py",
    "services/runtime/ros/types.py",
    "services/runtime/runner.py",
    "deploy/api/client.py",
    "deploy/api/embedding.py",
    "deploy/evaluation/simulated.py",
    "deploy/running/recorder.py",
}


def rows():
    text = (ROOT / "docs" / "operations.md").read_text()
    section = text.partition("\n## Bounds\n")[2].partition("\n## ")[0]
    found = [row.groups() for row in ROW.finditer(section)]
    assert len(found) == section.count("\n|") - 2  # all but head and rule
    return [(f"{path}::{name}" if path else name, int(limit)) for limit, name, path in found]


def value_of(where):
    """What the code says: a constant of a file, a setting of a service, or a topic's cache."""
    if "::" in where:
        path, name = where.split("::")
        return getattr(importlib.import_module("prior_sg." + path.removesuffix(".py").replace("/", ".")), name)
    first, *fields = where.split(".")
    found = BY_NAME[first].config() if first in BY_NAME else getattr(topics, first)
    for field in fields:
        found = getattr(found, field)
    return found


@pytest.mark.parametrize(("where", "limit"), rows(), ids=str)
def test_the_table_says_what_the_code_does(where, limit):
    assert value_of(where) == limit


def settings_of(config, prefix):
    for field in msgspec.structs.fields(config):
        held = getattr(config, field.name)
        if isinstance(held, msgspec.Struct):
            yield from settings_of(held, f"{prefix}.{field.name}")
        elif BOUND.fullmatch(field.name):
            yield f"{prefix}.{field.name}"


def test_every_setting_that_bounds_something_and_every_cache_is_in_the_table():
    listed = {where for where, _ in rows()}
    settings = {name for service in SERVICES for name in settings_of(service.config(), service.name)}
    caches = {f"{topic.name}.cache" for topic in TOPICS if topic.cache}
    assert len(settings) >= 8 and settings | caches <= listed


def test_no_queue_without_an_end_is_made_elsewhere():
    found = {
        str(path.relative_to(ROOT))
        for folder in ("schemas", "services", "deploy")
        for path in Path(ROOT / folder).rglob("*.py")
        if ENDLESS.search(path.read_text())
    }
    assert found == MAY_GROW
