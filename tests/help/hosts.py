"""Several hosts in one machine: network namespaces, and links between them that delay, lose, limit and are cut.

A link is a pair of tunnel devices (TUN) whose packets this process carries: real TCP on both sides, and nothing of the
kernel is needed but namespaces and tunnels. Both need root; without it tests are skipped.
"""

import contextlib
import fcntl
import heapq
import itertools
import os
import random
import select
import struct
import subprocess
import threading
import time
from dataclasses import dataclass, field

import pytest

SET_INTERFACE, TUN_WITHOUT_HEADER = 0x400454CA, 0x1001  # TUNSETIFF, IFF_TUN | IFF_NO_PI
MTU = 1400
QUEUE_S = 0.3  # of traffic that a slow link keeps before it drops, as a modem does
_numbers = itertools.count()


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@dataclass
class Host:
    """A network namespace; its processes see its own loopback and its links."""

    name: str
    address: str = ""
    processes: list = field(default_factory=list)

    def start(self, *command, log=None, env=None):
        """A process on this host, ended with it; what it says goes to a file."""
        with contextlib.ExitStack() as files:
            out = files.enter_context(log.open("ab")) if log else subprocess.DEVNULL
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.name, *map(str, command)],
                stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, env=env,
            )  # fmt: skip
        self.processes.append(process)
        return process

    def run(self, *command, env=None, timeout_s=600):
        """What a command on this host says."""
        words = ["ip", "netns", "exec", self.name, *map(str, command)]
        return subprocess.run(words, capture_output=True, text=True, env=env, timeout=timeout_s, check=False)

    def end(self):
        for process in self.processes:
            if process.poll() is None:
                process.terminate()
        for process in self.processes:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)
        self.processes.clear()


class Link(threading.Thread):
    """Carries packets between two tunnels until `close`. What it does to them may be changed at any time."""

    def __init__(self, ends):
        super().__init__(daemon=True, name="link")
        self.ends = ends
        self.delay_s, self.loss, self.bps, self.cut = 0.0, 0.0, 0.0, False
        self.bytes, self.lost = [0, 0], [0, 0]  # carried and not carried, by the end they came from
        self._free_s = [0.0, 0.0]  # when all that was sent before is out
        self._under_way, self._order = [], itertools.count()
        self._random, self._ending = random.Random(7), False
        self.start()

    def run(self):
        while not self._ending:
            wait_s = min(max(self._under_way[0][0] - time.monotonic(), 0.0), 0.05) if self._under_way else 0.05
            readable, _, _ = select.select(self.ends, [], [], wait_s)
            for end in readable:
                with contextlib.suppress(OSError):
                    self._take(self.ends.index(end), os.read(end, 65536))
            while self._under_way and self._under_way[0][0] <= time.monotonic():
                _, _, side, packet = heapq.heappop(self._under_way)
                if not self.cut:
                    with contextlib.suppress(OSError):
                        os.write(self.ends[1 - side], packet)

    def _take(self, side, packet):
        now_s = time.monotonic()
        begin_s = max(now_s, self._free_s[side])
        full = self.bps and begin_s - now_s > QUEUE_S
        if self.cut or full or self._random.random() < self.loss:
            self.lost[side] += 1
            return
        if self.bps:
            begin_s = self._free_s[side] = begin_s + len(packet) * 8 / self.bps
        self.bytes[side] += len(packet)
        heapq.heappush(self._under_way, (begin_s + self.delay_s, next(self._order), side, packet))

    def close(self):
        self._ending = True
        self.join()
        for end in self.ends:
            os.close(end)


class Network:
    """Hosts and links of one test; use as a context manager. All of it goes at the end, whatever happened."""

    def __init__(self):
        self.hosts, self.links = [], []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for host in self.hosts:
            host.end()
        for link in self.links:
            link.close()
        for host in self.hosts:
            subprocess.run(["ip", "netns", "del", host.name], check=False, capture_output=True)

    def host(self, name):
        """Another host. Skips the test where none can be made."""
        host = Host(f"psg-{os.getpid()}-{next(_numbers)}-{name}")
        try:
            ip("netns", "add", host.name)
            self.hosts.append(host)
            ip("-n", host.name, "link", "set", "lo", "up")
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no network namespaces here: {getattr(error, 'stderr', '') or error}")
        return host

    def link(self, one, other):
        """Join two hosts; each has one link."""
        number = next(_numbers)
        ends = []
        for side, host in enumerate((one, other)):
            device = f"psg{os.getpid() % 100000}n{number}{'ab'[side]}"
            try:
                end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                ends.append(end)
                fcntl.ioctl(end, SET_INTERFACE, struct.pack("16sH22x", device.encode(), TUN_WITHOUT_HEADER))
            except OSError as error:
                pytest.skip(f"no tunnels here: {error}")
            host.address = f"10.77.{number % 250}.{side + 1}"
            ip("link", "set", device, "netns", host.name)
            ip("-n", host.name, "address", "add", f"{host.address}/24", "dev", device)
            ip("-n", host.name, "link", "set", device, "mtu", str(MTU), "up")
        made = Link(ends)
        self.links.append(made)
        return made
