"""Settings are chosen on some scores and judged on those left out."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.evaluation.errors import EvaluationError

Scores = Mapping[str, float]  # by dataset, or by what is left out at once


@dataclass(frozen=True)
class Choice:
    """What was chosen without one dataset, or kind, and how it does there."""

    left_out: str
    candidate: str
    score: float
    default_score: float  # of the configured settings, there


@dataclass(frozen=True)
class Tuned:
    """What choosing is worth; errors are standard errors over what was left out."""

    choices: tuple[Choice, ...]
    hindsight: str  # the best candidate on everything
    hindsight_mean: float

    @property
    def left_out(self) -> tuple[float, float]:
        """Mean score of the choices where they were not made, and its error."""
        return mean_and_error([choice.score for choice in self.choices])

    @property
    def default(self) -> tuple[float, float]:
        """Mean score of the configured settings, and its error."""
        return mean_and_error([choice.default_score for choice in self.choices])

    @property
    def gain(self) -> tuple[float, float]:
        """Mean paired difference of chosen minus configured settings, and its error."""
        return mean_and_error([choice.score - choice.default_score for choice in self.choices])

    @property
    def helps(self) -> bool:
        """Whether choosing gains more than the error of the gain."""
        gain, error = self.gain
        return gain > error

    @property
    def chosen(self) -> dict[str, int]:
        """How often each candidate was chosen, the most frequent first."""
        return dict(Counter(choice.candidate for choice in self.choices).most_common())


def tuned(candidates: Mapping[str, Scores], default: Scores) -> Tuned:
    """Choose among candidates without each dataset in turn; of equal ones the first.

    All score the same datasets. Raises EvaluationError for fewer than two datasets or no candidate.
    """
    if not candidates:
        raise EvaluationError("there is nothing to choose from: give --values SETTING=VALUE,VALUE")
    names = list(default)
    if len(names) < 2:
        raise EvaluationError(f"{names[0] if names else 'nothing'} alone leaves nothing to choose on: give two or more")
    choices = []
    for left_out in names:
        candidate = best(candidates, [name for name in names if name != left_out])
        choices.append(Choice(left_out, candidate, candidates[candidate][left_out], default[left_out]))
    hindsight = best(candidates, names)
    return Tuned(tuple(choices), hindsight, mean_of(candidates[hindsight], names))


def best(candidates: Mapping[str, Scores], names: Sequence[str]) -> str:
    """The candidate with the highest mean over the names; of equal ones the first."""
    return max(candidates, key=lambda candidate: mean_of(candidates[candidate], names))


def mean_of(scores: Scores, names: Sequence[str]) -> float:
    """Mean over the names; sums exactly, so that equal scores tie."""
    return math.fsum(scores[name] for name in names) / len(names)


def grouped(scores: Scores, groups: Mapping[str, str]) -> dict[str, float]:
    """Mean score of each group's datasets; `groups` names the group of each."""
    members: dict[str, list[str]] = {}
    for name in scores:
        members.setdefault(groups[name], []).append(name)
    return {group: mean_of(scores, names) for group, names in members.items()}


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error, of at least two values."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))
