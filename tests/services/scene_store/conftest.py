"""Places for a scene store in either kind of database."""

import pytest

from tests.help.databases import new_database, server


@pytest.fixture(scope="session")
def postgres(tmp_path_factory):
    """One server for all tests of this process."""
    with server(tmp_path_factory.mktemp("postgres") / "data") as running:
        yield running


@pytest.fixture(params=("sqlite", "postgres"))
def place(request, tmp_path):
    """Where a store may keep its scenes: a new file, or a new database of a server."""
    if request.param == "sqlite":
        return str(tmp_path / "scene.sqlite")
    return new_database(request.getfixturevalue("postgres"))
