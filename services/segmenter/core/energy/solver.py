"""A labelling that follows a changing field at a cost that follows the change (pure).

    solver = Solver()
    labels = solver.update(field, labels, dirty=rows, expired=clock_says_so)   # at every change of the field
    labels = solver.drain(expired=clock_says_so)                               # when idle, until `solver.pending` is 0

The caller says which places changed (`dirty`: those with another unary cost, other edges, other weights or a
neighbour that is gone; new places too), or leaves it to the solver, which then compares the field with the last one.
`ties` are the field's edges with their weights as arcs, where the caller has them; if only weights differ from those of
the last field and its arrays are the same, nothing is laid out anew.
Row numbers may change between updates: `previous` says which row each place had (-1: a new place), as
`map.received.Step.previous` does. A place without a label yet has label -1; labels may be others than the solver's
last. The solver keeps references to the field's arrays, not copies: where they are changed in place, `dirty` must be
given.

The change is solved as a local problem with fixed surroundings, which grows while labels at its border change:

1. Message passing on the changed places and those within `reach` steps proposes labels. Each connected set of places
   that the proposal labels otherwise is taken if it lowers the energy by itself.
2. The alpha-beta-swaps that the change can have made profitable are tried, then those that their own changes can have.

Both stop when `expired()` says so; the labels are valid at any time and the energy of the field in hand never rises.
Once `pending` is 0, no alpha-beta-swap on the whole field lowers the energy (see `swap_moves`), as after a fresh solve.
Idle time also goes into longer message passing over the whole field, at the start and whenever much has changed.
"""

from collections.abc import Callable

import msgspec
import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy import swap_moves, swap_work
from prior_sg.services.segmenter.core.energy.maxflow import CUTS, MinCut, min_cut_in_use
from prior_sg.services.segmenter.core.energy.mrf import Field, least_gain
from prior_sg.services.segmenter.core.energy.trws import empty_messages, lay_down, run_pass, take_up
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_of, ball, no_arcs
from prior_sg.services.segmenter.core.slices import Parts, at_once

Expired = Callable[[], bool]


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """How hard to try. Chosen on random fields like place graphs; see docs/performance.md."""

    min_cut: MinCut = "auto"  # library for large cuts; auto is PyMaxflow (GPL) where it is installed, else SciPy
    compiled_up_to: int = 2_000  # free places in a cut that compiled code solves itself
    round_trips: int = 6  # of message passing
    idle_round_trips: int = 20  # of message passing over the whole field when all else is done
    worn_share: float = 0.2  # changed places, of all, after which that is due again
    reach: int = 5  # steps from a changed place within which message passing may propose labels
    near: int = 150  # places of a swap's local problem
    chunk: int = 8_000  # visits of places between two looks at the budget, 2 ms or so

    def __post_init__(self) -> None:
        counts = (self.round_trips, self.idle_round_trips, self.reach, self.compiled_up_to, self.worn_share)
        if min(counts) < 0 or min(self.near, self.chunk) < 1:
            raise ValueError("a count, a reach or a share is negative, or near or chunk less than 1")


def never() -> bool:
    """No budget."""
    return False


def _same_edges(one: Field, other: Field) -> bool:
    return one.edges is other.edges and one.weights is other.weights


class Solver:
    """Labels of the last field, and what is still to be tried on it."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self._cut = CUTS[min_cut_in_use(self.settings.min_cut)]
        self.labels = np.zeros(0, np.int64)
        self._field: Field | None = None
        self._graph: Arcs = no_arcs()
        self._unary = np.zeros((0, 0))
        self._pairwise = np.zeros((0, 0))
        self._work = swap_work.empty_work(0, 0, 0)
        self._least_gain = 0.0
        self._changes = 0  # places reported dirty since message passing last went over the whole field
        self._unproposed = np.zeros(0, np.int64)  # rows around which message passing has yet to propose

    @property
    def pending(self) -> int:
        """Places at which a swap is still to be tried or around which labels are to be proposed; 0 when settled."""
        return swap_work.waiting(self._work, swap_work.DEEP) + len(self._unproposed) + self._worn

    def update(
        self,
        field: Field,
        labels: np.ndarray,
        expired: Expired = never,
        *,
        dirty: np.ndarray | None = None,
        previous: np.ndarray | None = None,
        ties: Arcs | None = None,
    ) -> np.ndarray:
        """Labels (place,) for `field`, starting from `labels`, by work near the change only; see the module."""
        self.take(field, labels, dirty=dirty, previous=previous, ties=ties)
        at_once(self.updating(expired))
        return self.labels.copy()

    def drain(self, expired: Expired = never) -> np.ndarray:
        """Go on with what is pending, on the whole field; the labels (place,) so far."""
        at_once(self.draining(expired))
        return self.labels.copy()

    def updating(self, expired: Expired = never) -> Parts[None]:
        """What `update` does after `take`, part by part."""
        yield from self._propose_near(expired)
        yield from self._swap(swap_work.NEAR, expired)

    def draining(self, expired: Expired = never) -> Parts[None]:
        """What `drain` does, part by part."""
        yield from self._propose_near(expired)
        yield from self._swap(swap_work.DEEP, expired)
        if self._worn and not expired():
            trips = yield from self._propose(np.arange(len(self.labels)), self.settings.idle_round_trips, expired)
            if trips or not self.settings.idle_round_trips:
                self._changes = 0
            yield from self._swap(swap_work.DEEP, expired)

    @property
    def _worn(self) -> bool:
        """Whether so much changed since message passing went over the whole field that it may well find better."""
        return self._changes > self.settings.worn_share * len(self.labels)

    def _swap(self, depth: int, expired: Expired) -> Parts[None]:
        settings, arrays = self.settings, (self._graph, self._unary, self._pairwise, self.labels, self._work)
        limits = swap_moves.Limits(depth, settings.near, settings.compiled_up_to, settings.chunk, self._least_gain)
        while swap_work.waiting(self._work, depth) and not expired():
            yield settings.chunk
            swap_moves.run_swaps(*arrays, self._cut, limits)

    def take(
        self,
        field: Field,
        labels: np.ndarray,
        *,
        dirty: np.ndarray | None = None,
        previous: np.ndarray | None = None,
        ties: Arcs | None = None,
    ) -> None:
        """Only note the change; `drain` does the work."""
        before, count = self._field, len(field.unary)
        if before is not None and before.unary.shape[1] != field.unary.shape[1]:
            before = None
        if before is not None and previous is None and len(before.unary) != count:
            raise ValueError("the number of places changed: `previous` must say which row each place had")
        same_rows = before is not None and previous is None
        same_edges = before is not None and same_rows and _same_edges(before, field)
        given_arcs = self._graph if same_edges else ties
        graph = arcs_of(count, field.edges, field.weights) if given_arcs is None else given_arcs
        unary = np.ascontiguousarray(field.unary, dtype=np.float64)
        pairwise = np.ascontiguousarray(field.pairwise, dtype=np.float64)
        everything = before is None or not np.array_equal(self._pairwise, pairwise)
        origin = np.arange(count) if previous is None else previous
        if everything:
            dirty = np.arange(count)
        elif dirty is None:
            dirty = changed_rows(self._graph, self._unary, graph, unary, origin)
        elif dirty.dtype == np.bool_:
            dirty = np.flatnonzero(dirty)
        if not same_edges:
            if same_rows and graph.neighbours is self._graph.neighbours:
                swap_work.sort_queues(self._work)
            else:
                self._carry(before, origin, field, graph)
        given, found = np.asarray(labels), self.labels
        self._graph, self._unary, self._pairwise, self._field = graph, unary, pairwise, field
        self.labels = np.array(given, dtype=np.int64)
        label_new(self.labels, graph, unary, pairwise)
        if not everything:
            known = np.flatnonzero(origin >= 0)
            others = np.flatnonzero(given != found) if same_rows else known[given[known] != found[origin[known]]]
            swap_work.flag_around(others, swap_work.NEAR, graph, self._work)
        swap_work.flag_all(dirty, swap_work.DEEP if before is None else swap_work.NEAR, self._work)
        self._unproposed = np.union1d(self._unproposed, dirty).astype(np.int64)
        self._changes += len(dirty)
        self._least_gain = max(0.0 if before is None else self._least_gain, least_gain(unary[dirty]))

    def _carry(self, before: Field | None, origin: np.ndarray, field: Field, graph: Arcs) -> None:
        """Scratch space for new rows and arcs, with what was pending before on the rows where it is now."""
        old_work, old_unproposed = self._work, self._unproposed
        arcs, (count, label_count) = len(graph.neighbours), field.unary.shape
        self._work = swap_work.empty_work(count, label_count, arcs)
        self._messages = empty_messages(count, arcs, field.pairwise, np.float32)
        self._unproposed = np.zeros(0, np.int64)
        if before is None:
            return
        known = np.flatnonzero(origin >= 0)
        self._work.pending[known] = old_work.pending[origin[known]]
        swap_work.requeue(self._work)
        waits = np.zeros(len(old_work.mark), np.bool_)
        waits[old_unproposed] = True
        self._unproposed = known[waits[origin[known]]]

    def _propose(self, rows: np.ndarray, round_trips: int, expired: Expired) -> Parts[int]:
        """Message passing on `rows` (ascending) takes what lowers the energy; how many trips there was budget for.

        A budget that ends it early is not made up for: the swaps go first then, lest nothing ever gets done.
        """
        graph, messages, labels, trips = self._graph, self._messages, self.labels, 0
        scene = (graph, self._unary, self._pairwise)
        messages.pairwise[: len(self._pairwise), : len(self._pairwise)] = self._pairwise
        take_up(rows, graph, self._unary, labels, messages)
        before = labels[rows]
        while trips < round_trips and not expired():
            yield len(rows)
            round_trip(rows, labels, *scene, messages, self._work.mark, self._least_gain)
            trips += 1
        lay_down(rows, messages)
        swap_work.flag_around(rows[labels[rows] != before], swap_work.NEAR, graph, self._work)
        return trips

    def _propose_near(self, expired: Expired) -> Parts[None]:
        """Proposals around the places that changed."""
        if len(self._unproposed):
            rows = ball(
                self._unproposed, self.settings.reach, self._graph.starts, self._graph.neighbours, self._messages.inside
            )
            trips = yield from self._propose(rows, self.settings.round_trips, expired)
            if trips or not self.settings.round_trips:
                self._unproposed = self._unproposed[:0]


def minimise(field: Field, labels: np.ndarray, settings: Settings | None = None) -> np.ndarray:
    """Labels (place,) from which no alpha-beta-swap lowers the energy; it is at most that of `labels`.

    Message passing proposes a labelling for the whole field, which replaces `labels` wherever that lowers the energy;
    then swaps run until none is left that gains. (An idle `Solver` goes on from there.)
    """
    solver = Solver(msgspec.structs.replace(settings or Settings(), worn_share=np.inf))
    solver.take(field, labels)
    return solver.drain()


@compiled()
def round_trip(rows, labels, graph, unary, pairwise, messages, mark, least_gain):  # noqa: PLR0917, ANN001, ANN201
    """Pass messages there and back over `rows`; fuse the labels of both passes into `labels`."""
    for forward in (True, False):
        run_pass(rows, forward, graph, messages)
        fuse(rows, messages.proposed, labels, graph, unary, pairwise, mark, least_gain)


@compiled()
def changed_rows(graph_before, unary_before, graph, unary, origin):  # noqa: ANN001, ANN201
    """Rows (dirty,) of `graph` that are new, or whose costs, neighbours or weights differ; origin[row] = row before."""
    places, labels = unary.shape
    row_now = np.full(len(unary_before), -1, np.int64)
    for row in range(places):
        if origin[row] >= 0:
            row_now[origin[row]] = row
    dirty = np.empty(places, np.int64)
    count = 0
    for row in range(places):
        old = origin[row]
        same = old >= 0
        if same:
            for label in range(labels):
                same &= unary[row, label] == unary_before[old, label]
        if same:
            first, last = graph_before.starts[old], graph_before.starts[old + 1]
            same = last - first == graph.starts[row + 1] - graph.starts[row]
            for arc in range(first, last):
                same = same and _has_arc(graph, row, row_now[graph_before.neighbours[arc]], graph_before.weights[arc])
        if not same:
            dirty[count] = row
            count += 1
    return dirty[:count].copy()


@compiled()
def _has_arc(graph, row, neighbour, weight):  # noqa: ANN001, ANN202
    for arc in range(graph.starts[row], graph.starts[row + 1]):
        if graph.neighbours[arc] == neighbour and graph.weights[arc] == weight:
            return True
    return False


@compiled()
def label_new(labels, graph, unary, pairwise):  # noqa: ANN001, ANN201
    """Give each place without a label the cheapest one, its labelled neighbours considered."""
    costs = np.empty(unary.shape[1])
    for place in range(len(labels)):
        if labels[place] >= 0:
            continue
        costs[:] = unary[place]
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            label = labels[graph.neighbours[arc]]
            if label >= 0:
                costs += graph.weights[arc] * pairwise[label]
        labels[place] = np.argmin(costs)


@compiled()
def fuse(rows, proposed, labels, graph, unary, pairwise, mark, least_gain):  # noqa: PLR0917, ANN001, ANN201
    """Take each connected set of places that `proposed` labels otherwise if that alone gains more than `least_gain`.

    Sets that do not touch each other change the energy independently, so each is decided by itself. `mark` is scratch,
    all zero before and after.
    """
    starts, neighbours, weights = graph.starts, graph.neighbours, graph.weights
    costs = np.empty(unary.shape[1])
    members, former = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    for row in rows:
        mark[row] = 1 if proposed[row] != labels[row] else 0
    for row in rows:
        if mark[row] == 0:
            continue
        members[0], count, index, gain = row, 1, 0, 0.0
        mark[row] = 0
        while index < count:
            place = members[index]
            for arc in range(starts[place], starts[place + 1]):
                neighbour = neighbours[arc]
                if mark[neighbour] == 1:
                    mark[neighbour] = 0
                    members[count] = neighbour
                    count += 1
            swap_moves.conditional(place, starts, neighbours, weights, unary, pairwise, labels, costs)
            gain += costs[labels[place]] - costs[proposed[place]]
            former[index] = labels[place]
            labels[place] = proposed[place]
            index += 1
        if gain <= least_gain:
            for index in range(count):
                labels[members[index]] = former[index]
