"""A real language model behind a real server (`make test-llm`): how well a prior is meant no test can say, only that it
is whole and the model's own."""

import os
import subprocess
import sys
import time

import httpx
import msgspec
import pytest

from prior_sg.deploy.benches import learning as bench
from prior_sg.deploy.cli.prior_file import read
from prior_sg.schemas.priors import ModelRequest, PriorEvidence, PriorRevision
from prior_sg.services.prior_gateway.core import learning
from prior_sg.services.prior_gateway.core.config import CallConfig, Config
from prior_sg.services.prior_gateway.core.turns import SynthesisConfig
from prior_sg.services.segmenter.core import prior_evidence
from tests.help.gateway import Gateway

URL = os.environ.get("PSG_TEST_LLM_URL", "")
START_S, MAKE_S = 120, 1500
HOMES, WORLD = 6, 0  # of `prior-sg bench learning`, whose robots find out that the prior is half wrong
# A small model with one thread: small calls, no thinking aloud, numbers from a list (its server enforces no bounds).
SMALL = '{"samples": 4, "reason": false, "regions_per_call": 1, "repairs": 1, "max_tokens": 700, "steps": 11}'

pytestmark = [pytest.mark.skipif(not URL, reason="no PSG_TEST_LLM_URL: see `make test-llm`"), pytest.mark.timeout(3600)]


def wait_for_server():
    end_s = time.monotonic() + START_S
    while True:
        try:
            return httpx.get(f"{URL}/models", timeout=5).raise_for_status()
        except (httpx.TransportError, httpx.HTTPStatusError):  # 503 while the model is being loaded
            assert time.monotonic() < end_s, f"no server at {URL}"
            time.sleep(0.5)


def test_a_small_model_makes_a_whole_prior(tmp_path):
    wait_for_server()
    regions = ["kitchen", "bedroom", "bathroom"]
    command = [
        *(sys.executable, "-m", "prior_sg.deploy.cli.main", "priors", "make", "--environment", "residential home"),
        *("--task", "serve drinks", "--regions", ",".join(regions)),
        *("--timeout", str(MAKE_S), "--out", str(tmp_path / "prior.json")),
    ]
    settings = (
        *(
            "provider=openai",
            f"endpoint={URL}",
            "model=small",
            "temperature=0.8",
            "structured=json_object",
            f"synthesis={SMALL}",
        ),
        *(f"archive={tmp_path / 'kept'}", 'calls={"timeout_s": 600, "deadline_s": 1200}'),
    )
    for setting in settings:
        command += ["--set", f"prior_gateway.{setting}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=MAKE_S + 60, check=False)
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    prior = read(tmp_path / "prior.json")
    assert prior.provenance.source == "small", prior.provenance.note
    assert [region.name for region in prior.regions] == regions
    assert prior.containment.shape == (3, len(prior.objects))


class Logged(Gateway):
    """A gateway that asks the real model, and prints what both say."""

    said: tuple[str, ...] = ()

    def do(self, errand, request):
        if not isinstance(request, ModelRequest):
            return super().do(errand, request)
        begun_s = time.monotonic()
        reply = super().do(errand, request)
        asked = request.messages[-1][1]
        spent = f"{reply.tokens_in} + {reply.tokens_out} tokens, {time.monotonic() - begun_s:.0f} s"
        print(f"\n=== {request.schema_name}, turn {request.turn} ===\n{asked}\n--- answer: {spent} ---")
        print(reply.text or f"{reply.failure}: {reply.reason}", flush=True)
        self.said += (reply.text,)
        return reply


def maps_of(world: bench.World) -> list[PriorEvidence]:
    """What each robot tells of the prior in hand after a home of its own."""
    found = []
    for number, home in enumerate(world.explored[:HOMES]):
        state = bench.explore(home)
        bench.label(state, home, world.prior)
        told = prior_evidence.evidence(state, bench.CFG)
        found.append(msgspec.structs.replace(told, robot=f"robot{number}"))
    return found


def test_a_small_model_weighs_what_robots_have_seen_against_a_prior_that_is_half_wrong():
    """It stays between expectation and observation, entry by entry; what that is worth is printed."""
    wait_for_server()
    world = bench.World(WORLD, bench.SIGHTS[""], bench.EXCHANGED_PAIRS)
    prior, maps = world.prior, maps_of(world)
    cfg = Config(
        archive="", provider="openai", endpoint=URL, model="small", temperature=0.2, structured="json_object",
        synthesis=SynthesisConfig(samples=1, reason=False, repairs=2, max_tokens=1500, steps=11),
        calls=CallConfig(timeout_s=900, deadline_s=1800),
    )  # fmt: skip
    gateway = Logged(cfg, {"preferred": prior})
    gateway.feed(*maps)
    asked = PriorRevision(environment=prior.environment, task=prior.task, regions=prior.vocabulary, by_model=True)
    published = gateway.feed(asked) + gateway.settle()
    assert published, gateway.state.refused
    revised = published[-1]
    revised.check()
    assert revised.provenance.source == "small" and revised.provenance.parent_digest == prior.digest()
    seen = learning.estimate(prior, maps, cfg.learning)
    said = msgspec.json.decode(gateway.said[-1])
    for span in learning.disagreements(prior, seen.totals, cfg.learning.told):
        low, high = sorted((100 * span.expected, 100 * span.observed))
        assert low - 1 < said[span.matrix][span.row][span.column] < high + 1
    counted = learning.revised(prior, seen.totals, cfg.learning.strength, prior.provenance)
    for name, one in {"in hand": prior, "revised by counting": counted, "revised by the model": revised}.items():
        errors = ", ".join(f"{key} {value:.4f}" for key, value in world.errors(one).items())
        print(f"{name}: F1_S {world.f1(one):.3f}, {errors}")
