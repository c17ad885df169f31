"""Commands and the process that `up --api` starts."""

import signal
import socket
import time

import httpx
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.running.supervisor import Supervisor


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_interface_is_supervised(endpoint, tmp_path):
    supervisor, port = Supervisor(endpoint, "ada", tmp_path), free_port()
    supervisor.start_door("api", "prior_sg.deploy.serving.process", ["--host", "127.0.0.1", "--port", str(port)])
    try:
        (child,) = supervisor.children
        address, end_s = f"http://127.0.0.1:{port}", time.monotonic() + 30
        while "HTTP on" not in child.log_path.read_text():
            assert time.monotonic() < end_s and supervisor.check() == [], child.last_words()
            time.sleep(0.1)
        assert httpx.get(f"{address}/v1/robots", timeout=20).json() == ["ada"]
        assert httpx.get(f"{address}/v1/ada/scene", timeout=20).status_code == 503  # only a router is there
        child.process.send_signal(signal.SIGTERM)
        assert child.process.wait(10) == 0
    finally:
        supervisor.stop()


@pytest.mark.parametrize("command", [["serve-api"], ["mcp", "--http"]])
def test_what_cannot_be_served_is_told(command, endpoint, tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        cases = [
            (["--host", "0.0.0.0"], "--token-file"),
            (["--port", str(taken.getsockname()[1])], "give another --port"),
            (["--host", "203.0.113.7", "--token-file", str(tmp_path / "token")], "cannot listen on 203.0.113.7"),
        ]
        (tmp_path / "token").write_text("a-long-secret-of-ours")
        for options, said in cases:
            assert main([*command, "--connect", endpoint, *options]) == (2 if said == "--token-file" else 1)
            assert said in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*command, "--port", "65536"])
    assert "is no port" in capsys.readouterr().err


def test_a_token_needs_http(tmp_path, capsys):
    assert main(["mcp", "--token-file", str(tmp_path)]) == 2
    assert "add --http" in capsys.readouterr().err
