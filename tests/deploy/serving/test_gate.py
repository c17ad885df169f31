"""Who may come in."""

import asyncio
import socket
import time

import httpx
import pytest

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.serving import gate, server
from prior_sg.deploy.serving.gate import Entrance, Gate, entrance
from tests.help.served import served

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
    ("127.0.0.1", "evil.example@localhost", 421),
    ("127.0.0.1", "localhost/evil.example", 421),
    ("127.0.0.1", "localhost:8000x", 421),
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


LOADS = [
    ("cross-site", "image", 403),
    ("cross-site", "iframe", 403),
    ("cross-site", "empty", 403),
    ("cross-site", "document", 200),
    ("same-origin", "empty", 200),
    ("none", "document", 200),
]


@pytest.mark.parametrize(("site", "use", "expected"), LOADS)
def test_what_pages_of_other_sites_load_without_naming_their_origin(site, use, expected):
    told = (("host", "localhost"), ("Sec-Fetch-Site", site), ("Sec-Fetch-Dest", use))
    assert status(Entrance(), *told) == expected


async def empty(scope, receive, send):
    if scope["type"] == "http":
        while (await receive()).get("more_body", False):
            pass
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})


def exchanged(address, sent):
    """All that comes back until the connection ends."""
    host, port = address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(sent)
        return b"".join(iter(lambda: connection.recv(65536), b""))


def test_a_request_within_another_is_not_taken():
    head = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n"
    with served(Gate(empty, Entrance())) as address:
        answers = exchanged(address, head + b"0\r\n\r\nGET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert answers.startswith(b"HTTP/1.1 400") and answers.count(b"HTTP/1.1") == 1


def test_a_body_that_does_not_arrive_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(gate, "BODY_S", 0.2)
    with served(Gate(empty, Entrance())) as address:
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=3) as connection:
            connection.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\nab")
            assert connection.recv(65536).startswith(b"HTTP/1.1")


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="Linux ends such connections")
def test_who_takes_nothing_is_given_up(monkeypatch):
    monkeypatch.setattr(server, "STUCK_MS", 500)
    ended = []

    async def endless(scope, receive, send):
        if scope["type"] == "http":
            await receive()
            gone = asyncio.ensure_future(receive())
            await send({"type": "http.response.start", "status": 200, "headers": []})
            while not gone.done():
                await send({"type": "http.response.body", "body": b"x" * 2**18, "more_body": True})
            ended.append(gone.result()["type"])

    with served(Gate(endless, Entrance())) as address:
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            end_s = time.monotonic() + 20
            while not ended and time.monotonic() < end_s:
                time.sleep(0.05)
            assert ended == ["http.disconnect"]


LARGE = bytes(range(256)) * 2**16


async def large(scope, receive, send):
    if scope["type"] == "http":
        length = (b"content-length", str(len(LARGE)).encode())
        await send({"type": "http.response.start", "status": 200, "headers": [length]})
        await send({"type": "http.response.body", "body": LARGE})


def test_a_large_answer_waits_in_pieces_for_who_takes_it_slowly(monkeypatch):
    sizes = []

    async def piece(message):
        sizes.append(len(message.get("body", b"")))

    asyncio.run(large({"type": "http"}, None, gate.in_pieces(piece)))
    assert max(sizes) == gate.PIECE_B and sum(sizes) == len(LARGE)
    with served(Gate(large, Entrance())) as address:
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            time.sleep(0.3)
            answer = b"".join(iter(lambda: connection.recv(2**20), b""))
    assert answer.partition(b"\r\n\r\n")[2] == LARGE


def test_the_end_of_a_server_waits_for_nobody_who_takes_nothing(monkeypatch, caplog):
    monkeypatch.setattr(server, "GRACE_S", 0.2)
    with served(Gate(large, Entrance())) as address:
        host, port = address.removeprefix("http://").split(":")
        connection = socket.create_connection((host, int(port)), timeout=10)
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        time.sleep(0.3)
    connection.close()
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


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


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "])
def test_who_asks_for_nothing_is_sent_away(sent, monkeypatch):
    monkeypatch.setattr(server, "LONGEST_IDLE_S", 0.3)
    monkeypatch.setattr(server, "IDLE_CHECK_S", 0.05)

    async def slow(scope, receive, send):
        await asyncio.sleep(0.6)  # who waits for an answer is not idle
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    with served(slow) as address:
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            connection.sendall(sent)
            assert connection.recv(100) == b""
        assert httpx.get(address).status_code == 204
