"""A server in a thread of its own, on a free port of loopback."""

import contextlib
import threading
import time

from prior_sg.deploy.serving.server import Server, address_of, listening


@contextlib.contextmanager
def served(app, closing=lambda: None):
    """Its address, until the end."""
    with listening("127.0.0.1", 0) as listener:
        server = Server(app, closing)
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        while not server.started:
            time.sleep(0.01)
        try:
            yield address_of(listener)
        finally:
            server.should_exit = True
            thread.join(10)
            assert not thread.is_alive()
