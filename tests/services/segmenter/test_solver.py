"""The solver that follows changes, and the dual bound."""

import itertools

import numpy as np
import pytest

from prior_sg.services.segmenter.core.energy.bound import lower_bound
from prior_sg.services.segmenter.core.energy.mrf import Field, energy
from prior_sg.services.segmenter.core.energy.solver import Settings, Solver, changed_rows, minimise
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from tests.help.fields import all_energies, best_swap, random_field, random_tree


def is_swap_optimal(field, labels):
    pairs = itertools.combinations(range(field.unary.shape[1]), 2)
    return all(energy(field, best_swap(field, labels, pair)) >= energy(field, labels) - 1e-6 for pair in pairs)


class Changes:
    """A field that changes in every way there is; tells which rows are dirty and where each row comes from."""

    def __init__(self, seed, places=60, labels=5):
        self.rng = np.random.default_rng(seed)
        self.field = random_field(seed, places, labels, degree=5)

    def costs(self):
        rows = self.rng.integers(len(self.field.unary), size=4)
        unary = self.field.unary.copy()
        unary[rows] = self.rng.uniform(0, 4, (len(rows), unary.shape[1]))
        self.field = self.field._replace(unary=unary)
        return rows, None

    def weights(self):
        chosen = self.rng.integers(len(self.field.edges), size=4)
        weights = self.field.weights.copy()
        weights[chosen] = self.rng.uniform(0, 1, len(chosen))
        self.field = self.field._replace(weights=weights)
        return np.unique(self.field.edges[chosen]), None

    def edges(self):
        kept = self.rng.random(len(self.field.edges)) < 0.95
        dirty = self.field.edges[~kept]
        self.field = self.field._replace(edges=self.field.edges[kept], weights=self.field.weights[kept])
        return np.unique(dirty), None

    def places(self):
        """Two places go; three come, somewhere among the rows."""
        field, count = self.field, len(self.field.unary)
        gone = np.zeros(count, bool)
        gone[self.rng.choice(count, 2, replace=False)] = True
        previous = np.insert(np.flatnonzero(~gone), self.rng.integers(count - 2, size=3), -1)
        new = np.flatnonzero(previous < 0)
        row_now = np.full(count, -1)
        row_now[previous[previous >= 0]] = np.flatnonzero(previous >= 0)
        edges = row_now[field.edges]
        kept = (edges >= 0).all(axis=1)
        added = np.stack((np.repeat(new, 3), self.rng.choice(np.flatnonzero(previous >= 0), 9)), axis=1)
        unary = self.rng.uniform(0, 4, (len(previous), field.unary.shape[1]))
        unary[previous >= 0] = field.unary[previous[previous >= 0]]
        weights = np.concatenate((field.weights[kept], self.rng.uniform(0, 1, len(added))))
        self.field = Field(unary, np.concatenate((edges[kept], added)), weights, field.pairwise)
        orphans = edges[~kept].reshape(-1)
        return np.unique(np.concatenate((new, added.reshape(-1), orphans[orphans >= 0]))), previous

    def pairwise(self):
        self.field = self.field._replace(pairwise=random_field(self.rng.integers(1000), 9, 5).pairwise)
        return np.zeros(0, np.int64), None


@pytest.mark.parametrize("settings", [Settings(), Settings(near=3), Settings(near=5, round_trips=0)])
@pytest.mark.parametrize("told", [True, False])
def test_a_changing_field_is_followed_to_its_swap_optimum(settings, told):
    """Whatever changes, said by the caller or found by the solver: energy never rises, and idle time finishes."""
    changes, solver = Changes(seed=3), Solver(settings)
    labels = solver.update(changes.field, changes.field.unary.argmin(axis=1))
    labels = solver.drain()
    for kind in ["costs", "weights", "edges", "places", "pairwise"] * 6:
        dirty, previous = getattr(changes, kind)()
        start = labels if previous is None else np.where(previous >= 0, labels[previous], -1)
        begun = np.where(start >= 0, start, changes.field.unary.argmin(axis=1))
        labels = solver.update(changes.field, start, dirty=dirty if told else None, previous=previous)
        after_update = energy(changes.field, labels)
        if (start >= 0).all():
            assert after_update <= energy(changes.field, begun) + 1e-9
        labels = solver.drain()
        assert energy(changes.field, labels) <= after_update + 1e-9
        assert solver.pending == 0
        assert is_swap_optimal(changes.field, labels), kind


@pytest.mark.parametrize("seed", range(20))
def test_flags_alone_find_every_swap(seed):
    """Without message passing, which would hide what the flags miss; small and large cuts, tight and loose fields."""
    alone = Settings(
        round_trips=0, idle_round_trips=0, near=[1, 3, 8, 150][seed % 4], compiled_up_to=[2000, 0][seed % 2]
    )
    changes, solver = Changes(seed, places=40, labels=3 + seed % 3), Solver(alone)
    changes.field = changes.field._replace(weights=changes.field.weights * [0.3, 1.0, 2.0][seed % 3])
    solver.take(changes.field, changes.field.unary.argmin(axis=1))
    labels = solver.drain()
    for kind in ["costs", "weights", "edges", "places"] * 3:
        dirty, previous = getattr(changes, kind)()
        start = labels if previous is None else np.where(previous >= 0, labels[previous], -1)
        solver.update(changes.field, start, dirty=dirty, previous=previous)
        labels = solver.drain()
        assert is_swap_optimal(changes.field, labels), kind


@pytest.mark.parametrize("kind", ["costs", "weights", "edges", "places"])
def test_changed_rows_are_those_that_were_changed(kind):
    changes = Changes(seed=5)
    before = changes.field
    dirty, previous = getattr(changes, kind)()
    graphs = [arcs_of(len(field.unary), field.edges, field.weights) for field in (before, changes.field)]
    origin = np.arange(len(before.unary)) if previous is None else previous
    found = changed_rows(graphs[0], before.unary, graphs[1], changes.field.unary, origin)
    assert sorted(found) == sorted(set(dirty.tolist()))


def test_a_spent_budget_leaves_valid_labels_that_idle_time_completes():
    field = random_field(1, places=200, labels=6, degree=6)
    solver, looks = Solver(Settings(chunk=20)), [0]

    def expired():
        looks[0] += 1
        return looks[0] > 2

    start = field.unary.argmin(axis=1)
    solver.take(field, start)
    labels = solver.drain(expired)
    assert solver.pending > 0
    assert ((labels >= 0) & (labels < 6)).all()
    energies = [energy(field, start), energy(field, labels)]
    while solver.pending:
        looks[0] = 0
        energies.append(energy(field, solver.drain(expired)))
    assert (np.diff(energies) <= 1e-9).all()
    assert energies[-1] < energies[1]
    assert is_swap_optimal(field, solver.drain())


def test_nothing_changed_changes_nothing_and_the_callers_arrays_stay():
    field = random_field(2, places=100, labels=4)
    solver = Solver()
    start = field.unary.argmin(axis=1)
    kept = start.copy(), field.unary.copy()
    solver.take(field, start)
    labels = solver.drain()
    again = solver.update(field, labels, dirty=np.zeros(0, np.int64))
    assert np.array_equal(again, labels)
    assert np.array_equal(start, kept[0])
    assert np.array_equal(field.unary, kept[1])


@pytest.mark.parametrize("near", [1, 2, 150])
def test_a_place_that_is_forced_over_takes_its_neighbours_along(near):
    """One end of a row turns for itself; the others then follow one by one, though only the first is reported."""
    count = 8
    unary = np.tile([0.0, 0.5], (count, 1))
    unary[0] = [0.0, 3.0]
    edges = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    field = Field(unary, edges, np.full(count - 1, 1.0), 1.0 - np.eye(2))
    solver = Solver(Settings(round_trips=0, near=near))
    solver.take(field, np.zeros(count, int))
    labels = solver.drain()
    assert not labels.any()
    field = field._replace(unary=unary.copy())
    field.unary[0] = [9.0, 0.0]
    field.unary[1:] = [0.0, 0.1]
    solver.update(field, labels, dirty=np.arange(count))
    assert solver.drain().all()
    unary = field.unary.copy()
    unary[0] = [0.0, 9.0]
    field = field._replace(unary=unary)
    solver.update(field, np.ones(count, int), dirty=np.array([0]))
    assert not solver.drain().any()


def test_labels_from_elsewhere_are_settled_too():
    field = random_field(6, places=100, labels=4, degree=5)
    solver = Solver(Settings(round_trips=0))
    solver.take(field, field.unary.argmin(axis=1))
    labels = solver.drain()
    labels[20:40] = 3
    solver.update(field, labels, dirty=np.zeros(0, np.int64))
    assert is_swap_optimal(field, solver.drain())


def test_another_number_of_labels_starts_afresh():
    solver = Solver()
    solver.update(random_field(0, 20, 3), np.zeros(20, int))
    field = random_field(0, 25, 5)
    solver.update(field, np.full(25, -1))
    assert is_swap_optimal(field, solver.drain())


def test_another_number_of_places_needs_their_origin():
    solver = Solver()
    solver.update(random_field(0, 20, 3), np.zeros(20, int))
    with pytest.raises(ValueError, match="previous"):
        solver.update(random_field(0, 21, 3), np.zeros(21, int))


def test_a_far_change_costs_nothing_here():
    """Only labels near the change move, and the work does not depend on the rest of the field."""
    small, big = random_field(1, places=50, labels=4), random_field(2, places=400, labels=4)
    joined = Field(
        np.concatenate((small.unary, big.unary)),
        np.concatenate((small.edges, big.edges + 50)),
        np.concatenate((small.weights, big.weights)),
        small.pairwise,
    )
    solver = Solver()
    solver.take(joined, joined.unary.argmin(axis=1))
    labels = solver.drain()
    changed = joined._replace(unary=joined.unary.copy())
    changed.unary[:10, 2] -= 3.0
    after = solver.update(changed, labels, dirty=np.arange(10))
    assert (after != labels)[:50].any()
    assert np.array_equal(after[50:], labels[50:])


@pytest.mark.parametrize("seed", range(30))
def test_the_dual_bound_is_one(seed):
    field = random_field(seed, places=7, labels=3, degree=4)
    best, bound = all_energies(field)[1].min(), lower_bound(field)
    assert bound <= best * (1 + 1e-9)
    assert bound >= 0.9 * best


@pytest.mark.parametrize("seed", range(8))
def test_on_trees_the_bound_and_the_labels_are_exact(seed):
    field = random_tree(seed, places=7, labels=3)
    energies = all_energies(field)[1]
    assert lower_bound(field) == pytest.approx(energies.min(), rel=1e-6)
    assert energy(field, minimise(field, field.unary.argmin(axis=1))) == pytest.approx(energies.min())
