"""Who may write, answer, read and ask what: derived from the table of keys and the services' declarations.

A router knows a participant by its certificate. What is not granted is refused, in both directions: what a participant
sends, and what is sent to it. Processes on the router's own host come over loopback and are not restricted.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from prior_sg.deploy.fleet.bridge import SERVICE as MERGES
from prior_sg.schemas.topics import (
    FLEET,
    JOURNAL,
    QUERIES,
    ROOT,
    TOPICS,
    Query,
    Topic,
    alive_key,
    job_key,
    lease_key,
    roll_key,
    status_key,
    worker_keys,
    yield_key,
)
from prior_sg.services.registry import OPERATOR_WRITES, SERVICES
from prior_sg.services.runtime.keys import Participant, Role
from prior_sg.services.runtime.service import Service

ANYBODY = "*"  # as robot: of all robots
JOBS = tuple(topic for topic in TOPICS if topic.delivery == "job")
OF_ANY_SERVICE = (JOURNAL,)  # written by the host of each
LOCAL_LINKS = ("tcp", "udp", "ws")  # by a loopback interface
LOCAL_SOCKETS = ("unixsock-stream", "unixpipe")
DECLARATIONS = (
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
MESSAGES = ("put", "delete", "query", "reply", *DECLARATIONS)
EVERYWHERE = (f"{ROOT}/**", f"{ROOT}/**/@adv/**")


@dataclass(frozen=True)
class Grants:
    """Key expressions by what may be done with them."""

    writes: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    announces: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()


def services_of(role: Role) -> tuple[Service, ...]:
    """A robot runs what serves one robot; an edge all but what reads the cameras; a fleet what merges maps under a name
    of its own; the others run none."""
    match role:
        case "robot":
            return tuple(service for service in SERVICES if service.scope == "robot")
        case "edge":
            return tuple(service for service in SERVICES if service.drive is None)
        case "fleet":
            return (MERGES,)
        case _:
            return ()


def grants_of(role: Role, name: str) -> Grants:
    """What a participant of this role and name may do."""
    services = services_of(role)
    robot = name if role in ("robot", "fleet") else ANYBODY
    heard = name if role == "robot" else ANYBODY
    given = () if role in ("viewer", "fleet") else OPERATOR_WRITES
    written = {*given, *(OF_ANY_SERVICE if services else ()), *(t for s in services for t in s.writes)}
    # An edge also passes robots' jobs on to workers of other hosts.
    jobs = [topic for topic in JOBS if topic in written or role == "edge"]
    worked = [service.job for service in services if service.job is not None]
    return Grants(
        writes=tuple(t.pattern(robot) for t in TOPICS if t in written and t not in JOBS and _may_write(role, t)),
        answers=(
            *(_asked_on(query, robot) for query in QUERIES if any(query in s.answers for s in services)),
            *(status_key(service.name, "*") for service in services),
            *(yield_key(_served(service, robot), service.name, "*") for service in services),
            *(job_key(job, "*", "*") for job in worked),
        ),
        announces=(
            *(alive_key(service.name, "*") for service in services),
            *(roll_key(service.name, "*", "*") for service in services),
            *(lease_key(robot, service.name, "*", "*") for service in services if service.scope == "robot"),
            *(worker_keys(job, "*", "**")[1] for job in worked),
        ),
        reads=(
            *(t.pattern(heard) for t in TOPICS if t not in JOBS),
            alive_key("*", "*"),
            roll_key("*", "*", "*"),
            lease_key(robot, "*", "*", "*"),
            *(worker_keys(job, "*", "**")[1] for job in jobs),
        ),
        asks=(
            *(_asked_on(query, heard) for query in QUERIES),
            status_key("*", "*"),
            *(yield_key(_served(service, robot), service.name, "*") for service in services),
            *(job_key(job, "*", robot) for job in jobs),
        ),
    )


def _served(service: Service, robot: str) -> str:
    """Who is served by one service's processes, as it stands in their keys."""
    return robot if service.scope == "robot" else FLEET


def _may_write(role: Role, topic: Topic) -> bool:
    """What concerns the whole fleet is not a single robot's to say."""
    return role not in ("robot", "fleet") or "{robot}" in topic.key


def _asked_on(query: Query, robot: str) -> str:
    fields = {name: robot if name == "robot" else "**" for name in query.request.__struct_fields__}
    return query.key.format(**fields).replace("**/**", "**")  # the one way in which Zenoh writes it


def access_control(participants: Iterable[Participant], loopback: Sequence[str]) -> dict[str, Any]:
    """Zenoh's `access_control` of a router. `loopback` names the interfaces of its own host's processes."""
    local = [_rule("local", flow, MESSAGES, EVERYWHERE) for flow in ("ingress", "egress")]
    known: list[tuple[dict[str, Any], str, list[dict[str, Any]]]] = [
        ({"interfaces": list(loopback), "link_protocols": list(LOCAL_LINKS)}, "local", local),
        ({"link_protocols": list(LOCAL_SOCKETS)}, "local sockets", local),
    ]
    for one in participants:
        if not one.revoked:
            name = one.common_name
            known.append(({"cert_common_names": [name]}, name, _rules(name, grants_of(one.role, one.name))))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list({rule["id"]: rule for _, _, rules in known for rule in rules}.values()),
        "subjects": [{"id": name} | who for who, name, _ in known],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": [name]} for _, name, rules in known],
    }


def _rules(subject: str, grants: Grants) -> list[dict[str, Any]]:
    """As rules of Zenoh. A writer keeps a cache: it answers for what it wrote, and its readers ask it."""
    caches, readers = _of_publishers(grants.writes), _of_publishers(grants.reads)
    from_it = (
        (("put",), [*grants.writes, *caches]),
        (("declare_queryable",), [*grants.answers, *caches]),
        (("reply",), [*grants.answers, *grants.writes, *caches]),
        (("liveliness_token",), [*grants.announces, *caches, *readers]),
        (("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"), [*grants.reads, *readers]),
        (("query",), [*grants.asks, *grants.reads, *readers]),
    )
    to_it = (
        (("put",), [*grants.reads, *readers]),
        (("reply",), [*grants.asks, *grants.reads, *readers]),
        (("query",), [*grants.answers, *grants.writes, *caches]),
        (DECLARATIONS, EVERYWHERE),
    )
    rules = [("ingress", *rule) for rule in from_it] + [("egress", *rule) for rule in to_it]
    return [_rule(f"{subject} {messages[0]}", flow, messages, keys) for flow, messages, keys in rules if keys]


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": f"{name} {flow}",
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _of_publishers(keys: Iterable[str]) -> list[str]:
    """Where Zenoh's advanced publishers and subscribers of these keys find each other; `**` does not reach there."""
    return [f"{key}/@adv/**" for key in keys]
