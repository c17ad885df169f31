"""The topic graph, table and compose files, generated from the registry, and the check that they are up to date."""

from pathlib import Path

from prior_sg.deploy.inspecting.compose import COMPOSE, COMPOSE_CUDA, compose, compose_cuda
from prior_sg.schemas.codec import schema_name
from prior_sg.schemas.topics import JOURNAL, QUERIES, TOPICS
from prior_sg.services.registry import OPERATOR_WRITES, SERVICES

ROOT = Path(__file__).resolve().parents[2]
BEGIN, END = "<!-- topics:begin (prior-sg topics --write) -->", "<!-- topics:end -->"
DOCUMENTS = ("README.md", "docs/architecture.md")
FILES = {COMPOSE: compose, COMPOSE_CUDA: compose_cuda}  # generated as a whole
ARROWS = {"every": "-->", "latest": "-.->", "job": "==>"}


def mermaid() -> str:
    """The graph of services and topics; thick arrows are jobs, dotted ones `latest`."""
    lines = ["graph LR", "  operator([you: prior-sg task])"]
    lines += [f"  {service.name}[{service.name}]" for service in SERVICES]
    for topic in TOPICS:
        if topic is JOURNAL:
            continue
        arrow = ARROWS[topic.delivery]
        writers = [s.name for s in SERVICES if topic in s.writes] + (["operator"] if topic in OPERATOR_WRITES else [])
        readers = [s.name for s in SERVICES if topic in s.reads or topic is s.job]
        for writer in writers:
            lines += [f"  {writer} {arrow}|{topic.name}| {reader}" for reader in readers]
            if not readers:
                lines.append(f"  {writer} {arrow}|{topic.name}| operator")
    return "\n".join(lines)


def table() -> str:
    """Topics and queries with key, type, delivery, rate, whether recorded, who writes and who reads."""
    lines = [
        "| topic | key | type | delivery | typical rate | recorded | written by | read by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS:
        writers = [s.name for s in SERVICES if topic in s.writes] + (["operator"] if topic in OPERATOR_WRITES else [])
        readers = [s.name for s in SERVICES if topic in s.reads or topic is s.job] or ["operator"]
        if topic is JOURNAL:
            writers, readers = ["all"], ["ingest", "recorder"]
        lines.append(
            f"| {topic.name} | `{topic.key}` | {schema_name(topic.type)} | {topic.delivery} | {topic.rate_hz:g} Hz "
            f"| {'yes' if topic.recorded else 'no'} | {', '.join(writers)} | {', '.join(readers)} |"
        )
    lines += ["", "| query | key | request → reply | answered by | asked by |", "|---|---|---|---|---|"]
    for query in QUERIES:
        servers = [s.name for s in SERVICES if query in s.answers]
        askers = [s.name for s in SERVICES if query in s.asks] or ["operator"]
        kinds = f"{schema_name(query.request)} → {schema_name(query.reply)}"
        lines.append(f"| {query.name} | `{query.key}` | {kinds} | {', '.join(servers)} | {', '.join(askers)} |")
    return "\n".join(lines)


def generated(document: str) -> str:
    """What stands between the markers of a document: the graph in the README, graph and table in the architecture."""
    parts = [BEGIN, "```mermaid", mermaid(), "```"]
    if document != DOCUMENTS[0]:
        parts += ["", table()]
    return "\n".join([*parts, END])


def replace_generated(text: str, document: str) -> str:
    """The document with its generated part renewed. Raises ValueError when the markers are missing."""
    if BEGIN not in text or END not in text:
        raise ValueError(f"{document} lacks the markers {BEGIN} and {END}")
    return text[: text.index(BEGIN)] + generated(document) + text[text.index(END) + len(END) :]


def in_checkout() -> bool:
    """Whether the documents are there, which no installed package has."""
    return all((ROOT / file).exists() for file in DOCUMENTS)


def write() -> list[str]:
    """Renew every generated part; returns the files."""
    for document in DOCUMENTS:
        path = ROOT / document
        path.write_text(replace_generated(path.read_text(), document))
    for file, text in FILES.items():
        (ROOT / file).write_text(text())
    return [*DOCUMENTS, *FILES]


def faults() -> list[str]:
    """Everything that does not agree: reads without writer, questions without answer, doubled keys, stale documents."""
    found = []
    written = {topic for service in SERVICES for topic in service.writes} | set(OPERATOR_WRITES) | {JOURNAL}
    answered = {query for service in SERVICES for query in service.answers}
    for service in SERVICES:
        reads = (*service.reads, *((service.job,) if service.job else ()))
        found += [f"{service.name} reads {topic.name}, which nothing writes" for topic in reads if topic not in written]
        found += [f"{service.name} asks {q.name}, which nothing answers" for q in service.asks if q not in answered]
    found += [f"{topic.name} is in the table, but nothing writes it" for topic in TOPICS if topic not in written]
    found += [f"{query.name} is in the table, but nothing answers it" for query in QUERIES if query not in answered]
    keys = [entry.key for entry in (*TOPICS, *QUERIES)]
    found += [f"two entries use the key {key}" for key in sorted({key for key in keys if keys.count(key) > 1})]
    for document in DOCUMENTS:
        text = (ROOT / document).read_text()
        if generated(document) not in text:
            found.append(f"{document} is out of date; run `prior-sg topics --write`")
    for file, written_anew in FILES.items():
        if not (ROOT / file).exists() or (ROOT / file).read_text() != written_anew():
            found.append(f"{file} is out of date; run `prior-sg topics --write`")
    return found
