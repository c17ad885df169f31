"""What the commands of `prior-sg` share: the terminal, options and the way onto the bus."""

import argparse
import contextlib
import logging
import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.interrupts import insist
from prior_sg.deploy.settings import DEFAULT_ROBOT, ROUTER_WAIT_S, add_keys, connect_in_force
from prior_sg.deploy.terminal import Terminal
from prior_sg.schemas.names import shown

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

    from prior_sg.services.runtime.client import BusClient
    from prior_sg.services.runtime.keys import Beyond

POLL_S = 0.2
LONGEST_COMPLAINT = 1500  # characters of what is wrong with an argument; there are names of all commands
console = Terminal()

Run = Callable[[argparse.Namespace], int]  # does what a command was told; its exit status


class Parser(argparse.ArgumentParser):
    """What it says of an argument is one sentence, fit for a terminal, that ends in an example."""

    def __init__(self, *given: Any, example: str = "", **named: Any) -> None:
        super().__init__(*given, **named)
        self._example = example

    def error(self, message: str) -> NoReturn:
        """End with status 2."""
        short = message if len(message) <= LONGEST_COMPLAINT else f"{message[:LONGEST_COMPLAINT]}…"
        self.exit(2, f"{self.prog}: error: {short}; such as `{self._example}` (see {self.prog} --help)\n")

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        super()._print_message(shown(message), file)


class Commands:
    """Where commands are declared: each with what it does, a line about it and an example."""

    def __init__(self, parser: argparse.ArgumentParser, dest: str, metavar: str, prefix: str = "") -> None:
        self._parsers = parser.add_subparsers(dest=dest, required=True, metavar=metavar)
        self._prefix = prefix

    def add(self, name: str, run: Run, summary: str, example: str, needs: str = "") -> argparse.ArgumentParser:
        """The parser of a new command. `needs` names the extra whose packages it cannot do without."""
        parser = self._parsers.add_parser(
            name, help=summary, description=summary, **with_example(self._prefix + example)
        )
        parser.set_defaults(run=run, needs=needs)
        return parser


def with_example(text: str) -> dict:
    """Arguments of a parser whose help ends in an example."""
    return {"example": text, "epilog": f"example: {text}", "formatter_class": argparse.RawDescriptionHelpFormatter}


def add_bus(parser: argparse.ArgumentParser, robot: bool = True) -> None:
    """Options of whatever talks to running services."""
    parser.add_argument("--connect", default=connect_in_force(), help="Zenoh router (default: %(default)s)")
    add_keys(parser)
    if robot:
        parser.add_argument("--robot", default=DEFAULT_ROBOT, help="name of the robot (default: %(default)s)")


def add_router(parser: argparse.ArgumentParser) -> None:
    """Options of whatever starts a router that reaches beyond this host."""
    parser.add_argument(
        "--listen", action="append", default=[], metavar="tls/HOST:PORT", help="let those with keys join this router"
    )
    parser.add_argument(
        "--join", action="append", default=[], metavar="tls/HOST:PORT", help="join this router to that of an edge"
    )
    parser.add_argument(
        "--thin-link",
        type=rate_in,
        default=0.0,
        metavar="RATE",
        help="bits per second that links to other hosts carry, as 2M or 500k, at both ends: what is urgent overtakes, "
        "states come less often, keyframes stay on their host",
    )


def reach_of(arguments: argparse.Namespace) -> "Beyond | None":
    """How such a router reaches others. Raises UserError, BusError."""
    from prior_sg.deploy.keys.routing import beyond_this_host

    return beyond_this_host(arguments.listen, arguments.join, arguments.thin_link)


def rate_in(text: str) -> float:
    """Bits per second in what a user wrote. Raises ArgumentTypeError."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kMG]?)", text)
    if match is None or not (bps := float(match[1]) * {"": 1, "k": 1e3, "M": 1e6, "G": 1e9}[match[2]]):
        raise argparse.ArgumentTypeError(f"{text!r} is no rate; write bits per second as 2M or 500k")
    return bps


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Options that change the services' settings."""
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")


def add_log_mb(parser: argparse.ArgumentParser) -> None:
    """An option of whatever records a log."""
    parser.add_argument(
        "--log-mb", type=_not_negative, default=0.0, help="end the recording at this size; 0 = never (default)"
    )


def _not_negative(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 0 on")
    return number


def open_client(connect: str, on_deaf: Callable[[], None] | None = None) -> "BusClient":
    """A client on the bus; `on_deaf` as of ZenohBus. Raises BusError."""
    from prior_sg.services.runtime.client import BusClient
    from prior_sg.services.runtime.zenoh_bus import ZenohBus

    return BusClient(ZenohBus(connect, ROUTER_WAIT_S, on_deaf=on_deaf))


class _Sentences(logging.Handler):
    """What a service has to say, on the terminal."""

    def emit(self, record: logging.LogRecord) -> None:
        """One line, with what is known of the reason."""
        why = getattr(record, "why", "")
        console.print(f"{record.getMessage()}{f': {why}' if why else ''}")


def tell_logs() -> None:
    """What a service that runs in this process warns of goes to the terminal."""
    root = logging.getLogger()
    root.handlers[:] = [_Sentences(logging.WARNING)]
    root.setLevel(logging.WARNING)


def hush_logs() -> None:
    """What services of a measurement in this process warn of is no news: it tells its own figures and errors."""
    logging.getLogger("prior_sg").addHandler(logging.NullHandler())


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """A file is written within. Raises UserError where it cannot be."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path} ({error.strerror or error}); name another file") from error


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C ends what goes on within, be it by itself or by the exception; and that is said."""
    with contextlib.suppress(KeyboardInterrupt):
        yield
    console.print("stopping")


def wait(meanwhile: Callable[[], object] = lambda: None) -> None:
    """Until Ctrl-C; `meanwhile` is done five times a second. Raises KeyboardInterrupt."""
    while True:
        insist()
        meanwhile()
        time.sleep(POLL_S)
