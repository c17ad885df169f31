"""What lies in files that somebody else may have written, what a model answers, and what a user sets."""

import io
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from mcap.writer import CompressionType, Writer

from prior_sg.deploy.cli import prior_file
from prior_sg.deploy.inspecting.replay import open_log, recorded_config
from prior_sg.deploy.settings import settings_layers
from prior_sg.schemas.codec import encode, schema_name
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.status import Consumed, Started, Tick
from prior_sg.schemas.topics import JOURNAL, PRIOR, REGION_DELTA, TASK, Topic
from prior_sg.services.ingest.sources.colmap_binary import CAMERA, COUNT, IMAGE, cameras_of, images_of
from prior_sg.services.ingest.sources.tables import SourceError
from prior_sg.services.prior_gateway.core.answers import parse
from prior_sg.services.prior_gateway.core.faults import Described, NamedList, Sized
from prior_sg.services.prior_gateway.core.turns import read_adjacency, read_matrix
from prior_sg.services.registry import BY_NAME, SERVICES
from prior_sg.services.runtime import config, record
from tests.fuzz.mutators import nested, of_json
from tests.fuzz.trial import Decoder
from tests.help.examples import EXAMPLES
from tests.help.examples import TASK as A_TASK

REGIONS, OBJECTS = ["kitchen", "hall"], ["stove", "coat rack"]
NAMED = '{"regions": [{"name": "kitchen", "parent": "", "share": 60}, {"name": "hall", "parent": "", "share": 40}]}'
MATRIX = '{"kitchen": {"stove": 90, "coat rack": 2}, "hall": {"stove": 1, "coat rack": "70 %"}}'
SETTINGS = """[segmenter]
beta = 2.0
[ingest]
window = 4
[prior_gateway]
synthesis.samples = 2
archive = "~/priors"
[segmenter.sizes]
"""


@contextmanager
def held(data: bytes) -> Iterator[Path]:
    """The input as a file."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        yield Path(file.name)


def of_file(read: Callable[[Path], object]) -> Callable[[bytes], None]:
    def decode(data: bytes) -> None:
        with held(data) as path:
            read(path)

    return decode


def log_of(entries: list[tuple[Topic, bytes]], compression: CompressionType, closed: bool = True) -> bytes:
    """A log as ours, or without what hides damage from its readers: compression and sums."""
    file = io.BytesIO()
    plain = compression == CompressionType.NONE
    writer = Writer(file, chunk_size=600, compression=compression, enable_crcs=not plain)
    writer.start(profile="", library="prior-sg")
    channels: dict[str, int] = {}
    for number, (topic, payload) in enumerate(entries):
        if topic.name not in channels:
            schema = writer.register_schema(schema_name(topic.type), "jsonschema", b"{}")
            about = {"topic": topic.name, "writer": "segmenter/s1/5"}
            channels[topic.name] = writer.register_channel(topic.pattern("r"), "msgpack", schema, about)
        writer.add_message(channels[topic.name], log_time=number, data=payload, publish_time=number, sequence=number)
    writer.add_attachment(0, 0, "truth", "application/json", b"{}")
    writer.add_metadata("source", {"path": "x"})
    if closed:
        writer.finish()
    else:
        writer.flush()
    return file.getvalue()


def _journal() -> list[tuple[Topic, bytes]]:
    settings = msgspec.json.encode(BY_NAME["segmenter"].config())
    started = Started(robot="r", service="segmenter", instance="s1", epoch=5, config=settings, versions={})
    inputs = [
        ("START", encode(started)),
        ("Tick", encode(Tick(stamp_ns=3))),
        ("TASK", encode(A_TASK)),
        ("PLACE_SNAPSHOT", encode(next(example for example in EXAMPLES if isinstance(example, PlaceDelta)))),
        ("STOP", b""),
    ]
    return [
        (
            JOURNAL,
            encode(Consumed(robot="r", service="segmenter", instance="s1", order=order, topic=topic, inline=data)),
        )
        for order, (topic, data) in enumerate(inputs)
    ]


def _logs() -> list[bytes]:
    kinds = {PRIOR: Prior, TASK: type(A_TASK), REGION_DELTA: REGION_DELTA.type}
    entries = [
        (topic, encode(example)) for topic, kind in kinds.items() for example in EXAMPLES if type(example) is kind
    ]
    everything = [*_journal(), *entries]
    plain, packed = CompressionType.NONE, CompressionType.ZSTD
    return [
        log_of(everything, plain),
        log_of(entries, plain, closed=False),
        log_of(entries, packed),
        log_of(entries, packed, closed=False),
    ]


def _log(path: Path) -> None:
    for read in (record.is_whole, record.holds_ros, record.holds_messages):
        read(path)
    for _ in record.read_log(path, damaged=lambda fault: None):
        pass
    record.summary(path)
    record.foreign_topics(path)
    record.attachments(path)
    record.metadata(path)


def _replays() -> list[bytes]:
    return [log_of(_journal(), CompressionType.NONE), log_of(_journal(), CompressionType.ZSTD)]


def _replay(path: Path) -> None:
    log = open_log(path, "segmenter")
    for life in log.lives:
        recorded_config(log, life)
        log.recorded(life)
        for entry in life.inputs:
            log.input(entry)


def _priors() -> list[bytes]:
    with held(b"") as path:
        prior_file.write(next(example for example in EXAMPLES if isinstance(example, Prior)), path)
        return [path.read_bytes()]


def _answers() -> list[bytes]:
    described = (
        '{"kitchen": {"phrases": ["a stove"], "objects": ["stove"], '
        '"inclination_deg": 3, "inclination_spread_deg": 9, "scale_cm": 80}}'
    )
    texts = (
        NAMED,
        f"<think>{{ or [</think>Here:\n```json\n{MATRIX} // so\n```",
        described,
        '[{"stove": {"longest_cm": "60 cm", "shortest_cm": 55, "height_cm": 85.5, "bottom_cm": 0,},}]',
        '{"kitchen": {"hall": 80}}',
    )
    return [text.encode() for text in texts]


def _answer(data: bytes) -> None:
    """A fault is a sentence for the model; what has none is used."""
    text = data.decode(errors="surrogateescape")
    forms = ((NamedList, [["regions"]]), (dict[str, Described], [REGIONS]), (dict[str, Sized], [OBJECTS]))
    told = [parse(text, kind, *wanted) for kind, wanted in forms]
    told.append(read_matrix(text, dict.fromkeys(REGIONS, OBJECTS), ("region", "object")))
    told.append(parse(text, dict[str, dict[str, float]], REGIONS, REGIONS))
    if told[-1][0] is not None:
        read_adjacency(told[-1][0], REGIONS)
    if all(faults for _, faults in told):
        raise ValueError(told[0][1][0])


def _setting(path: Path) -> None:
    layers = settings_layers(str(path), [])
    for service in SERVICES:
        config.resolve(service.config, service.name, layers)


def _arguments() -> list[bytes]:
    lines = ("segmenter.beta=2.0", "ingest.window=4", "segmenter.sizes={}", "prior_gateway.synthesis.samples=2")
    return [*(line.encode() for line in lines), "\n".join(lines).encode(), b'segmenter.tracking={"cell_m": 0.2}']


def _argument(data: bytes) -> None:
    given = config.from_arguments(data.decode(errors="surrogateescape").split("\n"))
    config.check_sections(given, list(BY_NAME))
    for service in SERVICES:
        config.resolve(service.config, service.name, given)


def _journalled() -> list[bytes]:
    return [service.name.encode() + b"\n" + msgspec.json.encode(service.config()) for service in SERVICES]


def _recorded(data: bytes) -> None:
    name, _, held = data.partition(b"\n")
    service = BY_NAME.get(name.decode(errors="replace"), SERVICES[len(held) % len(SERVICES)])
    config.recorded(service.config, service.name, held)


def _colmap() -> list[bytes]:
    camera = COUNT.pack(1) + CAMERA.pack(1, 1, 640, 480) + b"\0\0\0\0\0\0\xf0?" * 4
    image = COUNT.pack(1) + IMAGE.pack(1, 1.0, 0, 0, 0, 1, 2, 3, 1) + b"a.png\0" + COUNT.pack(1) + bytes(24)
    return [camera, image]


def _models(path: Path) -> None:
    refused = 0
    for read in (cameras_of, images_of):
        try:
            read(path)
        except SourceError:
            refused += 1
    if refused == 2:
        raise SourceError("neither")


JSON = (of_json, of_json, nested(b"["), nested(b'{"a":'))
TOML = (nested(b"a=["), nested(b"a={a="), nested(b"a."))
DECODERS = (
    Decoder("logs", _logs, of_file(_log), (record.LogError,), share=0.4),
    Decoder("replays", _replays, of_file(_replay), (record.LogError,), share=0.3),
    Decoder("prior-files", _priors, of_file(prior_file.read), (prior_file.PriorError,), JSON, share=1),
    Decoder("answers", _answers, _answer, (ValueError,), JSON, share=0.3),
    Decoder("settings", lambda: [SETTINGS.encode()], of_file(_setting), (config.ConfigError,), TOML, share=0.1),
    Decoder("arguments", _arguments, _argument, (config.ConfigError,), (nested(b"["), nested(b"a.")), share=1.5),
    Decoder(
        "journalled-settings",
        _journalled,
        _recorded,
        (config.ConfigError,),
        JSON,
        share=0.7,
    ),
    Decoder("colmap", _colmap, of_file(_models), (SourceError,), share=0.5),
)
