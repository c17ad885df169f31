"""Caches where there is no home, or none that can be written."""

import os
import tempfile
from pathlib import Path

import pytest

from prior_sg.services.feature_pyramid.encoders import onnx_session
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable
from prior_sg.services.folders import expanded, temporary_cache, user_cache
from prior_sg.services.prior_gateway.outside.archive import PriorShelf


@pytest.fixture
def no_home(monkeypatch):
    """A user whom the system does not know, as in a container started with a number."""

    def unknown(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", unknown)


def test_a_user_without_a_home_has_a_cache_and_no_archive(no_home, caplog):
    assert expanded("~/key") == Path("~/key")
    assert user_cache() == Path("~/.cache/prior-sg")
    assert PriorShelf("~/.cache/prior-sg/priors").root is None
    assert "prior_gateway.archive" in caplog.text


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_folder_that_others_can_write_is_never_used(temporary):
    theirs = temporary / f"prior-sg-{os.getuid()}"
    theirs.mkdir()
    theirs.chmod(0o777)
    other = temporary_cache("compiled")
    assert theirs not in other.parents and other.parent.stat().st_mode & 0o077 == 0
    theirs.rmdir()
    assert temporary_cache("compiled").parent == theirs == temporary_cache("onnx").parent


def test_exports_go_where_something_can_be_written(temporary, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/1")
    onnx_session.say_temporary.cache_clear()
    made = []

    def export(path):
        path.write_bytes(b"network")
        made.append(path)

    first = onnx_session.cached("net", ["torch 1"], export)
    assert temporary in first.parents and first.read_bytes() == b"network"
    assert "/proc/1" in caplog.text
    assert onnx_session.cached("net", ["torch 1"], export) == first and len(made) == 1
    onnx_session.cached("other", ["torch 1"], export)
    assert caplog.text.count("exports are kept in the temporary folder") == 1
    monkeypatch.setattr(tempfile, "tempdir", "/proc/1")
    with pytest.raises(EncoderUnavailable, match="set XDG_CACHE_HOME"):
        onnx_session.cached("net", ["torch 1"], export)
