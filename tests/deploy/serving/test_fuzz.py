"""Generated requests: whatever is sent, the server answers, and never with a fault of its own.

PSG_FUZZ_EXAMPLES says how many for each operation.
"""

import os

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode

from prior_sg.deploy.serving.gate import Entrance
from tests.deploy.serving.test_http import opened

EXAMPLES = int(os.environ.get("PSG_FUZZ_EXAMPLES", "2"))
OPERATIONS = 26  # all but the stream, which has no end


@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_request_is_a_fault_of_the_server(mode):
    asked = []
    with opened(Entrance("testserver")) as (_, app, _):
        described = schemathesis.openapi.from_asgi("/openapi/openapi.json", app).exclude(path_regex="/events$")
        for found in described.get_all_operations():
            operation = found.ok()

            @settings(
                max_examples=EXAMPLES,
                deadline=None,
                suppress_health_check=list(HealthCheck),
                phases=[Phase.generate],
                database=None,
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def check(case):
                case.call_and_validate(checks=[not_a_server_error])

            if mode is GenerationMode.POSITIVE or operation.path_parameters or operation.query:
                check()
            asked.append(operation.label)
    assert len(asked) == OPERATIONS, asked
