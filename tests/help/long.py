"""Tests of whole systems that take minutes: `make test-long` runs them, `make test` does not."""

import os

import pytest

long_run = pytest.mark.skipif(not os.environ.get("PSG_TEST_LONG"), reason="long: `make test-long` runs it")
