"""What each fault does: a context manager that begins it, and ends it after the time it lasts."""

import contextlib
import errno
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import psutil
import zenoh

from prior_sg.schemas.topics import TOPICS
from prior_sg.services.runtime.bus import pack_header
from tests.chaos.faketime import set_clock
from tests.chaos.schedule import RECORDER, ROUTER, Planned
from tests.chaos.serve import Mode
from tests.chaos.system import System
from tests.chaos.watch import Watch, waited

Fault = Callable[[System, Watch, Planned], contextlib.AbstractContextManager[None]]
DELAY_S, RATE_B_S = 0.1, 200_000.0
RESET_EVERY_S = 0.4
SENT_AGAIN_HZ = 150
GARBAGE_EVERY_S = 0.1  # a hundred messages and more
GARBAGE = (b"", b"\x00", b"\xff" * 64, bytes(range(256)) * 2)
CLOCK_OFF_S = (2.0, 90.0, 7200.0, 86_400.0 * 3)
HOG = """
import os, sys
with open(sys.argv[1], "wb") as file:
    while True:
        file.seek(0)
        file.write(os.urandom(1 << 23))
        file.flush()
        os.fsync(file)
"""
SPIN = "while True: pass"
COME_S = 60.0  # for a process that is started again


@contextmanager
def killed(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Ended at once by kill -9."""
    system.signal(plan.target, signal.SIGKILL)
    yield


@contextmanager
def restarted(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Told to end, and started again."""
    system.signal(plan.target, signal.SIGTERM)
    yield


@contextmanager
def stopped(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """SIGSTOP, then SIGCONT."""
    pid = system.signal(plan.target, signal.SIGSTOP)
    yield
    with contextlib.suppress(ProcessLookupError):
        if pid:
            os.kill(pid, signal.SIGCONT)


@contextmanager
def router_away(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """The router ends in order, and another comes with another id."""
    system.router.away = True
    system.signal(ROUTER, signal.SIGTERM)
    yield
    system.router.away = False


@contextmanager
def cable_out(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Nothing passes and nobody is told; then the connections break, and what was under way is lost."""
    link = system.proxies.link(plan.target)
    link.held = True
    yield
    system.proxies.reset(plan.target)
    link.held = False


@contextmanager
def refused(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Connections break, and new ones are refused."""
    link = system.proxies.link(plan.target)
    link.refused = True
    system.proxies.reset(plan.target)
    yield
    link.refused = False


@contextmanager
def resets(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Connections break again and again."""
    over = threading.Event()

    def reset() -> None:
        while not over.wait(RESET_EVERY_S):
            system.proxies.reset(plan.target)

    with _meanwhile(reset, over):
        yield


@contextmanager
def delayed(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Each piece of what is sent and heard comes late."""
    link = system.proxies.link(plan.target)
    link.delay_s = DELAY_S
    yield
    link.delay_s = 0.0


@contextmanager
def thin(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """The link carries little."""
    link = system.proxies.link(plan.target)
    link.rate_b_s = RATE_B_S
    yield
    link.rate_b_s = 0.0


def heard(mode: Mode) -> Fault:
    """What a process hears is disturbed."""

    @contextmanager
    def fault(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
        system.set_mode(plan.target, mode)
        yield
        system.set_mode(plan.target, Mode())

    return fault


@contextmanager
def sent_again(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """A second publisher repeats, in any order, what was sent lately."""
    over, rng = threading.Event(), random.Random(plan.delay_s)

    def send() -> None:
        while not over.wait(1 / SENT_AGAIN_HZ):
            sample = rng.choice(tuple(watch.recent))
            header = pack_header(sample.writer, sample.sequence, sample.sent_ns)
            _raw(watch, sample.key, sample.payload, header)

    with _meanwhile(send, over):
        yield


@contextmanager
def garbage(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Bytes that are no messages, and halves of real ones, on every key."""
    over = threading.Event()

    def send() -> None:
        while not over.wait(GARBAGE_EVERY_S):
            cut = [sample.payload[: len(sample.payload) // 2] for sample in tuple(watch.recent)[-3:]]
            for topic in TOPICS:
                if topic.delivery != "job":
                    key = topic.key.format(robot="robot1", digest="0" * 32, question="0" * 32)
                    for payload in (*GARBAGE, *cut):
                        _raw(watch, key, payload, b"\xff" * 40)

    with _meanwhile(send, over):
        yield


@contextmanager
def second(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """A second process of the same service, for a while."""
    with _second(system, plan):
        yield


@contextmanager
def takeover(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """A second process comes, the first one is killed, and the second one ends again."""
    with _second(system, plan) as other:
        waited(lambda: any(name.startswith(f"{plan.target}-second") for name in watch.client.alive()), 3.0)
        system.signal(plan.target, signal.SIGKILL)
        yield
        del other


@contextmanager
def _second(system: System, plan: Planned) -> Iterator[subprocess.Popen]:
    child = system.supervisor.child(plan.target, f"{plan.target}-second")
    child.start()
    assert child.process is not None
    try:
        yield child.process
    finally:
        child.process.terminate()
        try:
            child.process.wait(15.0)
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()


def speaks(dialect: str) -> Fault:
    """A process of another release of the same minor version takes the place of ours; the next one is ours again."""

    @contextmanager
    def fault(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
        system.set_mode(plan.target, Mode(dialect=dialect))
        _exchanged(system, plan.target)
        yield
        system.set_mode(plan.target, Mode())

    return fault


def clock_off(direction: int) -> Fault:
    """A process's clock jumps, and jumps back."""

    @contextmanager
    def fault(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
        file = system.folder / f"clock-{plan.target}"
        set_clock(file, 0.0)
        system.set_mode(plan.target, Mode(faketime=str(file)))
        _exchanged(system, plan.target)
        system.set_mode(plan.target, Mode())
        waited(system.complete, COME_S)
        set_clock(file, direction * random.Random(plan.delay_s).choice(CLOCK_OFF_S))
        yield
        set_clock(file, 0.0)

    return fault


def _exchanged(system: System, target: str) -> None:
    """End the process of a service, and wait until the next one has begun, which reads its mode."""
    old = system.signal(target, signal.SIGTERM)
    waited(lambda: system.pid(target) not in (0, old), COME_S)
    new = system.child(target)
    waited(lambda: any(name == new.unique for name in system.client.alive()) or system.failed, COME_S)


@contextmanager
def full_disk(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Nothing more can be written where the store and the recorder write."""
    filler = system.disk / "filler"
    system.expected += ["scene_store", RECORDER]
    with filler.open("wb", buffering=0) as file:
        block = 1 << 20
        while block:
            try:
                file.write(bytes(block))
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                block //= 4
        try:
            yield
        finally:
            filler.unlink()


@contextmanager
def slow_disk(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Somebody else writes and syncs all the time."""
    file = system.folder / "hog"
    with _running([sys.executable, "-c", HOG, str(file)]):
        yield
    file.unlink(missing_ok=True)


@contextmanager
def short_of_memory(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """A process gets hardly any more memory."""
    pid = system.pid(plan.target)
    with contextlib.suppress(psutil.Error, ProcessLookupError):
        limit_b = psutil.Process(pid).memory_info().vms + (2 << 20)
        resource.prlimit(pid, resource.RLIMIT_AS, (limit_b, resource.RLIM_INFINITY))
        system.expected.append(plan.target)
    yield
    with contextlib.suppress(ProcessLookupError):
        resource.prlimit(pid, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


@contextmanager
def starved(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """All processes share one core with others that never rest."""
    cores = os.sched_getaffinity(0)
    crowded = {min(cores)}
    _bind(system, crowded)
    with _running([sys.executable, "-c", SPIN], [sys.executable, "-c", SPIN]) as hogs:
        for hog in hogs:
            os.sched_setaffinity(hog.pid, crowded)
        yield
    _bind(system, cores)


def _bind(system: System, cores: set[int]) -> None:
    for process in system.processes():
        with contextlib.suppress(OSError):
            for thread in process.threads():
                os.sched_setaffinity(thread.id, cores)


@contextmanager
def netem(system: System, watch: Watch, plan: Planned) -> Iterator[None]:
    """Loopback of this network namespace loses, delays, repeats and reorders packets."""
    kinds = ["delay", "20ms", "10ms", "loss", "2%", "duplicate", "1%", "reorder", "5%"]
    subprocess.run(["tc", "qdisc", "replace", "dev", "lo", "root", "netem", *kinds], check=True)
    try:
        yield
    finally:
        subprocess.run(["tc", "qdisc", "del", "dev", "lo", "root"], check=True)


FAULTS: dict[str, Fault] = {
    "kill": killed,
    "stop": stopped,
    "long stop": stopped,
    "restart": restarted,
    "router away": router_away,
    "cable out": cable_out,
    "refused": refused,
    "resets": resets,
    "delay": delayed,
    "thin link": thin,
    "lost": heard(Mode(lost=0.3)),
    "repeated": heard(Mode(repeated=0.5)),
    "reordered": heard(Mode(held=0.3)),
    "sent again": sent_again,
    "garbage": garbage,
    "second": second,
    "takeover": takeover,
    "older": speaks("older"),
    "newer": speaks("newer"),
    "clock ahead": clock_off(+1),
    "clock behind": clock_off(-1),
    "full disk": full_disk,
    "slow disk": slow_disk,
    "memory": short_of_memory,
    "starved": starved,
    "netem": netem,
}


@contextmanager
def _running(*commands: list[str]) -> Iterator[list[subprocess.Popen]]:
    processes = [subprocess.Popen(command) for command in commands]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


@contextmanager
def _meanwhile(does: Callable[[], None], over: threading.Event) -> Iterator[None]:
    thread = threading.Thread(target=does, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _raw(watch: Watch, key: str, payload: bytes, header: bytes) -> None:
    session = watch.client.bus._session  # type: ignore[attr-defined]
    with contextlib.suppress(zenoh.ZError):  # while the router is away
        session.put(key, payload, attachment=header, congestion_control=zenoh.CongestionControl.BLOCK)


def done(system: System, watch: Watch, plan: Planned, over: Callable[[], None]) -> None:
    """Wait for the fault's moment, do it, and say when it is over."""
    time.sleep(plan.delay_s)
    with FAULTS[plan.fault](system, watch, plan):
        time.sleep(plan.lasts_s)
    over()
