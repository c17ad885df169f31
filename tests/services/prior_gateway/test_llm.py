"""A real language model behind a real server (`make test-llm`): how well a prior is meant no test can say, only that it
is whole and the model's own."""

import os
import subprocess
import sys
import time

import httpx
import pytest

from prior_sg.deploy.cli.prior_file import read

URL = os.environ.get("PSG_TEST_LLM_URL", "")
START_S, MAKE_S = 120, 1500
# A small model with one thread: small calls, no thinking aloud, numbers from a list (its server enforces no bounds).
SMALL = '{"samples": 4, "reason": false, "regions_per_call": 1, "repairs": 1, "max_tokens": 700, "steps": 11}'

pytestmark = [pytest.mark.skipif(not URL, reason="no PSG_TEST_LLM_URL: see `make test-llm`"), pytest.mark.timeout(3600)]


def wait_for_server():
    end_s = time.monotonic() + START_S
    while True:
        try:
            return httpx.get(f"{URL}/models", timeout=5).raise_for_status()
        except httpx.TransportError:
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
