"""How kinds of endpoints are spoken to: a request as JSON, and the text of whatever comes back.

Servers answer in many forms: text, a list of parts, a tool's input, thoughts in a field of their own, an event stream
that nobody asked for, an error under status 200. Each is read, or is one sentence.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from prior_sg.schemas.names import shown
from prior_sg.schemas.priors import ModelRequest
from prior_sg.services.prior_gateway.core.config import DEFAULT_ENDPOINTS, Config
from prior_sg.services.prior_gateway.core.turns import RAISE

VERSION_HEADER = {"anthropic-version": "2023-06-01"}
EXCERPT = 200  # characters of a server's error that are told
RETRIED = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 529})
GARBLED = "the server's answer is cut off or of another form"


class Failed(Exception):
    """One attempt failed; `wait_s` is what the server asks for."""

    def __init__(self, kind: str, reason: str, again: bool, wait_s: float = 0.0) -> None:
        super().__init__(reason)
        self.kind, self.again, self.wait_s = kind, again, wait_s


@dataclass(frozen=True)
class Said:
    """What a server's answer holds."""

    text: str
    tokens_in: int = 0
    tokens_out: int = 0
    cut_off: bool = False  # the server stopped at the limit of tokens


class Dialect(Protocol):
    """How one kind of endpoint is spoken to."""

    path: str

    def headers(self, key: str) -> dict[str, str]:
        """Headers with the key, if there is one."""

    def body(self, request: ModelRequest) -> dict[str, Any]:
        """The request as JSON."""

    def said(self, answer: Any) -> Said:
        """The text of an answer. Raises KeyError, IndexError or TypeError when it has another form."""


@dataclass(frozen=True)
class OpenAi:
    """Chat completions as OpenAI, vLLM, Ollama, llama.cpp and many others serve them."""

    cfg: Config
    path: str = "/chat/completions"

    def headers(self, key: str) -> dict[str, str]:
        return {"authorization": f"Bearer {key}"} if key else {}

    def body(self, request: ModelRequest) -> dict[str, Any]:
        limit = "max_completion_tokens" if self.cfg.base_url == DEFAULT_ENDPOINTS["openai"] else "max_tokens"
        body: dict[str, Any] = {
            "model": self.cfg.model,
            "messages": [{"role": role, "content": text} for role, text in request.messages],
            limit: request.max_tokens,
        }
        if self.cfg.temperature is not None:
            body["temperature"] = self.cfg.temperature
        if request.schema and self.cfg.structured != "none":
            schema = msgspec.json.decode(request.schema)
            named = {"name": request.schema_name, "strict": True, "schema": schema}
            body["response_format"] = (
                {"type": "json_schema", "json_schema": named}
                if self.cfg.structured == "json_schema"
                else {"type": "json_object", "schema": schema}
            )
        return body

    def said(self, answer: Any) -> Said:
        """Thoughts in a field of their own are an answer only where there is no other and none was cut off."""
        choice = answer["choices"][0]
        message = choice.get("message") or choice.get("delta") or {"content": choice["text"]}
        cut_off = choice.get("finish_reason") == "length"
        text = _text(message.get("content")) or _text(message.get("refusal")) or _arguments(message)
        if not text and not cut_off:
            text = _text(message.get("reasoning_content")) or _text(message.get("reasoning"))
        usage = answer.get("usage")
        return Said(text, _count(usage, "prompt_tokens"), _count(usage, "completion_tokens"), cut_off)


@dataclass(frozen=True)
class Anthropic:
    """The Messages API."""

    cfg: Config
    path: str = "/v1/messages"

    def headers(self, key: str) -> dict[str, str]:
        return VERSION_HEADER | ({"x-api-key": key} if key else {})

    def body(self, request: ModelRequest) -> dict[str, Any]:
        body: dict[str, Any] = {
            "model": self.cfg.model,
            "max_tokens": request.max_tokens,
            "system": "\n\n".join(text for role, text in request.messages if role == "system"),
            "messages": [{"role": role, "content": text} for role, text in request.messages if role != "system"],
        }
        if self.cfg.temperature is not None:
            body["temperature"] = self.cfg.temperature
        if request.schema and self.cfg.structured != "none":
            schema = msgspec.json.decode(request.schema)
            body["tools"] = [{"name": request.schema_name, "description": "Give the answer.", "input_schema": schema}]
            body["tool_choice"] = {"type": "tool", "name": request.schema_name}
        return body

    def said(self, answer: Any) -> Said:
        blocks, usage = answer["content"], answer.get("usage")
        tools = [msgspec.json.encode(block["input"]).decode() for block in blocks if block["type"] == "tool_use"]
        text = tools[0] if tools else "\n".join(block["text"] for block in blocks if block["type"] == "text")
        cut_off = answer.get("stop_reason") == "max_tokens"
        return Said(text, _count(usage, "input_tokens"), _count(usage, "output_tokens"), cut_off)


DIALECTS: dict[str, type] = {"openai": OpenAi, "anthropic": Anthropic}


def read_said(dialect: Dialect, content: bytes, most_tokens: int) -> Said:
    """What an answer under status 200 says. Raises Failed, with the server's own words where it tells of an error."""
    try:
        answer = _joined(content) if content.lstrip().startswith((b"data:", b"event:", b":")) else _decoded(content)
        if (error := _error_in(answer)) is not None:
            raise error
        said = dialect.said(answer)
    except (msgspec.MsgspecError, LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise Failed("garbled", GARBLED, again=True) from error
    if said.cut_off and not said.text.strip():
        reason = f"all {most_tokens} tokens were spent before any answer: {RAISE}, or let the model think less"
        raise Failed("length", reason, again=False)
    return said


def excerpt(text: str) -> str:
    """The beginning of a server's words, on one line, fit for a terminal."""
    return shown(" ".join(text.split()))[:EXCERPT]


def _decoded(content: bytes) -> Any:
    return msgspec.json.decode(content.removeprefix(b"\xef\xbb\xbf"))


def _joined(stream: bytes) -> Any:
    """An event stream as the one answer that it spells."""
    lines = (line.removeprefix(b"data:").strip() for line in stream.splitlines() if line.startswith(b"data:"))
    events = [_decoded(line) for line in lines if line and line != b"[DONE]"]
    if any(_error_in(event) is not None for event in events):
        return next(event for event in events if _error_in(event) is not None)
    choices = [event["choices"][0] for event in events if event.get("choices")]
    if not choices:
        raise Failed("garbled", "the server streams its answer in a form that is not understood", again=False)
    parts = [choice.get("delta") or choice.get("message") or {} for choice in choices]
    message = {
        name: "".join(_text(part.get(name)) for part in parts) for name in ("content", "reasoning_content", "refusal")
    }
    finish = [choice["finish_reason"] for choice in choices if choice.get("finish_reason")]
    usage = [event["usage"] for event in events if event.get("usage")]
    return {
        "choices": [{"message": message, "finish_reason": finish[-1] if finish else "stop"}],
        "usage": usage[-1] if usage else {},
    }


def _error_in(answer: Any) -> Failed | None:
    """What a server that says 200 and means something else has to say."""
    error = answer.get("error") if isinstance(answer, dict) else None
    if not error:
        return None
    said, code = error, None
    if isinstance(error, dict):
        said, code = error.get("message") or error, error.get("code")
    told = excerpt(said if isinstance(said, str) else msgspec.json.encode(said).decode())
    return Failed("server", f"the server answered with an error: {told}", again=code in RETRIED)


def _text(content: Any) -> str:
    """Text that comes as such, as parts, or as the JSON it would spell."""
    if isinstance(content, str):
        return content
    if isinstance(content, list):
        return "".join(map(_part, content))
    return msgspec.json.encode(content).decode() if isinstance(content, dict) else ""


def _part(part: Any) -> str:
    if not isinstance(part, dict):
        return _text(part)
    if part.get("type") in ("thinking", "reasoning"):
        return ""
    return _text(part.get("text"))


def _arguments(message: dict[str, Any]) -> str:
    """The input of the first tool that a message calls."""
    calls: Iterable[Any] = message.get("tool_calls") or ()
    return next((_text(call["function"]["arguments"]) for call in calls), "")


def _count(usage: Any, name: str) -> int:
    count = usage.get(name) if isinstance(usage, dict) else 0
    return count if isinstance(count, int) and 0 <= count < 2**53 else 0
