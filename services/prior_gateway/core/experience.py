"""What maps of robots have shown is kept, and revises the prior of their task: by counting, or by a model (pure)."""

from collections.abc import Iterator
from hashlib import blake2b
from typing import Any

import msgspec

from prior_sg.schemas.codec import copied
from prior_sg.schemas.priors import Keep, Prior, PriorEvidence, PriorRevision
from prior_sg.services.prior_gateway.core import compose, learning, revising, turns
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.estimation import Estimate
from prior_sg.services.prior_gateway.core.making import Told, begin, give_up, provenance_of, start, to_keep
from prior_sg.services.prior_gateway.core.state import (
    Making,
    State,
    asked_about,
    asked_for,
    prior_in_force,
    put,
    task_of,
    too_dear,
)


def learn(state: State, seen: PriorEvidence, cfg: Config) -> Iterator[Told]:
    """Keep what a map has shown; only where the settings allow it, that alone revises the prior."""
    asked = asked_about(seen)
    known = state.evidence.setdefault(asked, {})
    put(known, (seen.robot, seen.epoch), copied(seen), cfg.learning.kept_maps)
    yield Keep(evidence=seen)
    digest = state.answers.get(asked)
    if not cfg.learning.automatic or digest is None or len(known) < cfg.learning.least_maps:
        return
    current = state.priors[digest]
    root, limits = state.roots.get(asked, current), cfg.learning
    seen_so_far = learning.estimate(root, known.values(), limits)
    after = learning.revised(root, seen_so_far.totals, limits.strength, current.provenance, seen_so_far.looks)
    if learning.largest_change(current, after) >= limits.least_change:
        environment, task, regions = asked
        by_model = limits.by_model and cfg.provider != "library" and not too_dear(state, environment, cfg)
        yield from begin_revision(
            state, PriorRevision(environment=environment, task=task, regions=list(regions), by_model=by_model)
        )


def begin_revision(state: State, revision: PriorRevision) -> Iterator[Told]:
    """Look up what is to be revised, as for a task."""
    asked = asked_for(revision)
    name = f"revision/{state.answers.get(asked, '')}/{asked}/{revision.by_model}"
    question = blake2b(name.encode(), digest_size=16).hexdigest()
    yield from begin(state, Making(task_of(*asked), question, revision))


def revise(state: State, making: Making, cfg: Config) -> Iterator[Told]:
    """Count, or ask the model about the largest disagreements."""
    assert making.revision is not None
    try:
        root, current = prior_in_force(state, making, cfg)
    except compose.NoPrior:
        yield from give_up(state, making, "there is no prior to revise", cfg)
        return
    known = state.evidence.get(asked_for(making.task), {})
    seen = learning.estimate(root, known.values(), cfg.learning)
    if not seen.totals.maps:
        yield from give_up(state, making, "nothing has been observed", cfg)
        return
    if making.revision.by_model:
        yield from _ask_about(state, making, (root, current), seen, cfg)
        return
    robots = len({one.robot for one in known.values()})
    note = f"revised by counting in {counted(len(known), 'map')} of {counted(robots, 'robot')}"
    before = root.provenance
    made = provenance_of(
        state,
        making,
        cfg,
        note=f"{note}, strength {cfg.learning.strength:g}",
        source=before.source,
        detail=before.detail,
        **_parents(state, making, root, current),
    )
    yield to_keep(making, learning.revised(root, seen.totals, cfg.learning.strength, made, seen.looks), state)


def _ask_about(
    state: State, making: Making, priors: tuple[Prior, Prior], seen: Estimate, cfg: Config
) -> Iterator[Told]:
    """Show the model what was expected and what was observed, if it may still be asked today. `priors` are that before
    any revision and the one in force."""
    root, current = priors
    lines, form = learning.told(learning.disagreements(current, seen.totals, cfg.learning.told))
    strange = ("", []) if making.task.regions else learning.unexplained(root, seen)
    if cfg.provider == "library" or not (form or strange[0]):
        yield from give_up(state, making, "there is no model, or nothing to disagree about", cfg)
        return
    if dear := too_dear(state, making.task.environment, cfg):
        yield from give_up(state, making, dear, cfg)
        return
    talk = turns.Talk(state.prompts, cfg.synthesis)
    yield from start(state, making, revising.revision(current, lines, form, strange, talk), 0, cfg)


def conclude_revision(state: State, making: Making, found: revising.Revision, cfg: Config) -> Iterator[Told]:
    """What the model has revised, as a statement that observations outvote as they do any prior's; regions that it
    added belong to the prior before any revision, too, so that maps revise them from now on."""
    root, current = prior_in_force(state, making, cfg)
    note = "revised by the model from what was observed"
    if found.additions:
        note += ", with " + " and ".join(
            f"{one.name} as a part of {one.splits}" if one.splits else f"{one.name} as a new region"
            for one in found.additions
        )

    def with_name(name: str) -> list[str]:
        return compose.phrases_of(name, cfg)

    made = provenance_of(state, making, cfg, **_parents(state, making, root, current))
    made = msgspec.structs.replace(made, note="; ".join(filter(None, (note, found.remark))))
    stated = revising.applied(root, found, with_name, made)
    for addition in found.additions:
        root = revising.extended(root, addition, with_name)
    asked = asked_for(making.task)
    state.roots[asked] = root
    seen = learning.estimate(stated, state.evidence.get(asked, {}).values(), cfg.learning)
    yield to_keep(making, learning.revised(stated, seen.totals, cfg.learning.strength, made, seen.looks), state)


def _parents(state: State, making: Making, root: Prior, current: Prior) -> dict[str, Any]:
    """Where a revised prior comes from, for its provenance."""
    robots = {seen.robot for seen in state.evidence.get(asked_for(making.task), {}).values()}
    return {"parent_digest": current.digest(), "root_digest": root.digest(), "contributors": sorted(robots)}


def counted(number: int, what: str) -> str:
    """Such as "1 map" or "3 maps"."""
    return f"{number} {what}{'s' if number != 1 else ''}"
