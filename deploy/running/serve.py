"""Runs one service in this process: `python -m prior_sg.deploy.running.serve segmenter --robot robot1`."""

import argparse
import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
import uuid
from collections.abc import Coroutine
from typing import Any

from prior_sg.deploy.edge import check_arguments
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running import crashes
from prior_sg.deploy.running.here import noted
from prior_sg.deploy.settings import DEFAULT_ROBOT, add_keys, connect_in_force, resolved_config, use_keys
from prior_sg.deploy.streams import complain
from prior_sg.services.roles import KEEPERS, LEASED, NAMES, WRITERS, declared
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.config import ConfigError
from prior_sg.services.runtime.hearing import end_deaf
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.host.lease import Fence, Lease, SupersededError
from prior_sg.services.runtime.host.succession import Predecessor, Standby
from prior_sg.services.runtime.logs import start_logging
from prior_sg.services.runtime.record import LogError
from prior_sg.services.runtime.service import Identity, LaterError, Service, ServiceError
from prior_sg.services.runtime.zenoh_bus import ZenohBus

log = logging.getLogger(__name__)
PARENT_CHECK_S = 1.0
HOPELESS = (ConfigError, BusError, ServiceError, LogError)  # their messages say what to do
EXIT_HOPELESS = 2  # starting again would fail again
EXIT_SUPERSEDED = 3  # another is in charge: started again, it waits for that one's end
EXIT_YIELDED = 4  # another has taken over: not to be started again
EXIT_LATER = 5  # it lacks what can come back: started again, it goes on as soon as that has


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What a service process can be told."""
    parser.add_argument("service", choices=sorted(NAMES), help="which service to run")
    parser.add_argument("--robot", default=DEFAULT_ROBOT, help="name of the robot whose streams it serves")
    parser.add_argument("--connect", default=connect_in_force(), help="Zenoh router")
    add_keys(parser)
    parser.add_argument("--instance", default="", help="name of this process; default: a random one")
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")
    parser.add_argument(
        "--succeeds", default="", metavar="INSTANCE", help="take over from this process, which yields and ends"
    )
    parser.add_argument("--held", action="store_true", help="load everything, and begin when standard input has a line")
    parser.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    parser.add_argument("--parent", type=int, default=0, help="end when this process is gone")
    parser.add_argument("--crashes", default="", metavar="FOLDER", help="write there how the service died, if it does")


async def serve(arguments: argparse.Namespace, instance: str) -> bool:
    """Run until a signal, until the parent is gone, or until another takes over: then True."""
    service = declared(arguments.service)
    cfg = resolved_config(service, arguments.config, arguments.set)
    robot = arguments.robot if service.scope == "robot" else "*"
    identity = Identity(robot, instance, time.time_ns())
    return await stay(
        service,
        cfg,
        identity,
        arguments.connect,
        arguments.parent,
        succeeds=arguments.succeeds,
        crash_folder=arguments.crashes,
    )


async def stay(
    service: Service,
    cfg: Any,
    identity: Identity,
    connect: str,
    parent: int = 0,
    *,
    succeeds: str = "",
    crash_folder: str = "",
) -> bool:
    """Run a service on the bus of a router until a signal, until the parent, if there is one, is gone, or until another
    takes over: then True. `succeeds` is the instance from which this process takes over. Where it fails by a fault of
    its own, a report goes to the folder, if there is one.
    """
    bus = await asyncio.to_thread(ZenohBus, connect, on_deaf=end_deaf)
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopping.set)
    watcher = asyncio.create_task(_stop_with_parent(stopping, parent))
    host = None
    try:
        host = await _unless(stopping, _in_charge(service, bus, cfg, identity, succeeds))
        if host is not None:
            await _stopped_by(stopping, host)
        return host is not None and host.yielded
    except (*HOPELESS, SupersededError):
        raise
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and extras.advice(error) is not None:
            raise
        inputs = host.trail.newest(crashes.LAST_INPUTS) if host is not None else []
        if path := crashes.report(crash_folder, service.name, identity, error, cfg, inputs):
            log.error("crash report written", extra={"path": path})
        raise
    finally:
        watcher.cancel()
        bus.close()  # also when the service never got so far as to leave by itself


async def _in_charge(service: Service, bus: ZenohBus, cfg: Any, identity: Identity, succeeds: str = "") -> Host:
    """The host of a service, once it may write, or stand by: what writes the same deltas has one lease, whatever it is
    called."""
    robot, instance = identity.robot, identity.instance
    fence = await asyncio.to_thread(Fence, bus, robot, WRITERS)
    former = Predecessor(bus, identity.whose, service.name, succeeds, instance) if succeeds else None
    if former is not None and service.handover is None and not service.beside:
        await former.yields()
    if service.scope != "robot":
        return Host(service, bus, cfg, identity, fence=fence, replaces=former if service.beside else None)
    lease = _lease(service, bus, identity)
    if former is not None and service.handover is not None:
        identity = Identity(robot, instance, await lease.stand_by())
        return Host(service, bus, cfg, identity, lease=lease, fence=fence, standby=Standby(former, lease))
    identity = Identity(robot, instance, await lease.take())
    return Host(service, bus, cfg, identity, lease=lease, fence=fence, follows=lease.has_predecessor)


def _lease(service: Service, bus: ZenohBus, identity: Identity) -> Lease:
    topics = [topic for topic in service.writes if topic.name in LEASED]
    keepers = [name for name in KEEPERS if name != service.name]
    role = LEASED[topics[0].name] if topics else service.name
    shared = [name for name, services in WRITERS.items() if len(services) > 1]
    return Lease(bus, identity.robot, role, identity.instance, topics=topics, keepers=keepers, shared=shared)


async def _unless(stopping: asyncio.Event, starting: Coroutine[Any, Any, Host]) -> Host | None:
    """What is awaited, or None where the process is to stop before."""
    start, stop = asyncio.create_task(starting), asyncio.create_task(stopping.wait())
    await asyncio.wait((start, stop), return_when=asyncio.FIRST_COMPLETED)
    stop.cancel()
    if start.done():
        return start.result()
    start.cancel()
    return None


async def _stopped_by(stopping: asyncio.Event, host: Host) -> None:
    """Run a host until it ends or is told to."""

    async def tell() -> None:
        await stopping.wait()
        host.stop()

    telling = asyncio.create_task(tell())
    try:
        await host.run()
    finally:
        telling.cancel()


async def parent_gone(parent: int) -> None:
    """Until the parent process is gone; 0 = there is none that matters, and this waits for ever."""
    while not parent or os.getppid() == parent:
        await asyncio.sleep(PARENT_CHECK_S)


async def _stop_with_parent(stopping: asyncio.Event, parent: int) -> None:
    await parent_gone(parent)
    stopping.set()


def run(arguments: argparse.Namespace) -> int:
    """Exit status of one service process."""
    instance = arguments.instance or f"{arguments.service}-{uuid.uuid4().hex[:8]}"
    use_keys(arguments.keys)
    start_logging(arguments.service, instance, arguments.log_level)
    try:
        with contextlib.suppress(ImportError):
            import uvloop

            asyncio.set_event_loop_policy(uvloop.EventLoopPolicy())
        if arguments.held and not _released(arguments.service):
            return 0
        with noted(instance), crashes.watched(arguments.crashes, instance):
            yielded = asyncio.run(serve(arguments, instance))
    except LaterError as error:
        log.error(str(error))
        return EXIT_LATER
    except HOPELESS as error:
        log.error(str(error))
        return EXIT_HOPELESS
    except SupersededError as error:
        log.error(str(error))
        return EXIT_SUPERSEDED
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and (advice := extras.advice(error)) is not None:
            log.error(advice)
            return EXIT_HOPELESS
        log.exception("the service failed")
        return 1
    log.info("another has taken over" if yielded else "stopped")
    return EXIT_YIELDED if yielded else 0


def _released(name: str) -> bool:
    """Load a service and wait until it may begin; False where nobody is left to say so."""
    declared(name)
    return bool(sys.stdin.readline())


def main() -> int:
    """Entry point of `python -m prior_sg.deploy.running.serve`."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser)
    arguments = parser.parse_args()
    try:
        check_arguments(arguments)
    except UserError as error:
        complain(str(error))
        return EXIT_HOPELESS
    return run(arguments)


if __name__ == "__main__":
    sys.exit(main())
