"""Calls of a model over HTTP against a scripted endpoint on loopback, and what the caller of a gateway sees."""

import asyncio
import json
import random
import re
from datetime import UTC, datetime

import msgspec
import pytest

from prior_sg.schemas.priors import ModelReply, ModelRequest, Prior, PriorRequest, Task
from prior_sg.services.prior_gateway import service
from prior_sg.services.prior_gateway.core.config import CallConfig, Config
from prior_sg.services.prior_gateway.core.turns import SynthesisConfig
from prior_sg.services.prior_gateway.outside.asking import open_endpoint
from prior_sg.services.prior_gateway.outside.endpoint import (
    Endpoint,
    is_here,
    is_near,
    read_key,
    retry_after_s,
)
from prior_sg.services.runtime.service import Identity, ServiceError
from tests.help.gateway import Gateway
from tests.help.model import changed, cut_body, drip, good, huge, saying, serving, slow, status

KEY = "sk-test-4711-not-a-real-key"
FAST = CallConfig(attempts=2, backoff_s=0.01, requests_per_minute=6e5, most_answer_bytes=1_000_000)
IMPATIENT = msgspec.structs.replace(FAST, timeout_s=0.5)  # with what never answers within that
SLOW = slow(2)
SCHEMA = {"type": "object", "properties": {"a": {"type": "string"}}, "required": ["a"], "additionalProperties": False}


def config(url="http://127.0.0.1:1/v1", calls=FAST, **changes) -> Config:
    fields = {"provider": "openai", "model": "fake", "endpoint": url, "archive": "", "calls": calls}
    return Config(**(fields | {"synthesis": SynthesisConfig(samples=1, reason=False, repairs=1)} | changes))


def request(schema=SCHEMA, turn=0) -> ModelRequest:
    text = json.dumps(schema) if schema else ""
    return ModelRequest(conversation="c", turn=turn, messages=[("system", "s"), ("user", "u")], schema=text)


def patience(act) -> CallConfig:
    return IMPATIENT if act in (SLOW, drip) else FAST


def ask(endpoint: Endpoint, times: int = 1) -> ModelReply:
    async def several() -> ModelReply:
        for turn in range(times):
            reply = await endpoint.ask(request(turn=turn))
        return reply

    return asyncio.run(several())


class Watch:
    """A clock that sleeping moves."""

    def __init__(self) -> None:
        self.now_s, self.slept = 0.0, []

    def now(self) -> float:
        return self.now_s

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_s += seconds


def watched(url: str, calls=FAST, key="", **changes) -> tuple[Endpoint, Watch]:
    watch = Watch()
    return Endpoint(config(url, calls, **changes), key, watch.now, watch.sleep, random.Random(1)), watch


# What is sent


def test_openai_gets_a_strict_schema_and_the_key_in_a_header():
    with serving() as model:
        reply = ask(Endpoint(config(model.url, temperature=0.3), KEY))
        path, headers, body = model.requests[0]
    assert (reply.failure, json.loads(reply.text)) == ("", {"a": "home"})
    assert (reply.tokens_in, reply.tokens_out, reply.attempts) == (100, 50, 1)
    assert path == "/v1/chat/completions"
    assert headers["authorization"] == f"Bearer {KEY}"
    form = body["response_format"]["json_schema"]
    assert (form["strict"], form["schema"]) == (True, SCHEMA)
    assert (body["model"], body["temperature"], body["max_tokens"]) == ("fake", 0.3, 4096)
    assert body["messages"] == [{"role": "system", "content": "s"}, {"role": "user", "content": "u"}]


@pytest.mark.parametrize(
    ("structured", "expected"), [("json_object", {"type": "json_object", "schema": SCHEMA}), ("none", None)]
)
def test_endpoints_that_know_less(structured, expected):
    with serving(default=saying("{}")) as model:
        ask(Endpoint(config(model.url, structured=structured), ""))
        _, headers, body = model.requests[0]
    assert body.get("response_format") == expected
    assert "authorization" not in headers


def test_anthropic_gets_a_forced_tool_and_answers_with_its_input():
    def tool(handler, body):
        answer = {
            "content": [{"type": "text", "text": "so"}, {"type": "tool_use", "name": "answer", "input": {"a": "x"}}],
            "usage": {"input_tokens": 7, "output_tokens": 3},
        }
        handler.send(200, json.dumps(answer).encode())

    def text(handler, body):
        handler.send(200, json.dumps({"content": [{"type": "text", "text": "thoughts"}]}).encode())

    with serving(tool, text) as model:
        endpoint = Endpoint(config(model.url.removesuffix("/v1"), provider="anthropic"), KEY)
        reply = ask(endpoint)
        plain = asyncio.run(endpoint.ask(request(schema=None)))
        path, headers, body = model.requests[0]
    assert (json.loads(reply.text), reply.tokens_in, reply.tokens_out) == ({"a": "x"}, 7, 3)
    assert plain.text == "thoughts"
    assert path == "/v1/messages"
    assert headers["x-api-key"] == KEY
    assert headers["anthropic-version"]
    assert (body["system"], body["messages"]) == ("s", [{"role": "user", "content": "u"}])
    assert body["tools"][0]["input_schema"] == SCHEMA
    assert body["tool_choice"] == {"type": "tool", "name": "answer"}
    assert "tools" not in model.requests[1][2]


# What can go wrong with one call


@pytest.mark.parametrize(
    ("act", "kind", "says", "calls"),
    [
        (SLOW, "timeout", "no complete answer within 0.5 s", 2),
        (drip, "timeout", "no complete answer within 0.5 s", 2),
        (status(500), "server", "answered 500: .*no", 2),
        (status(429), "busy", "answered 429", 2),
        (status(429, retry_after="3600"), "busy", "asks to wait 3600 s", 1),
        (status(401, f"bad key {KEY}"), "rejected", r"answered 401: .*bad key \*\*\*", 1),
        (status(302, location="http://192.0.2.1/"), "rejected", "answered 302", 1),
        (cut_body, "unreachable", "cannot be reached|cut off", 2),
        (lambda h, b: h.send(200, b'{"choices": ['), "garbled", "cut off or of another form", 2),
        (lambda h, b: h.send(200, b'{"choices": []}'), "garbled", "cut off or of another form", 2),
        (lambda h, b: h.send(200, b"[1]"), "garbled", "cut off or of another form", 2),
        (huge(10), "too large", "larger than 1 MB", 1),
    ],
)
def test_a_failing_call_says_what_and_why(act, kind, says, calls):
    with serving(default=act) as model:
        endpoint, _ = watched(model.url, patience(act), key=KEY)
        reply = ask(endpoint)
        assert (reply.failure, reply.text, model.calls) == (kind, "", calls)
    assert re.search(says, reply.reason), reply.reason
    assert KEY not in reply.reason


def test_nobody_there():
    endpoint, _ = watched("http://127.0.0.1:1/v1")
    assert ask(endpoint).reason == "127.0.0.1:1 cannot be reached (ConnectError)"


def test_a_passing_fault_costs_a_retry_with_growing_jittered_pauses():
    calls = CallConfig(attempts=5, backoff_s=1.0, requests_per_minute=6e5)
    with serving(status(500), status(503), status(529)) as model:
        endpoint, watch = watched(model.url, calls)
        reply = ask(endpoint)
    assert (reply.failure, reply.attempts) == ("", 4)
    pauses = [pause for pause in watch.slept if pause > 0.1]
    assert len(pauses) == 3
    assert all(0.5 * 2**n <= pause <= 2**n for n, pause in enumerate(pauses))


def test_retry_after_is_obeyed_in_both_forms():
    with serving(status(429, retry_after="7")) as model:
        endpoint, watch = watched(model.url)
        assert ask(endpoint).failure == ""
    assert max(watch.slept) == 7
    now = datetime(2030, 1, 1, 12, 0, 0, tzinfo=UTC)
    assert retry_after_s("Tue, 01 Jan 2030 12:00:30 GMT", now) == 30
    assert retry_after_s("Tue, 01 Jan 2030 11:00:00 GMT", now) == 0
    assert [retry_after_s(text, now) for text in ("", "soon", "-5", "1.5")] == [0, 0, 0, 1.5]


def test_requests_are_paced():
    with serving() as model:
        endpoint, watch = watched(model.url, CallConfig(requests_per_minute=30))
        ask(endpoint, times=3)
    assert sum(watch.slept) == pytest.approx(4, abs=0.5), "two seconds between requests"


def test_the_circuit_opens_and_closes():
    calls = CallConfig(attempts=1, breaker_failures=2, breaker_s=60, requests_per_minute=6e5)
    with serving(status(500), status(500)) as model:
        endpoint, watch = watched(model.url, calls)
        assert ask(endpoint, times=2).failure == "server"
        paused = ask(endpoint)
        assert (paused.failure, model.calls) == ("paused", 2)
        assert paused.reason == "the endpoint failed 2 times in a row and is left alone for another 60 s"
        watch.now_s += 61
        assert ask(endpoint).failure == ""
        assert ask(endpoint).failure == ""


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        ({"most_calls": 2}, "all 2 calls"),
        ({"most_usd": 0.0002, "usd_per_million_in": 1.0, "usd_per_million_out": 1.0}, "budget of 0.0002 USD"),
    ],
)
def test_budgets_end_calls(limits, says):
    with serving() as model:
        endpoint, _ = watched(model.url, CallConfig(requests_per_minute=6e5, **limits))
        assert ask(endpoint, times=2).failure == ""
        over = ask(endpoint)
        assert (over.failure, model.calls) == ("budget", 2)
    assert says in over.reason


def test_an_answer_that_holds_the_key_is_cleaned():
    with serving(saying(f"your key is {KEY}")) as model:
        assert ask(Endpoint(config(model.url), KEY)).text == "your key is ***"


# Keys


def test_keys_come_from_a_named_variable_or_a_file(monkeypatch, tmp_path):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    assert read_key(Config(provider="openai", model="m")) == KEY
    assert read_key(config()) == "", "the provider's key goes to no other endpoint"
    assert read_key(config(key_env="OPENAI_API_KEY")) == KEY
    (tmp_path / "key").write_text(f"{KEY}\n")
    assert read_key(config(key_file=str(tmp_path / "key"))) == KEY


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"key_env": "NO_SUCH_VARIABLE"}, "NO_SUCH_VARIABLE holds no key"),
        ({"key_file": "/no/such/file"}, "cannot be read"),
        ({"key_env": "TWO_WORDS"}, "no key: it must be one word"),
        ({"key_env": "A_KEY", "url": "http://192.0.2.1/v1"}, "over https only"),
    ],
)
def test_unusable_keys_end_the_start_with_one_sentence(monkeypatch, fields, says):
    monkeypatch.setenv("TWO_WORDS", "two words")
    monkeypatch.setenv("A_KEY", KEY)
    with pytest.raises(ServiceError, match=says) as raised:
        open_endpoint(config(**fields), Identity("*", "g", 1))
    assert KEY not in str(raised.value)
    assert "two words" not in str(raised.value)


@pytest.mark.parametrize(
    "fields",
    [{"key_env": KEY}, {"endpoint": f"https://user:{KEY}@host/v1"}, {"endpoint": f"https://host/v1?key={KEY}"}],
)
def test_a_key_in_a_setting_is_refused_without_repeating_it(fields):
    with pytest.raises(ValueError, match="key") as raised:
        Config(provider="openai", model="m", **fields)
    assert KEY not in str(raised.value)


# The service with a model


def home(name="clean", robot="r1", regions=()) -> Task:
    return Task(robot=robot, stamp_ns=1, environment="residential home", task=name, regions=list(regions))


def made(act, script=(), **changes) -> Prior:
    """The prior of a gateway whose model behaves like this."""
    with serving(*script, default=act) as model:
        gateway = Gateway(config(model.url, **changes))
        priors = gateway.feed(home()) + gateway.settle()
    assert len(priors) == 1
    return priors[0]


def test_a_model_makes_a_prior():
    prior = made(good)
    prior.check()
    assert [region.name for region in prior.regions] == ["hall", "kitchen", "bedroom", "bathroom"]
    origin = prior.provenance
    assert (origin.source, origin.samples, origin.made_by) == ("fake", 1, "g1")
    assert origin.question
    assert origin.prompts.startswith("v2-")
    assert prior.answers(home())


def with_a_moon(answer):
    if "stove" in answer.get("hall", {}):  # the containment matrix
        answer["moon"] = answer["hall"]


SEEN = {
    "time-out": (SLOW, "no complete answer within 0.5 s"),
    "429 with Retry-After 3600": (status(429, retry_after="3600"), "asks to wait 3600 s"),
    "500": (status(500), "answered 500"),
    "cut-off JSON": (saying('{"regions": [{"name": "ki'), "not valid JSON|cut off"),
    "wrong schema": (saying('{"rooms": ["kitchen"]}'), "form asked for"),
    "unknown region in a matrix": (changed(with_a_moon), "no region 'moon'"),
    "NaN": (saying('{"regions": [{"name": "a", "parent": "", "share": NaN}]}'), "not valid JSON"),
    "10 MB answer": (huge(10), "larger than 1 MB"),
    "refusal": (saying("I'm sorry, but I can't help with that."), "no JSON object in it, but: \"I'm sorry"),
    "slow stream": (drip, "no complete answer within 0.5 s"),
}


@pytest.mark.parametrize("case", SEEN)
def test_whatever_fails_the_caller_gets_the_librarys_prior_and_is_told(case):
    act, says = SEEN[case]
    prior = made(act, calls=patience(act))
    prior.check()
    assert prior.provenance.source == "library"
    assert prior.provenance.question == "", "it is nobody's answer to the question"
    note = prior.provenance.note
    assert note.startswith("fake gave no prior (")
    assert re.search(says, note), note


@pytest.mark.parametrize(
    "script", [[status(500)], [status(429, retry_after="0")], [saying("I'm sorry")], [saying('{"regions": [{"na')]]
)
def test_a_passing_fault_is_not_seen(script):
    assert made(good, script).provenance.source == "fake"


def test_some_samples_may_fail():
    bad = saying("no")
    prior = made(good, [bad], synthesis=SynthesisConfig(samples=2, reason=False, repairs=0))
    assert prior.provenance.samples == 1
    assert "1 more failed (its answer about regions" in prior.provenance.note


def test_the_newest_kept_prior_comes_before_the_library():
    kept = made(good)
    with serving(default=status(500)) as model:
        gateway = Gateway(config(model.url), {"newest": kept})
        [prior] = gateway.feed(home()) + gateway.settle()
    assert prior.provenance.source == "fake"
    assert "this is the newest one kept, of fake" in prior.provenance.note
    assert prior.provenance.question == ""


def test_the_same_question_is_answered_from_the_archive_without_a_call():
    kept = made(good)
    with serving() as model:
        gateway = Gateway(config(model.url), {"exact": kept})
        assert gateway.feed(home()) == [kept]
        assert gateway.feed(home(robot="r2")) == [kept]
        assert model.calls == 0


def test_after_a_failure_the_next_task_tries_again():
    with serving(default=status(500)) as model:
        gateway = Gateway(config(model.url))
        [first] = gateway.feed(home()) + gateway.settle()
        model.default = good
        again = gateway.feed(home()) + gateway.settle()
    assert first.provenance.source == "library"
    assert again[-1].provenance.source == "fake"


def test_without_model_and_library_there_is_a_reason():

    reef = Task(robot="r", stamp_ns=1, environment="coral reef", task="dive")
    with serving(default=status(500)) as model:
        gateway = Gateway(config(model.url))
        pending = service.answer(gateway.state, PriorRequest(environment="coral reef", task="dive"), gateway.cfg)
        assert gateway.feed(reef) + gateway.settle() == []
    told = service.answer(gateway.state, PriorRequest(environment="coral reef", task="dive"), gateway.cfg)
    assert (pending.pending, told.pending, told.priors) == (True, False, [])
    assert told.reason.startswith("fake gave no prior (the server answered 500")
    assert "no environment like 'coral reef'" in told.reason


# What servers make of an answer, and who is sent the key


def sending(answer: object) -> object:
    content = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
    return lambda handler, body: handler.send(200, content)


def message(finish: str = "stop", **fields: object) -> dict:
    return {"choices": [{"message": {"role": "assistant"} | fields, "finish_reason": finish}]}


CALL = {"function": {"name": "answer", "arguments": '{"a": 1}'}}
PIECES = [{"choices": [{"delta": {"content": text}}]} for text in ('{"a"', ": 1}")]
STREAM = b"".join(b"data: " + json.dumps(piece).encode() + b"\n\n" for piece in PIECES) + b"data: [DONE]\n\n"


@pytest.mark.parametrize(
    "answer",
    [
        message(content='{"a": 1}'),
        message(content='{"a": 1}', reasoning_content="hm {x}"),
        message(content=[{"type": "thinking", "thinking": "hm"}, {"type": "text", "text": '{"a": 1}'}]),
        message(content=[{"type": "text", "text": '{"a"'}, {"type": "text", "text": ": 1}"}]),
        message(content={"a": 1}),
        message(content=None, tool_calls=[CALL]),
        message(content=None, reasoning_content='{"a": 1}'),
        {"choices": [{"text": '{"a": 1}'}], "usage": {"prompt_tokens": "many", "completion_tokens": -1}},
        STREAM,
        b": ping\n\n" + STREAM,
        b"\xef\xbb\xbf" + json.dumps(message(content='{"a": 1}')).encode(),
    ],
)
def test_an_answer_in_any_of_the_usual_forms_is_understood(answer):
    with serving(default=sending(answer)) as model:
        reply = ask(Endpoint(config(model.url), ""))
    assert reply.failure == "" and json.loads(reply.text) == {"a": 1}


@pytest.mark.parametrize(
    ("answer", "kind", "says"),
    [
        (message("length", content=None, reasoning_content="long " * 50), "length", "raise .*synthesis.max_tokens"),
        ({"error": {"message": "model 'x' not found"}}, "server", "answered with an error: model 'x' not found"),
        ({"error": f"bad \x1b[31mkey {KEY}"}, "server", r"bad \?\[31mkey \*\*\*"),
        ({"error": {"code": 429}, "choices": []}, "server", '{"code":429}'),
        (b'data: {"error": {"message": "overloaded"}}\n\n', "server", "overloaded"),
        (b"data: [DONE]\n\n", "garbled", "streams its answer"),
        (b"[" * 100_000, "garbled", "of another form"),
        (b'{"choices": [{"message": "text"}]}', "garbled", "of another form"),
        (b'"\\ud83d"', "garbled", "of another form"),
        (b"\xff\xfe", "garbled", "of another form"),
        (b"", "garbled", "of another form"),
    ],
)
def test_what_is_no_answer_is_a_sentence_that_quotes_the_server(answer, kind, says):
    with serving(default=sending(answer)) as model:
        reply = ask(Endpoint(config(model.url), KEY))
    assert (reply.failure, reply.text) == (kind, "")
    assert re.search(says, reply.reason) and KEY not in reply.reason and reply.reason.isprintable()


def test_an_answer_that_is_not_what_its_header_says_ends_nothing():
    def not_gzip(handler, body):
        handler.send(200, b"plain", {"content-encoding": "gzip"})

    with serving(default=not_gzip) as model:
        assert ask(Endpoint(config(model.url), KEY)).failure == "unreachable"


def test_no_proxy_is_asked_for_this_machine(monkeypatch):
    with serving() as proxy, serving() as model:
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
            monkeypatch.setenv(name, proxy.url.removesuffix("/v1"))
        for name in ("NO_PROXY", "no_proxy"):
            monkeypatch.delenv(name, raising=False)
        reply = ask(Endpoint(config(model.url), KEY))
        assert (reply.failure, proxy.calls, model.calls) == ("", 0, 1)


@pytest.mark.parametrize(
    ("host", "here", "near"),
    [
        ("localhost", True, True),
        ("a.localhost", True, True),
        ("127.0.0.1", True, True),
        ("127.8.9.1", True, True),
        ("::1", True, True),
        ("192.168.1.7", False, True),
        ("10.0.0.1", False, True),
        ("fe80::1%eth0", False, True),
        ("gpu", False, True),
        ("gpu.local", False, True),
        ("8.8.8.8", False, False),
        ("api.openai.com", False, False),
        ("localhost.example.com", False, False),
        ("127.0.0.1.example.com", False, False),
    ],
)
def test_hosts_here_and_near(host, here, near):
    assert (is_here(host), is_near(host)) == (here, near)


def test_a_proxy_that_cannot_be_used_is_a_sentence(monkeypatch):
    monkeypatch.setenv("HTTPS_PROXY", "gopher://x")
    reply = ask(Endpoint(config("https://model.example.invalid/v1"), KEY))
    assert reply.failure == "unreachable" and "cannot be reached" in reply.reason


def test_a_redirect_is_followed_at_home_only():
    def away(handler, body):
        handler.send(307, b"", {"location": f"{elsewhere.url}/chat/completions"})

    def at_home(handler, body):
        handler.send(308, b"", {"location": "/v2/chat/completions"})

    with serving() as elsewhere, serving(at_home, good, default=away) as model:
        endpoint = Endpoint(config(model.url), KEY)
        assert ask(endpoint).failure == ""
        path, headers, _ = model.requests[-1]
        assert (path, headers["authorization"]) == ("/v2/chat/completions", f"Bearer {KEY}")
        reply = ask(endpoint)
        assert reply.failure == "rejected" and elsewhere.calls == 0
        assert "answered 307 and sends to" in reply.reason and "set prior_gateway.endpoint" in reply.reason


def test_a_redirect_in_a_circle_ends():
    with serving(default=lambda handler, body: handler.send(307, b"", {"location": "/v1/chat/completions"})) as model:
        assert ask(Endpoint(config(model.url), KEY)).failure == "rejected"
        assert model.calls == 4
