"""The scene over HTTP: one Litestar application over a running system."""

import logging
from typing import Any

from litestar import Litestar, Request, Response
from litestar.datastructures import State
from litestar.exceptions import HTTPException
from litestar.openapi import OpenAPIConfig
from litestar.openapi.plugins import JsonRenderPlugin
from litestar.openapi.spec import Components, Reference, SecurityScheme

from prior_sg.deploy.api.errors import NotInSceneError, PosesError, TaskError
from prior_sg.deploy.serving.changing import CHANGING
from prior_sg.deploy.serving.errors import BusyError, FaultyRequestError
from prior_sg.deploy.serving.events import Feeds
from prior_sg.deploy.serving.gate import PROBLEM, App, Entrance, Gate, problem
from prior_sg.deploy.serving.reading import READING
from prior_sg.deploy.serving.system import System
from prior_sg.deploy.serving.wholes import WHOLES
from prior_sg.schemas.names import shown
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import NoPriorError

log = logging.getLogger(__name__)
LARGEST_BODY_B = 4 * 2**20
BODY = "data"  # as the framework calls it
LEFT = "client disconnected prematurely"  # as the framework says it
STATUS_OF: dict[type[Exception], int] = {  # the first that fits
    RecursionError: 400,  # of a body that is nested too deeply
    FaultyRequestError: 400,
    NotInSceneError: 404,
    BusyError: 429,
    TaskError: 422,
    NoPriorError: 422,
    PosesError: 422,
    BusError: 503,
    PriorSgError: 422,
}


def http_app(system: System, feeds: Feeds, entrance: Entrance) -> App:
    """The application behind its gate."""
    app = Litestar(
        route_handlers=[*READING, *WHOLES, *CHANGING],
        state=State({"system": system, "feeds": feeds}),
        openapi_config=_openapi(entrance),
        exception_handlers={HTTPException: _told, Exception: _told},
        request_max_body_size=LARGEST_BODY_B,
        logging_config=None,
    )
    return Gate(app, entrance)  # type: ignore[arg-type]


def _openapi(entrance: Entrance) -> OpenAPIConfig:
    bearer: dict[str, SecurityScheme | Reference] = {"bearer": SecurityScheme(type="http", scheme="bearer")}
    return OpenAPIConfig(
        title="Prior-SG",
        version="1",
        description="Scene graphs of a running system. Errors are application/problem+json.",
        path="/openapi",
        render_plugins=[JsonRenderPlugin(path="/openapi.json")],
        use_handler_docstrings=True,
        components=Components(security_schemes=bearer if entrance.token else None),
        security=[{"bearer": []}] if entrance.token else None,
    )


def _told(request: Request[Any, Any, Any], error: Exception) -> Response[dict[str, Any]]:
    """Any failure as a problem with one sentence."""
    if isinstance(error, HTTPException) and error.detail == LEFT:
        status, detail, headers = 408, "the body of the request did not arrive", None
    elif isinstance(error, HTTPException):
        status, detail, headers = error.status_code, _detail(error), error.headers
    else:
        status = next((code for kind, code in STATUS_OF.items() if isinstance(error, kind)), 500)
        detail, headers = str(error) if status < 500 or status == 503 else "this is a fault of the server", None
    if status == 500:
        log.exception("a request failed", exc_info=error)
    return Response(problem(status, shown(detail)), status_code=status, media_type=PROBLEM, headers=headers)


def _detail(error: HTTPException) -> str:
    """The sentence of an error of the framework, with the fields that it names."""
    named = error.extra if isinstance(error.extra, list) else []
    told = {(one.get("key") or BODY, one.get("message", "")) for one in named if isinstance(one, dict)}
    if (BODY, repr(BODY)) in told:
        return "the body is missing: send JSON, as /openapi/openapi.json describes it"
    fields = [f"{'the body' if key == BODY else key}: {message}" for key, message in sorted(told)]
    return "; ".join(fields) or error.detail
