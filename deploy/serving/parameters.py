"""What requests have in common: parameters, their bounds, and the faults that any of them may have."""

from typing import Annotated, Any

from litestar.datastructures import State
from litestar.openapi.datastructures import ResponseSpec
from litestar.params import PathParameter, QueryParameter

from prior_sg.deploy.serving.gate import PROBLEM
from prior_sg.deploy.serving.system import MOST_LIMIT, System
from prior_sg.deploy.showing.text import LEAST_TOKENS, MOST_TOKENS

Robot = Annotated[str, PathParameter(description="Name of the robot.", min_length=1, max_length=64)]
Count = Annotated[int, QueryParameter(ge=1, le=MOST_LIMIT)]
Coordinate = Annotated[float, QueryParameter(ge=-1e9, le=1e9, description="World, metres.")]
Label = Annotated[str, QueryParameter(max_length=80)]
Distance = Annotated[float, QueryParameter(ge=0, le=1e9, description="Metres.")]
Tokens = Annotated[int, QueryParameter(ge=LEAST_TOKENS, le=MOST_TOKENS)]
FAULTS = {
    status: ResponseSpec(dict[str, Any], media_type=PROBLEM, description=why, generate_examples=False)
    for status, why in {
        400: "What was asked can never be answered.",
        404: "There is none such.",
        422: "It cannot be done; the sentence says why.",
        429: "Too much of this goes on; try again.",
        503: "The system does not answer.",
    }.items()
}


def system_of(state: State) -> System:
    """The system that requests are about."""
    system: System = state["system"]
    return system
