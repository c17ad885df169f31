"""Layers of configuration: later ones win, faults are one sentence that names the setting."""

import math
import re
import typing
from typing import Literal, get_args

import msgspec
import pytest

from prior_sg.schemas.codec import Signed
from prior_sg.services.registry import BY_NAME, SERVICES
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
        (["segmenter.beta=much"], "segmenter.beta takes a finite number that is not negative; got 'much'"),
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


@pytest.mark.parametrize(
    ("service", "setting", "why"),
    [
        ("ingest", "window=0", "window is 0: with less than 1 the source would wait for ever"),
        ("ingest", "window=-5", r"ingest\.window takes a whole number that is not negative; got '-5'"),
        ("ingest", "speed=-1", r"ingest\.speed takes a finite number that is not negative; got '-1'"),
        ("scene_store", "checkpoint_pages=0", "checkpoint_pages must be at least 1"),
    ],
)
def test_numbers_under_which_nothing_goes_on_are_refused(service, setting, why):
    with pytest.raises(ConfigError, match=why):
        resolve(BY_NAME[service].config, service, from_arguments([f"{service}.{setting}"]))


def settings_with_numbers(config, path=()):
    """Name within the service, type and default of every setting that is a number or several."""
    for field in msgspec.structs.fields(type(config)):
        default, kinds = getattr(config, field.name), set(parts_of(field.type))
        if isinstance(default, msgspec.Struct):
            yield from settings_with_numbers(default, (*path, field.name))
        elif kinds & {int, float}:
            yield ".".join((*path, field.name)), field.type, default


def parts_of(kind):
    yield kind
    for part in get_args(kind):
        yield from parts_of(part)


NUMBERS = [
    pytest.param(service, *found, id=f"{service.name}.{found[0]}")
    for service in SERVICES
    for found in settings_with_numbers(service.config())
]
OF_EITHER_SIGN = [one for one in NUMBERS if Signed in parts_of(one.values[2])]


def within(value, default, kind):
    """A number as a setting holds it: alone, or in a list or mapping as long as its default."""
    if isinstance(default, dict):
        return dict.fromkeys(default, value)
    if isinstance(default, list | tuple) or list in map(typing.get_origin, (kind, *get_args(kind))):
        return [value] * max(1, len(default or ()))
    return value


@pytest.mark.parametrize(("service", "name", "kind", "default"), NUMBERS)
def test_no_setting_is_infinite_or_no_number_and_none_is_negative_that_does_not_say_so(service, name, kind, default):
    kinds = set(parts_of(kind))
    for value in (math.nan, math.inf, -math.inf, *(() if Signed in kinds else (-1, -1e-9))):
        given = {service.name: {name: within(value, default, kind)}}
        with pytest.raises(ConfigError, match=re.escape(f"{service.name}.{name} takes ")) as raised:
            resolve(service.config, service.name, given)
        assert "number" in str(raised.value) and str(value) in str(raised.value)


def test_defaults_are_settings_and_few_may_be_negative():
    for service in SERVICES:
        defaults = msgspec.to_builtins(service.config())
        assert resolve(service.config, service.name, {service.name: defaults}) == service.config()
    assert len(NUMBERS) > 250 and len(OF_EITHER_SIGN) < 60
    assert {one.id.rpartition(".")[0] for one in OF_EITHER_SIGN} == {"ingest", "place_graph", "segmenter.foresight"}


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("ingest.window=1.5", "ingest.window takes a whole number that is not negative; got '1.5'"),
        ("ingest.every_frame=2", "ingest.every_frame takes true or false; got '2'"),
        ("ingest.clock=x", "ingest.clock takes one of 'header', 'received'; got 'x'"),
        ("ingest.stamp_offset_s=x", "ingest.stamp_offset_s takes a finite number or null; got 'x'"),
        ("ingest.world_up=3", "ingest.world_up takes a list, of which each is a finite number; got '3'"),
        (
            "segmenter.sizes.side_m=[1]",
            "segmenter.sizes.side_m takes a list of 2, of which each is a finite number that is not negative; got [1]",
        ),
        (
            'segmenter.experts={"visual": -1}',
            "segmenter.experts takes names, each with a finite number that is not negative; got {'visual': -1}",
        ),
        (
            'segmenter.tracking={"cell_m": -1}',
            "segmenter.tracking.cell_m takes a finite number that is not negative; got -1",
        ),
        (
            "segmenter.tracking=3",
            "segmenter.tracking is a group of settings; name one of them, as segmenter.tracking.cell_m",
        ),
    ],
)
def test_a_refused_value_is_told_with_its_setting_and_what_is_allowed(setting, sentence):
    service = BY_NAME[setting.partition(".")[0]]
    with pytest.raises(ConfigError) as raised:
        resolve(service.config, service.name, from_arguments([setting]))
    assert str(raised.value) == sentence


@pytest.mark.parametrize(
    "setting", ["segmenter.footprint_cell_m", "segmenter.look_ms", "segmenter.foresight.opening_height_m"]
)
def test_what_is_divided_by_is_not_zero(setting):
    with pytest.raises(ConfigError) as raised:
        resolve(BY_NAME["segmenter"].config, "segmenter", from_arguments([f"{setting}=0"]))
    assert str(raised.value) == f"{setting} takes a finite number above 0; got '0'"


def test_what_may_be_negative_still_may():
    cfg = resolve(BY_NAME["ingest"].config, "ingest", from_arguments(["ingest.floor_m=-2", "ingest.world_up=[0,0,-1]"]))
    assert (cfg.floor_m, cfg.world_up) == (-2.0, [0.0, 0.0, -1.0])
