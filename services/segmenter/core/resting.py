"""Labels of a map that rests, found from all that is known alone, a slice a tick (pure).

That takes a second on a large map. So it is done beside the labels in force, on a copy of what it changes: questions
are answered from these meanwhile, and what is news is taken in after one slice. News makes the work worthless, so it is
given up and begins anew at the next rest. Undisturbed, it ends in what it gives at once.
"""

from collections.abc import Iterator
from dataclasses import fields, replace

from prior_sg.services.segmenter.core import inference
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.map.table import Places
from prior_sg.services.segmenter.core.slices import Parts
from prior_sg.services.segmenter.core.state import State

SLICE_VISITS = 300_000  # of a tick, 0.1 s or so; a small map needs one
COPYING_VISITS = 2  # what copying takes for a place
TELLING_VISITS = 5  # and beliefs and regions that follow from labels
DONE = object()


def go_on(state: State, cfg: Config) -> bool:
    """One slice more; whether the labels are found, and in force."""
    labelling = state.labelling
    if labelling.under_way is None:
        labelling.under_way = sliced(_beside(state, cfg), SLICE_VISITS)
    return next(labelling.under_way, DONE) is DONE


def sliced(parts: Parts[None], most_visits: int) -> Iterator[None]:
    """The parts in slices of at most so many visits, but for a part that takes more alone; yields between two."""
    visits = 0
    for some in parts:
        if visits and visits + some > most_visits:
            yield
            visits = 0
        visits += some


def _beside(state: State, cfg: Config) -> Parts[None]:
    """Find labels on a copy, and put them in force at the end."""
    places = Places(**{column.name: getattr(state.map.places, column.name).copy() for column in fields(Places)})
    copy = replace(
        state,
        map=replace(state.map, places=places),
        labelling=replace(state.labelling, under_way=None),
        objects=replace(state.objects),
        regions=replace(state.regions, disturbed=set(state.regions.disturbed)),
    )
    yield COPYING_VISITS * len(places.labels)
    yield from inference.label_anew(copy, cfg)
    yield TELLING_VISITS * len(places.labels)
    state.map.places, state.objects.view = places, copy.objects.view
    state.regions.disturbed = copy.regions.disturbed
    state.labelling = replace(copy.labelling, still_ticks=state.labelling.still_ticks)
