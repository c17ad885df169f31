"""Why a place carries its label: the experts' votes and the neighbours' pull, from a running system or from a log."""

import math
from collections import defaultdict
from pathlib import Path

from rich.box import SIMPLE

from prior_sg.deploy.inspecting import replay
from prior_sg.deploy.terminal import Table, Terminal
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest
from prior_sg.schemas.topics import POSTERIOR
from prior_sg.services.runtime.record import LogError

ROWS = 6  # labels shown, the most probable first


def from_log(path: Path, robot: str, place_id: int) -> PosteriorReply:
    """The answer of the log's last segmenter of this robot, at the end of the log. Raises LogError."""
    log = replay.open_log(path, "segmenter")
    lives = [life for life in log.lives if life.started.robot == robot]
    if not lives:
        robots = sorted({life.started.robot for life in log.lives})
        raise LogError(f"{path} holds no segmenter of {robot}; name one of {', '.join(robots)} with --robot")
    with replay.final(log, lives[-1]) as segmenter:
        reply: PosteriorReply = segmenter.answer(POSTERIOR, PosteriorRequest(robot=robot, place_id=place_id))
        return reply


def show(reply: PosteriorReply, console: Terminal) -> None:
    """A sentence, the labels with what speaks for each, the experts, and the neighbours."""
    console.width = max(console.width, 100)  # lines that wrap are better than cells cut short
    seen = f"seen in {reply.frames} keyframes with trust {reply.trust:.1f}" if reply.frames else "never seen"
    position = ", ".join(f"{value:.2f}" for value in reply.position_m)
    chance = reply.posterior[reply.labels.index(reply.label)]
    console.print(
        f"place {reply.place_id} at ({position}) m is {reply.label} with probability {chance:.2f}; "
        f"{seen}; unknown {reply.unknown:.2f}{', predicted' if reply.predicted else ''}; region {reply.region}"
    )
    console.print(reason(reply))
    console.print(label_table(reply))
    console.print(expert_table(reply))
    console.print(neighbour_table(reply))


def costs_by_source(reply: PosteriorReply) -> dict[str, list[float]]:
    """Cost of each label by who asks for it: the experts by name, and the neighbours. They sum to the energy."""
    costs = {vote.expert: [-vote.weight * value for value in vote.log_probabilities] for vote in reply.votes}
    return costs | {"neighbours": list(reply.pull)}


def gains(reply: PosteriorReply) -> tuple[str, dict[str, float]]:
    """The runner-up, and by how much each source prefers the label to it; "" and nothing where there is no other."""
    own = reply.labels.index(reply.label)
    others = [column for column in range(len(reply.labels)) if column != own]
    if not others:
        return "", {}
    rival = max(others, key=lambda column: reply.posterior[column])
    return reply.labels[rival], {source: costs[rival] - costs[own] for source, costs in costs_by_source(reply).items()}


def reason(reply: PosteriorReply) -> str:
    """What sets the label apart from the runner-up, the strongest reason first."""
    rival, by_source = gains(reply)
    if not rival:
        return f"the prior knows no region but {reply.label}"
    ordered = sorted(by_source.items(), key=lambda pair: -abs(pair[1]))
    parts = ", ".join(f"{source} {gain:+.2f}" for source, gain in ordered)
    return f"{reply.label} before {rival} by {sum(by_source.values()):.2f}: {parts}"


def label_table(reply: PosteriorReply) -> Table:
    """The most probable labels; each cell is a cost, less is better."""
    sources = costs_by_source(reply)
    table = Table("label", "probability", *sources, "energy", box=SIMPLE, title="cost of each label (less is better)")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in sorted(range(len(reply.labels)), key=lambda row: -reply.posterior[row])[:ROWS]:
        costs = [column[row] for column in sources.values()]
        cells = (f"{reply.posterior[row]:.3f}", *(f"{cost:.2f}" for cost in costs), f"{sum(costs):.2f}")
        table.add_row(reply.labels[row], *cells)
    if len(reply.labels) > ROWS:
        table.caption = f"and {len(reply.labels) - ROWS} less probable labels"
    return table


def expert_table(reply: PosteriorReply) -> Table:
    """Each expert's confidence, weight and favourite."""
    table = Table("expert", "confidence", "weight", "favours", "at", box=SIMPLE, title="experts")
    for column in (1, 2, 4):
        table.columns[column].justify = "right"
    for vote in reply.votes:
        best = max(range(len(reply.labels)), key=lambda row: vote.log_probabilities[row])
        favourite = (reply.labels[best], f"{math.exp(vote.log_probabilities[best]):.2f}")
        if vote.confidence == 0:
            favourite = ("says nothing", "")
        elif max(vote.log_probabilities) - min(vote.log_probabilities) < 1e-6:
            favourite = ("all alike", favourite[1])
        table.add_row(vote.expert, f"{vote.confidence:.2f}", f"{vote.weight:.2f}", *favourite)
    return table


def neighbour_table(reply: PosteriorReply) -> Table:
    """The neighbours by label."""
    places: dict[str, list[int]] = defaultdict(list)
    weights: dict[str, float] = defaultdict(float)
    for near in reply.neighbours:
        places[near.label].append(near.place_id)
        weights[near.label] += near.weight
    table = Table("neighbours", "weight", "places", box=SIMPLE)
    table.columns[1].justify = "right"
    for label in sorted(weights, key=lambda label: -weights[label]):
        table.add_row(label, f"{weights[label]:.2f}", " ".join(map(str, sorted(places[label]))))
    return table
