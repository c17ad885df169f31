"""`prior-sg keys` and `router`, as a user meets them."""

import json
import os

import pytest
import zenoh

from prior_sg.deploy.cli.main import main
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.keys import VARIABLE


@pytest.fixture
def said(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv(VARIABLE, "")

    def say(*words):
        status = main(list(words))
        out = capsys.readouterr()
        return status, " ".join((out.out + out.err).split())

    return say


def test_keys_are_made_listed_replaced_and_revoked(said, tmp_path):
    assert "run `prior-sg keys init`" in said("keys", "add", "robot", "robot7")[1]
    for words in (["init"], ["add", "edge", "edge1"], ["add", "robot", "robot7"], ["rotate", "robot7"]):
        assert said("keys", *words)[0] == 0
    said("keys", "add", "viewer", "anna")
    status, told = said("keys", "revoke", "anna")
    assert status == 0 and "edge1 must know" in told
    listed = json.loads(said("keys", "list", "--json")[1])
    assert [(one["name"], one["issue"], one.get("revoked", False)) for one in listed] == [
        ("edge1", 1, False),
        ("robot7", 2, False),
        ("anna", 1, True),
    ]
    assert (tmp_path / "prior-sg/keys/bundles/robot7/key.pem").stat().st_mode & 0o777 == 0o600


def test_a_router_for_others_needs_keys_and_can_be_written_for_zenohd(said, tmp_path):
    assert "prior-sg keys init" in said("router", "--listen", "tls/0.0.0.0:7448")[1]
    said("keys", "init")
    said("keys", "add", "edge", "edge1")
    said("keys", "add", "robot", "robot7")
    bundles, file = tmp_path / "prior-sg/keys/bundles", tmp_path / "router.json5"
    words = ("router", "--listen", "tls/0.0.0.0:7448", "--write", str(file))
    assert "no key of an edge" in said(*words, "--keys", str(bundles / "robot7"))[1]
    assert said(*words, "--keys", str(bundles / "edge1"))[0] == 0
    config = zenoh.Config.from_file(str(file))
    assert config.get_json("access_control/default_permission") == '"deny"'
    assert config.get_json("transport/shared_memory/enabled") == "false"
    assert os.environ[VARIABLE] == str(bundles / "edge1")
    assert said(*words, "--keys", str(bundles / "edge1"), "--thin-link", "500k")[0] == 0
    assert zenoh.Config.from_file(str(file)).get_json("transport/link/tls/so_sndbuf") == "15625"
    assert "--thin-link is of links to other hosts" in said("router", "--thin-link", "2M")[1]
    mapper = ("up", "place_graph", "--listen", "tls/127.0.0.1:7448", "--thin-link", "2M")
    assert (
        "run it where ingest runs" in said(*mapper, "--keys", str(bundles / "edge1"), "--out", str(tmp_path / "o"))[1]
    )
    with pytest.raises(SystemExit):
        said("router", "--thin-link", "fast")
    words = ("up", "ingest", "--robot", "robot8", "--join", "tls/127.0.0.1:7448", "--out", str(tmp_path / "out"))
    assert "these keys are of robot7" in said(*words, "--keys", str(bundles / "robot7"))[1]


def test_the_router_of_up_knows_of_a_thin_link(said, tmp_path, monkeypatch):
    reached = []

    def open_router(endpoint, beyond):
        reached.append(beyond)
        raise BusError("seen")

    monkeypatch.setattr("prior_sg.deploy.running.swaps.open_router", open_router)
    said("keys", "init")
    said("keys", "add", "edge", "edge1")
    keys = str(tmp_path / "prior-sg/keys/bundles/edge1")
    words = ("up", "prior_gateway", "--listen", "tls/127.0.0.1:7448", "--keys", keys, "--out", str(tmp_path / "out"))
    assert said(*words, "--thin-link", "2M")[1].endswith("seen")
    assert [one.thin_bps for one in reached] == [2e6]
