"""Why a place carries its label, as a table."""

import msgspec

from prior_sg.deploy.inspecting.explain import ROWS, label_table
from prior_sg.schemas.regions import PosteriorReply
from tests.help.examples import EXAMPLES


def test_labels_that_are_not_shown_are_counted():
    (reply,) = (one for one in EXAMPLES if isinstance(one, PosteriorReply))
    assert label_table(reply).row_count == len(reply.labels) and label_table(reply).caption is None
    count = ROWS + 3
    names, shares = [f"room {number}" for number in range(count)], [1 / count] * count
    columns = {
        field: [0.5] * count
        for field in reply.__struct_fields__
        if isinstance(getattr(reply, field), list)
        and len(getattr(reply, field)) == len(reply.labels)
        and field != "votes"
    }
    many = msgspec.structs.replace(reply, **columns | {"labels": names, "posterior": shares, "votes": []})
    assert label_table(many).row_count == ROWS and label_table(many).caption == "and 3 less probable labels"
