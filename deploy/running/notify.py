"""What systemd is told of a unit of `Type=notify` (sd_notify): that it is ready, and now and then that it lives."""

import os
import socket
import time

EVERY_S = 5.0


class Watchdog:
    """Silent where systemd did not start this process."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        self._told_s = 0.0

    def alive(self) -> None:
        """Say so, the first time that all is ready; at most once in a few seconds."""
        now_s = time.monotonic()
        if not self._address or (self._told_s and now_s - self._told_s < EVERY_S):
            return
        self._tell("WATCHDOG=1" if self._told_s else "READY=1")
        self._told_s = now_s

    def _tell(self, state: str) -> None:
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
            end.sendto(state.encode(), address)
