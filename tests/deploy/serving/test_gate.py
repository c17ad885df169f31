"""Who may come in."""

import asyncio

import pytest

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.serving.gate import Entrance, Gate, entrance

TOKEN = "a-long-secret-of-ours"
BEARER = ("Authorization", f"Bearer {TOKEN}")


def status(entry, *headers, kind="http"):
    """Of a request with these headers; 200 where it came in."""
    sent = []

    async def app(scope, receive, send):
        await send({"status": 200})

    async def send(message):
        sent.append(message)

    pairs = [(name.encode("latin1"), value.encode("latin1")) for name, value in headers]
    asyncio.run(Gate(app, entry)({"type": kind, "headers": pairs}, None, send))
    return sent[0].get("status", sent[0].get("code"))


HOSTS = [
    ("127.0.0.1", "localhost:8000", 200),
    ("127.0.0.1", "LOCALHOST", 200),
    ("127.0.0.1", "[::1]:8000", 200),
    ("127.0.0.1", "evil.example:8000", 421),
    ("127.0.0.1", "localhost.evil.example", 421),
    ("127.0.0.1", "user@evil.example", 421),
    ("127.0.0.1", "192.168.1.7", 421),
    ("127.0.0.1", "[bad", 421),
    ("127.0.0.1", "\xff", 421),
    ("127.0.0.1", "", 421),
    ("192.168.1.7", "192.168.1.7:8000", 200),
    ("0.0.0.0", "192.168.1.7:8000", 200),
    ("0.0.0.0", "evil.example", 421),
]


@pytest.mark.parametrize(("host", "name", "expected"), HOSTS)
def test_names(host, name, expected):
    assert status(Entrance(host), ("host", name)) == expected


def test_a_name_is_given_once():
    assert status(Entrance()) == 421
    assert status(Entrance(), ("host", "localhost"), ("Host", "localhost")) == 421


@pytest.mark.parametrize(
    ("origin", "expected"), [("http://localhost:3000", 200), ("https://evil.example", 403), ("null", 403)]
)
def test_pages_of_other_sites(origin, expected):
    assert status(Entrance(), ("host", "localhost"), ("origin", origin)) == expected


TOKENS = [
    ((BEARER,), 200),
    ((("authorization", f"bearer {TOKEN}"),), 200),
    ((), 401),
    ((("Authorization", "Bearer wrong"),), 401),
    ((("Authorization", f"Basic {TOKEN}"),), 401),
    ((("Authorization", TOKEN),), 401),
    ((BEARER, BEARER), 401),
]


@pytest.mark.parametrize(("headers", "expected"), TOKENS)
def test_the_token(headers, expected):
    assert status(Entrance("127.0.0.1", TOKEN), ("host", "localhost"), *headers) == expected


def test_sockets_stay_out():
    assert status(Entrance(), ("host", "localhost"), kind="websocket") == 1008


def test_other_machines_need_a_token(tmp_path):
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    assert entrance("0.0.0.0", file) == Entrance("0.0.0.0", TOKEN)
    assert entrance("localhost", None).token == ""
    for host in ("0.0.0.0", "::", "192.168.1.7", "robot.example"):
        with pytest.raises(UserError, match="--token-file"):
            entrance(host, None)


@pytest.mark.parametrize("content", [b"", b"short", b"x" * 600, b"two lines\nof a secret that is long", b"\xff" * 20])
def test_tokens_that_are_none(tmp_path, content):
    (tmp_path / "token").write_bytes(content)
    with pytest.raises(UserError, match="the token in"):
        entrance("127.0.0.1", tmp_path / "token")
    with pytest.raises(UserError, match="cannot read the token"):
        entrance("127.0.0.1", tmp_path / "none")
