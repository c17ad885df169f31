"""A scripted language model: fills in whatever form it is given; behind HTTP on loopback it misbehaves on demand."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

REGIONS = ("hall", "kitchen", "bedroom", "bathroom")
OBJECTS = {
    "hall": ("door", "coat rack"),
    "kitchen": ("stove", "sink"),
    "bedroom": ("bed", "lamp"),
    "bathroom": ("bath", "sink"),
}
SIZES_CM = {"door": (90, 10, 205, 0), "bed": (200, 150, 60, 0), "lamp": (30, 30, 50, 60)}  # all others: a cube of 60
KNOWN_SHARES = {"hall": 20, "kitchen": 30, "bedroom": 40, "bathroom": 10}


def fill(schema: dict, path: tuple[str, ...] = ()) -> object:
    """An answer of the form that a schema asks for; what it says follows from the names alone."""
    if schema["type"] == "object":
        return {name: fill(part, (*path, name)) for name, part in schema["properties"].items()}
    if path == ("regions",):
        return [{"name": name, "parent": "home", "share": KNOWN_SHARES[name]} for name in REGIONS]
    if schema["type"] == "array":
        region = path[0] if path else ""
        if path[-1] == "objects":
            return list(OBJECTS.get(region, ("table", "chair")))
        return [f"{region} seen from the door", f"a picture of {region}"]
    if schema["type"] == "string":
        return "home"
    return percent(path)


def percent(path: tuple[str, ...]) -> int:
    """A number for an entry: high where an object belongs to a region, else low."""
    fixed = {"inclination_deg": 0, "inclination_spread_deg": 5, "scale_cm": 80, "share": 25}
    sides = ("longest_cm", "shortest_cm", "height_cm", "bottom_cm")
    if path[-1] in sides:
        return SIZES_CM.get(path[0], (60, 60, 60, 0))[sides.index(path[-1])]
    if path[-1] in fixed:
        return fixed[path[-1]]
    return 90 if path[-1] in OBJECTS.get(path[0], ()) else 60 if "hall" in path else 5


def reply_to(schema: dict | None) -> str:
    return json.dumps(fill(schema)) if schema else "Let me think about this place."


def openai_body(text: str) -> dict:
    return {
        "choices": [{"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}],
        "usage": {"prompt_tokens": 100, "completion_tokens": 50},
    }


def schema_of(body: dict) -> dict | None:
    form = body.get("response_format")
    if form is not None:
        return form["json_schema"]["schema"] if form["type"] == "json_schema" else form["schema"]
    return body["tools"][0]["input_schema"] if body.get("tools") else None


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        model = self.server.model
        with model.lock:
            model.requests.append((self.path, {name.lower(): value for name, value in self.headers.items()}, body))
            act = model.script.pop(0) if model.script else model.default
        try:
            act(self, body)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def send(self, status: int, content: bytes, headers: dict | None = None) -> None:
        self.send_response(status)
        for name, value in (
            {"content-type": "application/json", "content-length": len(content)} | (headers or {})
        ).items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(content)

    def say(self, text: str) -> None:
        self.send(200, json.dumps(openai_body(text)).encode())

    def log_message(self, *arguments: object) -> None:
        pass


Act = Callable[[Handler, dict], None]


class FakeModel:
    """The server's script: one act per request, then the default."""

    def __init__(self, script: list[Act], default: Act) -> None:
        self.script, self.default, self.requests, self.lock = list(script), default, [], threading.Lock()
        self.url = ""

    @property
    def calls(self) -> int:
        return len(self.requests)


def good(handler: Handler, body: dict) -> None:
    handler.say(reply_to(schema_of(body)))


def saying(text: str) -> Act:
    return lambda handler, body: handler.say(text)


def slow(seconds: float) -> Act:
    def act(handler: Handler, body: dict) -> None:
        time.sleep(seconds)
        good(handler, body)

    return act


def status(code: int, text: str = "no", **headers: str) -> Act:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return lambda handler, body: handler.send(code, json.dumps({"error": {"message": text}}).encode(), named)


def huge(megabytes: int) -> Act:
    return lambda handler, body: handler.say("x" * (megabytes * 1_000_000))


def cut_body(handler: Handler, body: dict) -> None:
    """The connection ends within the answer."""
    content = json.dumps(openai_body(reply_to(schema_of(body)))).encode()
    handler.send_response(200)
    handler.send_header("content-length", str(len(content)))
    handler.end_headers()
    handler.wfile.write(content[: len(content) // 2])
    handler.wfile.flush()
    handler.connection.close()
    handler.close_connection = True


def drip(handler: Handler, body: dict) -> None:
    """Complete one day, but not soon."""
    content = json.dumps(openai_body("x" * 10_000)).encode()
    handler.send_response(200)
    handler.send_header("content-length", str(len(content)))
    handler.end_headers()
    for byte in content:
        handler.wfile.write(bytes((byte,)))
        handler.wfile.flush()
        time.sleep(0.02)


def changed(change: Callable[[dict], None]) -> Act:
    """A good answer with one change in its JSON."""

    def act(handler: Handler, body: dict) -> None:
        schema = schema_of(body)
        if schema is None:
            good(handler, body)
            return
        answer = fill(schema)
        change(answer)
        handler.say(json.dumps(answer))

    return act


@contextmanager
def serving(*script: Act, default: Act = good):
    """A fake endpoint on a free port of loopback."""
    model = FakeModel(list(script), default)
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.model = model
    model.url = f"http://127.0.0.1:{server.server_port}/v1"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield model
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
