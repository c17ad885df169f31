"""What is given to each robot of a merged map, all at once."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import TypeVar

from prior_sg.deploy.api.errors import TaskError
from prior_sg.schemas.priors import Prior
from prior_sg.services.errors import PriorSgError

POLL_S = 0.5  # a signal that another thread gets does not end a wait
T = TypeVar("T")


def given_each(robots: Sequence[str], give: Callable[[str], T]) -> list[T]:
    """What came of a task given to every robot, in their order. Raises TaskError where one did not take it; those that
    did keep it. An interrupt waits for none of them."""
    jobs = {robot: _begun(give, robot) for robot in robots}
    while wait(jobs.values(), POLL_S).not_done:
        pass
    refused = {robot: job.exception() for robot, job in jobs.items() if job.exception() is not None}
    for error in refused.values():
        if not isinstance(error, PriorSgError):
            raise error  # type: ignore[misc]  # there is one
    if refused:
        taken = [robot for robot in robots if robot not in refused]
        why = "; ".join(f"{robot} does not follow the task: {error}" for robot, error in refused.items())
        raise TaskError(f"{why}; {', '.join(taken) or 'no other robot'} took it")
    return [job.result() for job in jobs.values()]


def _begun(give: Callable[[str], T], robot: str) -> "Future[T]":
    """On a thread that the end of the program does not wait for, as it would for those of a pool."""
    job: Future[T] = Future()

    def work() -> None:
        try:
            job.set_result(give(robot))
        except BaseException as error:
            job.set_exception(error)

    threading.Thread(target=work, name=f"given to {robot}", daemon=True).start()
    return job


def not_above(robot: str, above: tuple[str, ...]) -> tuple[str, ...]:
    """The merged maps above a robot's. Raises TaskError where it is one of them: a task would go round for ever."""
    if robot in above:
        raise TaskError(f"{' and '.join(above)} are merged of each other: end one of their fleets")
    return above


def told_once(tell: Callable[[Prior], None]) -> Callable[[Prior], None]:
    """Tells of each prior once, whatever thread brings it: robots of one task follow one, as a rule."""
    known: set[str] = set()
    lock = threading.Lock()

    def once(prior: Prior) -> None:
        with lock:
            fresh = prior.digest() not in known
            known.add(prior.digest())
        if fresh:
            tell(prior)

    return once
