import os

import coverage
import hypothesis
import numpy as np
import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "2")
hypothesis.settings.register_profile("untimed", deadline=None)  # beside other work an example may take a second
hypothesis.settings.load_profile("untimed")
os.environ["PSG_PRIOR_GATEWAY__ARCHIVE"] = ""  # tests neither see nor touch the user's kept priors


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def endpoint():
    """A router of this test session, on loopback."""
    from prior_sg.services.runtime.endpoints import free_endpoint
    from prior_sg.services.runtime.zenoh_router import open_router

    address = free_endpoint("tcp/127.0.0.1:0")
    stop = open_router(address)
    yield address
    stop()


def pytest_configure(config):
    """`make test` measures coverage in xdist's workers, not in the services that tests start, which it would slow."""
    if hasattr(config, "workerinput") and "PSG_TEST_COVERAGE" in os.environ:
        config.measured = coverage.Coverage(data_suffix=True)
        config.measured.start()


def pytest_unconfigure(config):
    if measured := getattr(config, "measured", None):
        measured.stop()
        measured.save()
