"""Tasks, priors and questions that nobody means: refused in one sentence, and the gateway goes on."""

import asyncio

import msgspec
import pytest

from prior_sg.schemas.priors import Keep, PriorRequest, PriorRevision, Task
from prior_sg.services.prior_gateway import service
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.archive import PREFERRED, PriorShelf, file_name, open_keep
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime.service import Identity
from tests.help.examples import PRIOR
from tests.help.gateway import Gateway

LIBRARY = Config(archive="")
ASKED = {
    "too many regions": {"regions": [f"room {n}" for n in range(65)]},
    "too long a region": {"regions": ["x" * 81]},
    "no name": {"regions": ["hall", ""]},
    "the same twice": {"regions": ["Kitchen", "kitchen"]},
    "two Unicode forms": {"regions": ["café", "cafe\u0301"]},
    "an escape": {"regions": ["a\x1b[31m"]},
    "a huge task": {"task": "x" * 1_000_000},
    "a NUL": {"environment": "home\x00"},
}


@pytest.mark.parametrize("case", ASKED)
def test_a_task_that_cannot_be_answered_is_refused_with_its_reason(case):
    gateway, fields = Gateway(LIBRARY), {"environment": "home", "task": "tidy"} | ASKED[case]
    for message in (Task(robot="r", stamp_ns=1, **fields), PriorRevision(**fields)):
        with pytest.raises(InputRefused) as refused:
            gateway.feed(message)
        assert str(refused.value).isprintable() and len(str(refused.value)) < 200
    reply = service.answer(gateway.state, PriorRequest(**fields), LIBRARY)
    assert (reply.priors, reply.pending) == ([], False)
    assert str(refused.value) in reply.reason
    assert gateway.feed(Task(robot="r", stamp_ns=2, environment="home", task="tidy")), "it goes on"


@pytest.mark.parametrize(
    "regions", [["tv corner [/den]", "lounge [east]"], ["{0}", "%s", "$task"], ["'; DROP --", "<b>"]]
)
def test_names_are_names_whatever_they_look_like(regions):
    prior = Gateway(LIBRARY).feed(
        Task(robot="r", stamp_ns=1, environment="home", task="sort [/x] bins", regions=regions)
    )
    assert [region.name for region in prior[0].regions] == regions


@pytest.mark.parametrize(
    "question",
    ["../x", "/etc/x", PREFERRED, "", "a\x00b", "x" * 5000, "*", "\ud800".encode("utf-8", "replace").decode()],
)
def test_no_question_is_a_path(question, tmp_path):
    assert file_name(question).isalnum() and len(file_name(question)) == 32
    archive = tmp_path / "archive"
    keep = open_keep(Config(archive=str(archive)), Identity("*", "g1", 1))
    made = msgspec.structs.replace(PRIOR.provenance, question=question)
    asyncio.run(keep(Keep(prior=msgspec.structs.replace(PRIOR, provenance=made), question=question)))
    kept = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(kept) == 1 and kept[0].parent.parent == archive and kept[0].stem != PREFERRED
    folder = PriorShelf(str(archive)).folder(PRIOR.environment, PRIOR.task, PRIOR.vocabulary)
    assert folder == kept[0].parent
