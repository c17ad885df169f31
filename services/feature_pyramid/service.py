"""A worker of the encoding pool: keyframes in, feature pyramids and detected objects out; answers text queries."""

from collections.abc import Iterator

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.priors import PriorRequest, TaskRequest
from prior_sg.schemas.topics import DETECTIONS, ENCODE, PRIOR, PRIORS, PYRAMID, TASK, TASK_IN_FORCE, TEXT
from prior_sg.services import intent
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.detectors.load import load_detector
from prior_sg.services.feature_pyramid.encoders.base import Options, load_encoder, space_of
from prior_sg.services.feature_pyramid.worker import Worker, detections, look_at, prepare, pyramid
from prior_sg.services.runtime import heap
from prior_sg.services.runtime.service import Ask, Identity, Output, Service

QUESTIONS = {TaskRequest: TASK_IN_FORCE, PriorRequest: PRIORS}


def init(cfg: Config, identity: Identity) -> Worker:
    """Load the encoder of the configured space and the detector. Raises EncoderUnavailable."""
    options = Options(cfg.threads, cfg.batch_size, cfg.runtime, cfg.device)
    return Worker(identity.instance, load_encoder(cfg.space, options), load_detector(cfg))


def step(state: Worker, message: Message, cfg: Config) -> Iterator[Output]:
    """A pyramid and detections per keyframe, empty when nothing is found or an image is broken: the job is done.

    A detector that is not yet told what to look for has not looked: its keyframes have no detections.
    """
    if not isinstance(message, Keyframe):
        intent.hear(state.vocabulary, message)
        return
    if state.detector.prompted and not cfg.detector_prompts:
        for question in intent.questions(state.vocabulary, message.robot):
            yield Ask(QUESTIONS[type(question)], question)
    seen, embeddings = look_at(state, message, cfg)
    split = len(seen.selection.crops)
    yield PYRAMID, pyramid(state, message, seen, embeddings[:split])
    if seen.sought or not state.detector.prompted:
        yield DETECTIONS, detections(state, message, seen, embeddings[split:], cfg)


def answer_text(state: Worker, request: TextRequest, cfg: Config) -> TextEmbeddings:
    """Descriptors of concepts. Raises ValueError for another space or a concept without phrases."""
    if request.space != state.encoder.space:
        raise ValueError(f"this worker serves the space {state.encoder.space}, not {request.space}")
    found = state.encoder.encode_text(request.concepts)
    heap.give_back()
    return found


SERVICE = Service(
    name="feature_pyramid",
    purpose="Encodes keyframes as feature pyramids, detects objects in them, and encodes text as concept descriptors",
    scope="fleet",
    config=Config,
    init=init,
    step=step,
    reads=(TASK, PRIOR),
    writes=(PYRAMID, DETECTIONS),
    asks=(TASK_IN_FORCE, PRIORS),
    answers={TEXT: answer_text},
    job=ENCODE,
    job_group=lambda cfg: space_of(cfg.space),
    prepare=prepare,
    key_fields=lambda cfg: {"space": space_of(cfg.space)},
    close=lambda state: state.reader.shutdown(wait=False, cancel_futures=True),
    losses=lambda state: state.losses.told,
    replay_tolerance=2e-3,  # of half-precision embeddings
    beside=True,
)
