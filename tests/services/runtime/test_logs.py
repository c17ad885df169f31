"""Logs: one JSON object a line, and no flood of them."""

import json
import logging

from prior_sg.services.runtime.logs import JsonFormatter, Limit


def record(created, line=1, level=logging.WARNING):
    made = logging.LogRecord("n", level, "f.py", line, "bad", (), None)
    made.created = created
    return made


def test_a_flood_of_warnings_is_counted_instead_of_written():
    limit = Limit(burst=3, window_s=10.0)
    written = [one for at in range(1000) if limit.filter(one := record(100.0 + at / 100))]
    assert len(written) == 3
    after = record(111.0)
    assert limit.filter(after) and json.loads(JsonFormatter("s", "i").format(after))["left_out"] == 997
    quiet = record(130.0)
    assert limit.filter(quiet) and not hasattr(quiet, "left_out")


def test_other_places_and_plain_words_are_not_held_back_and_a_clock_may_go_back():
    limit = Limit(burst=1, window_s=10.0)
    assert limit.filter(record(100.0)) and not limit.filter(record(100.0))
    assert limit.filter(record(100.0, line=2)) and limit.filter(record(100.0, level=logging.INFO))
    assert all(limit.filter(record(100.0, level=logging.INFO)) for _ in range(50))
    assert limit.filter(record(5.0))
