"""What `prior_sg` itself offers."""

import subprocess
import sys

import pytest

import prior_sg
from prior_sg.deploy.errors import UserError
from prior_sg.services.runtime.record import LogError
from prior_sg.services.runtime.service import ServiceError

HEAVY = ("torch", "numba", "cv2", "zenoh", "scipy", "spark_dsg", "numpy")


def loaded_after(statement):
    code = f"import sys; {statement}; print(*sys.modules)"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_importing_it_loads_nothing_heavy():
    modules = loaded_after("import prior_sg; prior_sg.__version__; prior_sg.Error; dir(prior_sg)")
    assert not set(HEAVY) & set(modules)


def test_a_client_needs_no_networks():
    modules = loaded_after("import prior_sg; prior_sg.Client; prior_sg.Scene")
    assert "zenoh" in modules and not {"torch", "numba", "cv2", "scipy"} & set(modules)


def test_every_public_name_is_there_and_no_other():
    for name in prior_sg.__all__:
        assert getattr(prior_sg, name) is not None and name in dir(prior_sg)
    with pytest.raises(AttributeError, match="no attribute 'Mappper'"):
        _ = prior_sg.Mappper


def test_whatever_goes_wrong_for_a_user_is_an_error():
    ours = [getattr(prior_sg, name) for name in prior_sg.__all__ if name.endswith("Error")]
    assert len(ours) == 10
    assert all(issubclass(kind, prior_sg.Error) for kind in (*ours, UserError, ServiceError, LogError))
