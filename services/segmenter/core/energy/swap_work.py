"""Which alpha-beta-swaps are still to be tried, and the scratch space to try them in (pure).

Each place carries one flag per label: whether the swap of its own label with that one is to be tried there, NEAR or
DEEP (`swap_moves`). Places with a flag wait in two rings, first come first served.
"""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled

UNSEEN, LISTED, FREE, TAKES_ALPHA, TAKES_BETA = 0, 1, 2, 3, 4
NOT_PENDING, NEAR, DEEP = 0, 1, 2  # a swap's flag; NEAR and DEEP less one are also the numbers of their queues
PLACE, BETA, SEEN, FREE_COUNT, CAPPED = range(5)  # entries of Work.core
HEAD, COUNT = 0, 1  # columns of Work.rings


class Work(NamedTuple):
    """Flags and scratch space; `pending`, `queues`, `queued` and `rings` hold state between calls."""

    pending: np.ndarray  # (place, label) uint8: NOT_PENDING, NEAR or DEEP
    queues: np.ndarray  # (2, place) int32 rings of places with a NEAR flag and with a DEEP one, first come first served
    queued: np.ndarray  # (2, place) uint8
    rings: np.ndarray  # (2, 2) int64 start and length of each ring
    core: np.ndarray  # (5,) int64 the core in hand: its first place and other label, sizes, whether it was ended
    mark: np.ndarray  # (place,) int8 UNSEEN, LISTED, FREE, TAKES_ALPHA or TAKES_BETA
    seen: np.ndarray  # (place,) int32 the places of the core in hand
    lean: np.ndarray  # (place,) D
    hold: np.ndarray  # (place,) S
    stack: np.ndarray  # (place + arc,) int32
    level: np.ndarray  # (place,) int32 distance to the sink
    arc: np.ndarray  # (place,) int64 next arc to try
    capacity: np.ndarray  # (arc,)


def empty_work(places: int, labels: int, arcs: int) -> Work:
    """Nothing pending."""
    return Work(
        pending=np.zeros((places, labels), np.uint8),
        queues=np.zeros((2, places), np.int32),
        queued=np.zeros((2, places), np.uint8),
        rings=np.zeros((2, 2), np.int64),
        core=np.zeros(5, np.int64),
        mark=np.zeros(places, np.int8),
        seen=np.empty(places, np.int32),
        lean=np.empty(places),
        hold=np.empty(places),
        stack=np.empty(places + arcs, np.int32),
        level=np.empty(places, np.int32),
        arc=np.empty(places, np.int64),
        capacity=np.empty(arcs),
    )


def waiting(work: Work, depth: int) -> int:
    """Places with swaps to be tried, NEAR only or at any depth."""
    return int(work.rings[:depth, COUNT].sum())


@compiled(inline="always")
def flag(place, depth, work):  # noqa: ANN001, ANN201
    """All swaps of this place's label are to be tried."""
    work.pending[place, :] = depth
    enqueue(place, depth - 1, work.queues, work.queued, work.rings)


@compiled(inline="always")
def enqueue(place, ring, queues, queued, rings):  # noqa: ANN001, ANN201
    """Put the place at the end of the ring unless it is there."""
    if queued[ring, place] == 0:
        queued[ring, place] = 1
        end = rings[ring, HEAD] + rings[ring, COUNT]
        queues[ring, end % queues.shape[1]] = place
        rings[ring, COUNT] += 1


@compiled()
def flag_all(places, depth, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places`."""
    for place in places:
        flag(place, depth, work)


@compiled()
def flag_around(places, depth, graph, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places` and its neighbours: what to do after its label was changed from outside."""
    for place in places:
        flag(place, depth, work)
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            flag(graph.neighbours[arc], depth, work)


@compiled()
def requeue(work):  # noqa: ANN001, ANN201
    """Fill the queues from the flags, in order of the rows."""
    for place in range(len(work.pending)):
        for label in range(work.pending.shape[1]):
            if work.pending[place, label] != NOT_PENDING:
                enqueue(place, work.pending[place, label] - 1, work.queues, work.queued, work.rings)


@compiled()
def sort_queues(work):  # noqa: ANN001, ANN201
    """Put the queues in the order of the rows, as `requeue` does: no place has a flag and is in no queue."""
    queues, queued, rings = work.queues, work.queued, work.rings
    places = np.empty(rings[0, COUNT] + rings[1, COUNT], np.int64)
    count = 0
    for ring in range(2):
        for step in range(rings[ring, COUNT]):
            place = queues[ring, (rings[ring, HEAD] + step) % queues.shape[1]]
            queued[ring, place] = 0
            places[count] = place
            count += 1
        rings[ring, HEAD] = rings[ring, COUNT] = 0
    for place in np.sort(places):
        for label in range(work.pending.shape[1]):
            if work.pending[place, label] != NOT_PENDING:
                enqueue(place, work.pending[place, label] - 1, queues, queued, rings)


@compiled(inline="always")
def tried(place, label, capped, work):  # noqa: ANN001, ANN201
    """Note that the swap with `label` was tried at `place`: it is done with, or still to be tried DEEP."""
    if capped == 0:
        work.pending[place, label] = NOT_PENDING
    elif work.pending[place, label] == NEAR:
        work.pending[place, label] = DEEP
        enqueue(place, DEEP - 1, work.queues, work.queued, work.rings)
