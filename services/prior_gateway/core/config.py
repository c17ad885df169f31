"""Settings of the gateway: who is asked for priors, how patiently, and what becomes of them (pure)."""

import re
from typing import Literal
from urllib.parse import urlsplit

import msgspec

from prior_sg.services.prior_gateway.core.learning import LearningConfig
from prior_sg.services.prior_gateway.core.turns import SynthesisConfig

DEFAULT_ENDPOINTS = {"openai": "https://api.openai.com/v1", "anthropic": "https://api.anthropic.com"}
DEFAULT_KEYS = {"openai": "OPENAI_API_KEY", "anthropic": "ANTHROPIC_API_KEY"}


class CallConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How patient and how thrifty the calls of a model are."""

    timeout_s: float = 180.0  # of one attempt, from the first byte sent to the last received
    connect_s: float = 10.0
    deadline_s: float = 600.0  # no further attempt after this
    attempts: int = 4
    backoff_s: float = 1.0  # before the second attempt; doubles with each, with jitter
    most_backoff_s: float = 60.0  # a server that asks for more gets no further attempt
    requests_per_minute: float = 60.0
    most_calls: int = 500  # of this process; 0 = no limit
    most_usd: float = 0.0  # of this process; 0 = no limit. Needs the two prices
    usd_per_million_in: float = 0.0
    usd_per_million_out: float = 0.0
    breaker_failures: int = 3  # calls given up in a row after which the endpoint is left alone
    breaker_s: float = 60.0  # for so long
    most_answer_bytes: int = 2_000_000

    def __post_init__(self) -> None:
        if min(self.timeout_s, self.connect_s, self.deadline_s, self.requests_per_minute, self.attempts) <= 0:
            raise ValueError("timeout_s, connect_s, deadline_s, requests_per_minute and attempts must be above 0")
        if self.most_usd and not (self.usd_per_million_in and self.usd_per_million_out):
            raise ValueError("most_usd needs usd_per_million_in and usd_per_million_out")


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Who is asked for priors, and how they are composed and kept. Never holds a key."""

    provider: Literal["library", "openai", "anthropic"] = "library"  # openai: any OpenAI-compatible chat endpoint
    endpoint: str = ""  # base URL, such as http://127.0.0.1:8000/v1; default: the provider's own
    model: str = ""
    key_env: str = ""  # name of the variable that holds the key; default only for the provider's own endpoint
    key_file: str = ""  # or the file
    structured: Literal["json_schema", "json_object", "none"] = "json_schema"  # how the endpoint constrains answers
    temperature: float | None = None  # default: the endpoint's
    prompts: str = "v2"  # version, or a folder of one's own
    synthesis: SynthesisConfig = msgspec.field(default_factory=SynthesisConfig)
    calls: CallConfig = msgspec.field(default_factory=CallConfig)
    archive: str = "~/.cache/prior-sg/priors"  # kept priors and evidence; empty = none
    signing_key: str = ""  # PEM file (Ed25519) for priors in files; what is published is signed where keys are in force
    trusted_keys: str = ""  # folder of NAME.pub
    require_signature: bool = (
        False  # adopt no prior from elsewhere without a good signature; so wherever keys are in force
    )
    lease_s: float = 5.0  # a gateway that has been silent for so long does not hold up the others
    learning: LearningConfig = msgspec.field(default_factory=LearningConfig)

    # P(o | r) of an object that a region's entry does not list.
    unlisted_containment: float = 0.02
    # P(ri <-> rj) of two regions of one environment whose entries say nothing about each other.
    unlisted_adjacency: float = 0.08
    # P(ri <-> rj) where nothing is known: a region known by name alone, or two of different environments.
    unknown_adjacency: float = 0.3
    # Weight of the uniform distribution in P(r | E0) where the task fixes the regions.
    named_existence_uniform: float = 0.5
    # r_Q of every region in metres; 0 takes the library's (0.75; the paper takes 1.5 in simulations without texture).
    query_radius_m: float = 0.0
    # Phrases of a name; {} is the name with its article. Encoders add what their space asks for ("A picture of ...").
    templates: list[str] = msgspec.field(default_factory=lambda: ["{}"])
    # Priors remembered for questions by digest; the oldest is forgotten first.
    remembered_priors: int = 256

    def __post_init__(self) -> None:
        if self.provider != "library" and not self.model:
            raise ValueError(f"model must name the model that {self.provider} is to use")
        if self.key_env and not re.fullmatch(r"[A-Z][A-Z0-9_]*", self.key_env):
            raise ValueError("key_env takes the name of an environment variable in capitals, never a key itself")
        parts = urlsplit(self.endpoint)
        if self.endpoint and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise ValueError("endpoint takes a URL such as http://127.0.0.1:8000/v1")
        if parts.username or parts.password or parts.query:
            raise ValueError("endpoint takes a bare URL; give a key with key_env or key_file")
        if self.lease_s < 1:
            raise ValueError("lease_s must be at least 1")

    @property
    def base_url(self) -> str:
        """Where the model is asked."""
        return self.endpoint or DEFAULT_ENDPOINTS.get(self.provider, "")

    @property
    def key_variable(self) -> str:
        """Which variable holds the key; empty = none is sent."""
        return self.key_env or ("" if self.endpoint else DEFAULT_KEYS.get(self.provider, ""))

    @property
    def maker(self) -> str:
        """Who answers, for the provenance."""
        return self.model if self.provider != "library" else "library"
