"""Every intruder of the table is refused, nobody has heard it, and the refusal is logged where the table says."""

import pytest

from tests.help.intruder_rows import ROWS, table
from tests.help.long import long_run


@long_run
@pytest.mark.timeout(900)
def test_intruders_are_refused_and_told(tmp_path):
    rows = list(table(tmp_path))
    assert len(rows) == len(ROWS) >= 25
    for one in rows:
        assert one.happened.startswith(("not connected", "refused by", "dropped by", "not mapped")), one
        assert one.said or one.logged == "nobody", one
    assert [one.tried for one in rows if one.logged == "nobody"] == ["a message of 300 MB"]
