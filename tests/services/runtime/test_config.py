"""Layers of configuration: later ones win, faults are one sentence that names the setting."""

from typing import Literal

import msgspec
import pytest

from prior_sg.services.runtime.config import (
    ConfigError,
    from_arguments,
    from_environment,
    merge,
    read_file,
    recorded,
    resolve,
)


class Group(msgspec.Struct, frozen=True, kw_only=True):
    limit: float = 0.5
    count: int = 3


class Grouped(msgspec.Struct, frozen=True, kw_only=True):
    group: Group = Group()
    weights: dict[str, float] = msgspec.field(default_factory=dict)


class Config(msgspec.Struct, frozen=True, kw_only=True):
    beta: float = 2.0
    names: list[str] = msgspec.field(default_factory=lambda: ["visual"])
    on: bool = True


def test_defaults_file_environment_arguments(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text('[segmenter]\nbeta = 3.0\nnames = ["a"]\n')
    file = read_file(path)
    environment = from_environment({"PSG_SEGMENTER__BETA": "4.5", "PSG_CONNECT": "tcp/x", "HOME": "/"})
    arguments = from_arguments(["segmenter.on=false", 'segmenter.names=["b", "c"]'])
    assert resolve(Config, "segmenter", {}) == Config()
    assert resolve(Config, "segmenter", file) == Config(beta=3.0, names=["a"])
    assert resolve(Config, "segmenter", merge(file, environment)) == Config(beta=4.5, names=["a"])
    assert resolve(Config, "segmenter", merge(file, environment, arguments)) == Config(
        beta=4.5, names=["b", "c"], on=False
    )
    assert resolve(Config, "ingest", merge(file, environment, arguments)) == Config()


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["segmenter.gamma=1"], "segmenter has no setting 'gamma'; it has: beta, names, on"),
        (["segmenter.beta=much"], "segmenter: Expected `float`, got `str`"),
        (["beta=1"], "--set takes SERVICE.FIELD=VALUE"),
        (["segmenter.names=[1"], "segmenter.names: '\\[1' is not valid JSON"),
    ],
)
def test_faults(arguments, sentence):
    with pytest.raises(ConfigError, match=sentence):
        resolve(Config, "segmenter", merge(from_arguments(arguments)))


def test_fields_inside_a_group_are_named_with_dots(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text("[segmenter.group]\nlimit = 0.1\ncount = 7\n")
    environment = from_environment({"PSG_SEGMENTER__GROUP__LIMIT": "0.2"})
    layers = merge(read_file(path), environment)
    assert resolve(Grouped, "segmenter", layers) == Grouped(group=Group(limit=0.2, count=7))
    layers = merge(layers, from_arguments(["segmenter.group.count=9", 'segmenter.weights={"a": 1.5}']))
    assert resolve(Grouped, "segmenter", layers) == Grouped(group=Group(limit=0.2, count=9), weights={"a": 1.5})
    with pytest.raises(ConfigError, match=r"segmenter\.group has no setting 'most'; it has: count, limit"):
        resolve(Grouped, "segmenter", from_arguments(["segmenter.group.most=1"]))
    with pytest.raises(ConfigError, match=r"segmenter has no setting 'weights\.a'"):
        resolve(Grouped, "segmenter", from_arguments(["segmenter.weights.a=1"]))


def test_unreadable_file(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        read_file(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("beta = ")
    with pytest.raises(ConfigError, match=r"bad\.toml"):
        read_file(tmp_path / "bad.toml")
    with pytest.raises(ConfigError, match="outside any section"):
        merge({"beta": 2.0})


def test_a_recorded_config_of_this_version_is_read_as_it_was():
    cfg = Grouped(group=Group(limit=0.75), weights={"a": 2.0})
    assert recorded(Grouped, "segmenter", msgspec.json.encode(cfg)) == (cfg, [])


def test_settings_that_came_or_went_since_a_config_was_recorded_are_reported():
    data = msgspec.json.encode({"group": {"limit": 0.75, "depth": 3}, "weights": {"depth": 2.0}, "old": [1, 2]})
    cfg, notes = recorded(Grouped, "segmenter", data)
    assert cfg == Grouped(group=Group(limit=0.75), weights={"depth": 2.0})
    assert notes == [
        "segmenter.old = [1, 2] was recorded, and is no setting any more: it is left out",
        "segmenter.group.depth = 3 was recorded, and is no setting any more: it is left out",
        "segmenter.group.count was not a setting yet: it gets its default",
    ]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b'{"group": 3}', "does not fit this program: Expected `object`"),
        (b'{"group": {"count": "many"}}', r"does not fit this program: .*\$.group.count"),
        (b"[]", "does not fit"),
        (b"{", "does not fit"),
    ],
)
def test_a_recorded_value_that_no_longer_fits_is_named(data, why):
    with pytest.raises(ConfigError, match=f"the recorded config of segmenter {why}"):
        recorded(Grouped, "segmenter", data)


class Sourced(msgspec.Struct, frozen=True, kw_only=True):
    source: str = ""
    kind: Literal["a", "b"] = "a"
    maybe: str | None = None
    names: list[str] = []


@pytest.mark.parametrize("text", ["[2024] flat", "{a}=b", "[1]", "{}", "[]", '{"a": 1}', "[", "-1", "null", "true"])
def test_a_text_is_text_whatever_it_begins_with(text):
    assert resolve(Sourced, "ingest", from_arguments([f"ingest.source={text}"])).source == text
    assert resolve(Sourced, "ingest", from_environment({"PSG_INGEST__SOURCE": text})).source == text
    if text != "null":
        assert resolve(Sourced, "ingest", from_arguments([f"ingest.maybe={text}"])).maybe == text
    with pytest.raises(ConfigError, match="ingest"):
        resolve(Sourced, "ingest", from_arguments([f"ingest.kind={text}"]))


def test_what_is_no_text_is_named(tmp_path):
    for text in ("a\x00b", "caf\udce9"):
        with pytest.raises(ConfigError, match=r"ingest\.source: .* is not valid text") as raised:
            resolve(Sourced, "ingest", from_arguments([f"ingest.source={text}"]))
        assert str(raised.value).isprintable()
    (tmp_path / "latin.toml").write_bytes(b'[ingest]\nsource = "caf\xe9"\n')
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        read_file(tmp_path / "latin.toml")
    (tmp_path / "bom.toml").write_bytes("\ufeff[ingest]\nsource = 'é'\n".encode())
    assert read_file(tmp_path / "bom.toml") == {"ingest": {"source": "é"}}
