"""Feature pyramids (paper, Multi-Scale Feature Pyramid) and text embeddings, each tied to one embedding space."""

from typing import Annotated

import numpy as np

from prior_sg.schemas.codec import Message, Number, Shape, Stamp
from prior_sg.schemas.frames import Intrinsics, Pose, check_pose

DEFAULT_SPACE = "conse/efficientnet-lite2/minilm-l6-v2"  # embedding space of encoders and readers told of no other


class Pyramid(Message, frozen=True, kw_only=True):
    """The encoded crops of one keyframe, with all that integration needs: camera, pose and a coarse depth surface."""

    robot: str
    frame_id: Number
    stamp_ns: Stamp
    space: str  # embedding space, for example conse/efficientnet-lite0/minilm-l6-v2
    worker: str
    intrinsics: Intrinsics
    world_from_camera: Pose
    centers_px: Annotated[np.ndarray, Shape("float32", "crop", 2)]  # u, v of each crop
    sigmas_px: Annotated[np.ndarray, Shape("float32", "crop")]  # half the side length
    layers: Annotated[np.ndarray, Shape("uint8", "crop")]
    depths_m: Annotated[np.ndarray, Shape("float32", "crop")]  # median depth inside each crop
    embeddings: Annotated[np.ndarray, Shape("float16", "crop", "dim")]  # unit length
    surface_m: Annotated[np.ndarray, Shape("float32", "row", "column")]  # coarse depth image, 0 = no measurement
    crops_total: Number  # candidates before the A_min filter

    def check(self) -> None:
        check_pose(self.world_from_camera)


class Backfill(Message, frozen=True, kw_only=True):
    """Wish of a reader of pyramids: encode the archived keyframes that it lacks in one embedding space."""

    robot: str
    space: str
    frame_ids: Annotated[np.ndarray, Shape("int64", "frame")]  # those it has
    settled: bool = False  # nothing has come for a while: what it lacks is not just on its way
    epoch: Number = 0  # of the reader; 0 = it does not say
    number: Number = 0  # among its wishes; rises


class TextRequest(Message, frozen=True, kw_only=True):
    """Embed concepts; each concept is a list of phrases whose embeddings are averaged."""

    space: str
    concepts: list[list[str]]


class TextEmbeddings(Message, frozen=True, kw_only=True):
    """Concept descriptors of one space and how similarities in it are to be read.

    `background_mean` and `background_std` are the mean and spread of each concept's similarity over the space's
    background set: (similarity - mean) / std compares concepts on one scale. `temperature` and `null_score` (paper: tau
    and s_null) apply to that standardised similarity.
    """

    space: str
    embeddings: Annotated[np.ndarray, Shape("float32", "concept", "dim")]  # unit length
    background_mean: Annotated[np.ndarray, Shape("float32", "concept")]
    background_std: Annotated[np.ndarray, Shape("float32", "concept")]
    temperature: float
    null_score: float
