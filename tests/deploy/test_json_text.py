"""JSON for programs that know no NaN."""

import json
import math

from prior_sg.deploy.json_text import json_text


def test_numbers_that_are_none_become_null():
    value = {"f1": math.nan, "rows": [(1.0, math.inf), {"deep": -math.inf}], "name": "NaN", "count": 3}
    expected = {"f1": None, "rows": [[1.0, None], {"deep": None}], "name": "NaN", "count": 3}
    assert json.loads(json_text(value), parse_constant=fail) == expected
    assert "\n" not in json_text(value, None)


def fail(name):
    raise AssertionError(f"{name} is no JSON")
