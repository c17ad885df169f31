"""Simulated encoders of graded quality: a crop's embedding is made from what the crop truly shows.

So methods can be compared where nobody tuned an encoder, on sequences and on worlds without colour. Both kinds look at
the measured surface of a frame, nudged towards the camera so that a wall belongs to the room that it faces, and give
every piece of it a look, a vector. A crop is the mean of the looks that it covers, weighted by image area, plus noise,
normalised.

`sim:P`: errors without memory. The surface is cut into cubes of 1 m. The piece of a region in one cube wears the
region's label with probability 1 - P, else another label of the sequence, whichever; it wears the same from everywhere.

`simlike:P`: errors that persist, as those of encoders trained on pictures. Each region as a whole leans towards one
other label and looks the more like it the more it leans; a share P of the regions looks more like the other label than
like its own. The other label is likely to have a similar name, or to be one that this encoder sees everywhere. Beyond
that all crops are tinted alike, by the labels that this encoder favours; every frame adds noise that its crops share,
small crops add more of their own than large ones, and surface of a true object looks half like that object. Tint and
noise stand to what tells regions apart as in `conse` on the development sequences, which is most like `simlike:0.4`.

Surface in no region wears, cube by cube, looks that mean nothing.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.kinds import SIMULATED
from prior_sg.deploy.evaluation.oracles import NOISE, viewed_points, with_crops
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.regions import NO_REGION

DIM = 128
COMMON = 0.3  # cosine of the looks of any two names, as pictures of places resemble each other in every space
NUDGE_M = 0.1
CELL_M = 1.0
BACKGROUND = 1000  # looks over which similarities are read
READING = {  # temperature and null score: those of `conse`; and chosen on development crops as those were
    "sim": (0.52, 3.2),
    "simlike": (0.55, 1.4),
}

ARTICLES = ("a ", "an ")
ALIKE = 3.0  # of `simlike`: how much likelier a label is to be taken for one whose name shares its letters
FAVOUR = 1.0  # standard deviation, in the same unit, of how readily the encoder sees a label anywhere
TINT = 0.22  # of the labels that it favours, in every crop
FRAME_NOISE = 2.5  # length of the noise that the crops of a frame share
CROP_NOISE = 1.5  # length of the noise of a crop as high as the image; of half that, sqrt(2) times
OBJECT_SHARE = 0.5  # of an object's own look in the look of its surface


@dataclass(frozen=True)
class SimulatedEncoder:
    """One simulated encoder: its kind, how often it errs, and which errors, by seed."""

    kind: str  # sim or simlike
    errors: float  # P, in [0, 1]
    seed: int = 0

    @property
    def space(self) -> str:
        """Its embedding space, such as `sim/0.3`."""
        return f"{self.kind}/{self.errors:g}"

    def text(self, concepts: Sequence[Sequence[str]]) -> TextEmbeddings:
        """Each concept by the name that its first phrase says, less the article."""
        embeddings = np.array([look_of(name_in(phrases[0])) for phrases in concepts]).reshape(-1, DIM)
        noise = np.hypot(FRAME_NOISE, CROP_NOISE) if self.kind == "simlike" else 0.0
        similarity = background(float(noise)) @ embeddings.T
        temperature, null_score = READING[self.kind]
        return TextEmbeddings(
            space=self.space,
            embeddings=embeddings.astype(np.float32),
            background_mean=similarity.mean(axis=0).astype(np.float32),
            background_std=similarity.std(axis=0).astype(np.float32),
            temperature=temperature,
            null_score=null_score,
        )

    def encode(self, layout: Pyramid, truth: GroundTruth, objects: Sequence[TrueObject] = ()) -> Pyramid:
        """A pyramid's crops as this encoder sees them; those that show no measured surface are left out."""
        cells_px, points_m = viewed_points(layout)
        if not len(points_m):
            return self._with(layout, np.zeros(len(layout.layers), bool), np.zeros((0, DIM)))
        towards_m = layout.world_from_camera[:3, 3] - points_m
        points_m = points_m + NUDGE_M * towards_m / np.linalg.norm(towards_m, axis=1, keepdims=True)
        surface, looks = self._surface(points_m, truth, objects)
        offsets_px = np.abs(cells_px[None] - layout.centers_px[:, None])
        covered = (offsets_px < layout.sigmas_px[:, None, None]).all(axis=2).astype(np.float32)
        counts = covered @ np.eye(len(looks), dtype=np.float32)[surface]
        kept = counts.any(axis=1)
        shown = (counts[kept] / counts[kept].sum(axis=1, keepdims=True)) @ looks
        noisy = shown + self._noise(layout)[kept]
        if self.kind == "simlike":
            noisy += self.tint(list(dict.fromkeys(region.label for region in truth.regions)))
        return self._with(layout, kept, noisy / np.linalg.norm(noisy, axis=1, keepdims=True))

    def _with(self, layout: Pyramid, kept: np.ndarray, embeddings: np.ndarray) -> Pyramid:
        return msgspec.structs.replace(with_crops(layout, kept, embeddings), space=self.space)

    def _surface(
        self, points_m: np.ndarray, truth: GroundTruth, objects: Sequence[TrueObject]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Look (point,) of each point, as a row of the looks (look, DIM)."""
        labels = list(dict.fromkeys(region.label for region in truth.regions))
        regions = truth.region_of(points_m)
        cells = np.floor(points_m / CELL_M).astype(np.int64)
        known = regions != NO_REGION
        surface = np.empty(len(points_m), np.int64)
        void_cells, void = np.unique(cells[~known], axis=0, return_inverse=True)
        if self.kind == "sim":
            looks = [look_of(label) for label in labels]
            of_region = {region.id: labels.index(region.label) for region in truth.regions}
            true = np.array([of_region[region] for region in regions[known].tolist()], np.int64)
            surface[known] = self.worn(cells[known], true, len(labels))
        else:
            looks, surface[known] = self._leaning(points_m[known], regions[known], truth, labels, objects)
        surface[~known] = len(looks) + void.reshape(-1)
        looks = looks + [_random_look(f"void {self.seed} {cell}") for cell in void_cells.tolist()]
        return surface, np.array(looks).reshape(-1, DIM)

    def worn(self, cells: np.ndarray, true: np.ndarray, labels: int) -> np.ndarray:
        """Label (n,) that the surface in each cell (n, 3) wears whose region has the label `true` (n,)."""
        draw = _hashed(np.column_stack((cells, true)), self.seed)
        wrong = (draw >> np.uint64(32)) < np.uint64(round(self.errors * 2**32))
        others = max(labels - 1, 1)
        other = (true + 1 + (draw & np.uint64(0xFFFFFFFF)).astype(np.int64) % others) % labels
        return np.where(wrong, other, true)

    def _leaning(
        self,
        points_m: np.ndarray,
        regions: np.ndarray,
        truth: GroundTruth,
        labels: list[str],
        objects: Sequence[TrueObject],
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Looks, and the look (point,) of each point in a region: one look by region and object."""
        inside = np.zeros(len(points_m), np.int64)  # 1 + the object that holds the point
        for number, item in enumerate(objects):
            held = ((points_m >= item.min_m - NUDGE_M) & (points_m <= item.max_m + NUDGE_M)).all(axis=1)
            inside[held] = 1 + number
        pairs, surface = np.unique(np.column_stack((regions, inside)), axis=0, return_inverse=True)
        whole = {region.id: self.region_look(region.id, region.label, labels) for region in truth.regions}
        looks = []
        for region, item in pairs.tolist():
            own = whole[region]
            if item:
                own = (1 - OBJECT_SHARE) * own + OBJECT_SHARE * look_of(objects[item - 1].label)
            looks.append(_unit(own))
        return looks, surface.reshape(-1)

    def region_look(self, region: int, label: str, labels: Sequence[str]) -> np.ndarray:
        """What a region as a whole looks like (DIM,): its label and, leaning, another one."""
        if len(labels) < 2:
            return look_of(label)
        rng = _rng(f"region {self.seed} {region} {label}")
        others = [other for other in labels if other != label]
        readiness = [ALIKE * likeness(label, other) + FAVOUR * self._favour(other) for other in others]
        chances = np.exp(np.array(readiness) - max(readiness))
        other = others[rng.choice(len(others), p=chances / chances.sum())]
        lean = leaning(rng.random(), self.errors)
        return _unit((1 - lean) * look_of(label) + lean * look_of(other))

    def tint(self, labels: Sequence[str]) -> np.ndarray:
        """What an encoder adds to all it sees (DIM,): labels above and below their mean, as it favours them."""
        favours = np.array([self._favour(label) for label in labels])
        looks = np.array([look_of(label) for label in labels]).reshape(-1, DIM)
        return TINT * ((favours - favours.mean()) @ looks if len(labels) else np.zeros(DIM))

    def _favour(self, label: str) -> float:
        return float(_rng(f"favour {self.seed} {label}").standard_normal())

    def _noise(self, layout: Pyramid) -> np.ndarray:
        """Noise (crop, DIM)."""
        rng = np.random.default_rng([self.seed, layout.frame_id])
        noise = rng.standard_normal((len(layout.layers), DIM)) / np.sqrt(DIM)
        if self.kind == "sim":
            return NOISE * noise
        shorter_px = min(layout.intrinsics.width_px, layout.intrinsics.height_px)
        lengths = CROP_NOISE * np.sqrt(shorter_px / (2 * layout.sigmas_px[:, None]))
        return lengths * noise + FRAME_NOISE * rng.standard_normal(DIM) / np.sqrt(DIM)


def simulated(choice: str, seed: int = 0) -> SimulatedEncoder | None:
    """The encoder that a choice such as `sim:0.3` names; None when it names none. Raises ValueError."""
    kind, _, share = choice.partition(":")
    if kind not in SIMULATED:
        return None
    try:
        errors = float(share)
    except ValueError:
        errors = -1.0
    if not 0.0 <= errors <= 1.0:
        raise ValueError(f"a simulated encoder is {kind}:P with P, how often it errs, from 0 to 1, not {choice!r}")
    return SimulatedEncoder(kind, errors, seed)


def name_in(phrase: str) -> str:
    """The name that a phrase says: without its article, letters' case aside."""
    phrase = phrase.casefold()
    return next((phrase.removeprefix(article) for article in ARTICLES if phrase.startswith(article)), phrase)


@cache
def look_of(name: str) -> np.ndarray:
    """What a name looks like (DIM,), unit length; the cosine of two is about COMMON."""
    return _random_look(f"name {name_in(name)}")


@cache
def background(noise: float) -> np.ndarray:
    """Crops (crop, DIM) of nothing in particular, with noise of a length, over which similarities are read."""
    looks = np.array([_random_look(f"background {number}") for number in range(BACKGROUND)])
    noisy = looks + noise / np.sqrt(DIM) * _rng("background").standard_normal(looks.shape)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def likeness(one: str, other: str) -> float:
    """How much two names share, in [0, 1]: cosine of their counts of three letters."""
    counts: list[Mapping[str, int]] = []
    for name in (one, other):
        padded = f" {name_in(name)} "
        parts = [padded[at : at + 3] for at in range(len(padded) - 2)]
        counts.append({part: parts.count(part) for part in parts})
    shared = sum(count * counts[1].get(part, 0) for part, count in counts[0].items())
    lengths = [sum(count**2 for count in held.values()) ** 0.5 for held in counts]
    return shared / (lengths[0] * lengths[1])


def leaning(uniform: float, share: float) -> float:
    """How much a region leans, in [0, 1], from a uniform draw: above one half with probability `share`."""
    if share in (0.0, 1.0):
        return share
    exponent = np.log(0.5) / np.log(1 - share)
    return float(uniform**exponent)


def _random_look(key: str) -> np.ndarray:
    return _unit(np.sqrt(COMMON) * _direction("common") + np.sqrt(1 - COMMON) * _direction(key))


@cache
def _direction(key: str) -> np.ndarray:
    return _unit(_rng(key).standard_normal(DIM))


def _rng(key: str) -> np.random.Generator:
    """Random numbers that are the same in every process."""
    return np.random.default_rng(int.from_bytes(hashlib.blake2b(key.encode(), digest_size=16).digest()))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _hashed(rows: np.ndarray, seed: int) -> np.ndarray:
    """64 bits (n,) of rows of integers (n, k): the finaliser of SplitMix64 over each number in turn."""
    mixed = np.full(len(rows), np.uint64(seed & 0xFFFFFFFFFFFFFFFF))
    for column in rows.astype(np.int64).view(np.uint64).T:
        mixed = mixed * np.uint64(0x9E3779B97F4A7C15) + column + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return mixed
