"""No message that passes the boundary ends a service, however absurd: it is taken, or refused in one sentence."""

import contextlib
import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.status import Tick
from prior_sg.services.refusals import InputRefused, NotYet
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.service import Ask, Errand, Identity, Pause
from tests.help.absurd import absurd

EXAMPLES = 200
FEW = 50  # where each takes long
CONFIGS: dict[str, dict] = {
    "prior_gateway": {"archive": ""},
    "scene_store": {"path": ":memory:", "synchronous": "normal"},
    "segmenter": {},
    "ingest": {},
    "place_graph": {},
}


def travels(output):
    """What a service tells or asks has a key of its own and is let in where it arrives."""
    place, message = (output.query, output.request) if isinstance(output, Ask) else output
    decode(type(message), encode(message))
    if not isinstance(place, Errand):
        key = place.key_of(message)
        assert "//" not in key and not set(key) & set("*$#? ") and place.fault_of(key, message) == ""


@pytest.mark.parametrize("name", CONFIGS)
def test_absurd_messages_end_no_service(name):
    service = BY_NAME[name]
    kinds = [topic.type for topic in service.reads]
    kinds += [query.reply for query in (*service.asks, *service.errands)]
    cfg = service.config(**CONFIGS[name])
    examples = FEW if name == "prior_gateway" else EXAMPLES
    tried = {"taken": 0, "refused": 0}

    @settings(max_examples=examples, database=None, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(st.lists(st.one_of(*map(absurd, kinds)), min_size=1, max_size=6))
    def feed(messages):
        state = service.init(cfg, Identity("r" if service.scope == "robot" else "*", "i", 1))
        try:
            for message in messages:
                if message is None:
                    continue
                try:
                    for output in service.step(state, message, cfg):
                        if not isinstance(output, Pause):
                            travels(output)
                    tried["taken"] += 1
                except InputRefused as why:
                    assert str(why)
                    tried["refused"] += 1
                if service.tick_s is not None:
                    list(service.step(state, Tick(stamp_ns=1), cfg))
            for query, answer in service.answers.items():
                if query.request.__struct_fields__ == ("robot",):
                    with contextlib.suppress(NotYet):
                        answer(state, query.request(robot="r"), cfg)
        finally:
            service.close(state)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy, about overflows
        feed()
    assert tried["taken"] > examples / 4
