"""Which reading of the written poses lets the depth images agree (pure)."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from prior_sg.services.geometry import inverse, pose_from_quaternion, quaternion_of
from prior_sg.services.ingest.core.agreement import NOTHING, Agreement, DepthView, agreement, grid_points, with_poses
from prior_sg.services.ingest.core.detection import LIKELY_M
from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok, problem
from prior_sg.services.ingest.core.inspection.sample import Shot, has_moved, pairs_of
from prior_sg.services.ingest.core.poses import FROM_CAMERA as MOTIONS

FORWARD, BACKWARD = "world_from_camera", "camera_from_world"
OTHER = {FORWARD: BACKWARD, BACKWARD: FORWARD, "xyzw": "wxyz", "wxyz": "xyzw"}
FROM_CAMERA = {name: matrix[:3, :3] for name, matrix in MOTIONS.items()}  # axes as written, from ours
DIRECTIONS = ("right", "down", "forward"), ("left", "up", "back")
GOOD, POOR, CONTRADICTED = 0.85, 0.6, 0.7  # shares: poses that agree, that may be right, that are wrong
GAIN = 0.15  # of the share by which another reading must be better to be named
CONVINCING = 0.6  # score of a reading after which no other is looked for
ALIKE = 0.03  # readings this close are equally good: the one that changes least is taken
SCREENED_PAIRS = 14
SCALES_M = (1.0, 0.01, 0.001, 0.0002, 0.00025, 0.0005, 0.0001, 1 / 256, 1 / 6553.5)  # metres per unit that tools write
FEW_PAIRS = 2
RUNNERS_UP = 5  # readings that are tried with other focal lengths when none convinces
USUAL_M = (0.3, 40.0)  # median depth of rooms and streets
FOCAL_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.2, 1.3, 1.43, 1.6, 1.8, 2.0)
SMALL_GAIN = 0.1  # of the share by which another focal length must be better
FLAT = 0.02  # share by which depth may vary in images that show nothing
POSITION_UNITS_M = {0.001: "millimetres", 0.01: "centimetres"}
UNMIRROR = "convert them to a right-handed world: mirror one axis of positions and rotations"
CONVERT = "convert them to x right, y down, z forward"


@dataclass(frozen=True)
class Reading:
    """How written poses were turned into world_from_camera."""

    poses: str = FORWARD
    quaternion: str = "xyzw"  # order, where they have any
    axes: str = "opencv"  # empty = no convention with a name
    from_camera: np.ndarray = field(default_factory=lambda: np.eye(3))  # the axes as written, from ours
    world_from_source: np.ndarray = field(default_factory=lambda: np.eye(4))
    fixed: bool = False  # no option reads them otherwise
    position_scale_m: float = 1.0  # metres per unit of written positions

    def written(self, world_from_camera: np.ndarray) -> np.ndarray:
        """The motion as it is written, from the pose this reading made of it."""
        motion = inverse(self.world_from_source) @ world_from_camera @ _lifted(self.from_camera.T)
        return inverse(motion) if self.poses == BACKWARD else motion

    def read(self, written: np.ndarray) -> np.ndarray:
        """world_from_camera of a written motion."""
        motion = inverse(written) if self.poses == BACKWARD else written
        return self.world_from_source @ motion @ _lifted(self.from_camera)


@dataclass(frozen=True)
class Judged:
    """What was found about the poses."""

    findings: list[Finding]
    poses: list[np.ndarray]  # world_from_camera of the sample in the best reading
    factor: float = 1.0  # by which depth must be multiplied
    blind: bool = False  # the depth images show nothing that poses could be judged by


def judge(shots: Sequence[Shot], reading: Reading, depth_unit_m: float = 0.0) -> Judged:
    """Compare how well depth agrees under the poses as read and under other readings, units and focal lengths.

    `depth_unit_m` is the unit of depth in the files, 0 = that of the shots.
    """
    views, pairs = [shot.view() for shot in shots], pairs_of(shots)
    poses = [view.world_from_camera for view in views]
    if (blind := blind_finding(views, pairs)) is not None:
        return Judged([blind], poses, blind=True)
    given = agreement(views, pairs)
    if given.share >= GOOD:
        return Judged([ok("poses", _said(given))], poses)
    if given.pairs < FEW_PAIRS and len(pairs) < FEW_PAIRS:
        return Judged([note("poses", "too few depth images overlap to say whether the poses are right")], poses)
    unit_m = depth_unit_m or shots[0].depth_scale_m
    readings = ranked_readings(views, pairs, reading)
    found = agreement(with_poses(views, reread(poses, reading, readings[0])), pairs)
    best = max(_score(found), _score(given))
    if other := (_in_other_units(views, pairs, reading, unit_m, best) or _mirrored(views, pairs, reading, given, best)):
        return other
    if _beats(found, given):
        best_poses = reread(poses, reading, readings[0])
        findings = [_other_reading(reading, readings[0], found, given)]
        findings += _other_camera(with_poses(views, best_poses), pairs, found) if found.share < GOOD else []
        return Judged(findings, best_poses)
    together = _reading_and_camera(views, pairs, reading, readings[:RUNNERS_UP])
    return together or Judged([_contradiction(given, views, pairs)], poses)


def blind_finding(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]]) -> Finding | None:
    """Why the depth images cannot tell one pose from another, if they cannot."""
    moved = [(i, j) for i, j in pairs if has_moved(views[i].world_from_camera, views[j].world_from_camera)]
    same = sum(np.array_equal(views[i].depth_m, views[j].depth_m) for i, j in moved)
    if len(moved) >= FEW_PAIRS and 2 * same > len(moved):
        text = f"{same} of {len(moved)} depth images are the same as the one before, although the camera moves"
        return problem("depth images", text, "give every frame the depth image that was taken with it")
    measured = [view.depth_m[view.depth_m > 0] for view in views]
    if not all(map(len, measured)):
        return None
    low, high = np.array([np.percentile(values, (2, 98)) for values in measured]).T
    if high.max() <= (1 + FLAT) * low.min():
        text = f"every depth image is {np.median(low):.3g} m all over: it shows no surfaces"
        return problem("depth images", text, "give measured depth along the optical axis")
    return None


def _in_other_units(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], reading: Reading, depth_unit_m: float, best: float
) -> Judged | None:
    """The unit of positions, or else of depth, with which depth agrees better than with any other reading."""
    given, poses = agreement(views, pairs), [view.world_from_camera for view in views]
    if USUAL_M[0] <= median_depth_m(views) <= USUAL_M[1]:  # depth is likely: positions are looked at first
        for unit_m, name in POSITION_UNITS_M.items():
            scaled = _moved_less(views, 1 / unit_m)
            found = agreement(scaled, pairs)
            if _beats(found, given) and _score(found) > best:
                text = _contrast(f"the positions look like {name}, not metres", found, given)
                mend = f"--position-scale {unit_m * reading.position_scale_m:.6g}"
                return Judged([problem("position unit", text, mend)], [view.world_from_camera for view in scaled])
    factor, found = best_factor(views, pairs, depth_unit_m)
    if _beats(found, given) and _score(found) > best:
        return Judged([_other_unit(depth_unit_m, factor, found, given)], poses, factor)
    return None


def _mirrored(
    views: Sequence[DepthView],
    pairs: Sequence[tuple[int, int]],
    reading: Reading,
    given: Agreement,
    best: float,
) -> Judged | None:
    """Poses of a left-handed world, when depth agrees better with their mirror image than with any other reading."""
    few = list(pairs[:: max(1, len(pairs) // SCREENED_PAIRS)])
    written = [view.world_from_camera for view in views]
    tried = []
    for other in _named_readings(reading):
        for axis in range(3):
            mirror = np.eye(4)
            mirror[axis, axis] = -1.0
            poses = [mirror @ pose @ mirror for pose in reread(written, reading, other)]
            tried.append((_score(agreement(with_poses(views, poses), few)), poses))
    poses = max(tried, key=lambda item: item[0])[1]
    found = agreement(with_poses(views, poses), pairs)
    if not (_beats(found, given) and _score(found) > best + ALIKE):
        return None
    text = _contrast("the poses look mirrored, as those of a left-handed world", found, given)
    return Judged([problem("poses", text, UNMIRROR)], poses)


def _reading_and_camera(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], reading: Reading, others: Sequence[Reading]
) -> Judged | None:
    """The first of several readings that convinces with another focal length; the reading as it is goes first."""
    given = agreement(views, pairs)
    for other in (reading, *others):
        poses = reread([view.world_from_camera for view in views], reading, other)
        moved = with_poses(views, poses)
        if camera := _other_camera(moved, pairs, given, strict=other is not reading):
            turned = [_other_reading(reading, other, agreement(moved, pairs), given)] if other is not reading else []
            return Judged([*turned, *camera], poses)
    return None


def _other_reading(reading: Reading, better: Reading, found: Agreement, given: Agreement) -> Finding:
    options = " ".join(changes(reading, better)) or CONVERT
    return problem("poses", _contrast(described(reading, better), found, given), options)


def _other_unit(scale_m: float, factor: float, found: Agreement, given: Agreement) -> Finding:
    looks = f"the unit of depth looks like {scale_m * factor:.6g} m, not {scale_m:.6g} m"
    return problem("depth unit", _contrast(looks, found, given), f"--depth-scale {scale_m * factor:.6g}")


def _other_camera(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], given: Agreement, *, strict: bool = False
) -> list[Finding]:
    """Another focal length, where depth agrees better with it; `strict`: so much that it explains everything."""
    tried = {factor: agreement([_focused(view, factor) for view in views], pairs) for factor in FOCAL_FACTORS}
    factor, found = max(tried.items(), key=lambda item: _score(item[1]))
    gains = found.share > given.share + SMALL_GAIN and _score(found) > _score(given)
    if not (_beats(found, given) or (gains and not strict)):
        return []
    camera = _focused(views[0], factor).intrinsics
    looks = f"the focal length looks like {camera.fx_px:.0f} px, not {views[0].intrinsics.fx_px:.0f} px"
    about = f"{camera.fx_px:.0f},{camera.fy_px:.0f},{camera.cx_px:.0f},{camera.cy_px:.0f}"
    mend = f"--intrinsics {about} or better ones; --distortion, if the lens bends more or less than was said"
    return [problem("intrinsics", _contrast(looks, found, given), mend)]


def _focused(view: DepthView, factor: float) -> DepthView:
    camera = view.intrinsics
    return replace(
        view,
        intrinsics=msgspec.structs.replace(camera, fx_px=camera.fx_px * factor, fy_px=camera.fy_px * factor),
    )


def _contradiction(given: Agreement, views: Sequence[DepthView], pairs: Sequence[tuple[int, int]]) -> Finding:
    along_ray = agreement([replace(view, depth_m=_along_axis(view)) for view in views], pairs)
    if _beats(along_ray, given):
        text = _contrast("depth looks measured along the ray, not along the optical axis", along_ray, given)
        return problem("poses", text, "convert it to depth along the optical axis")
    if given.pairs < FEW_PAIRS:
        return note("poses", "too few depth images overlap to say whether the poses are right")
    if given.share < CONTRADICTED:
        text = f"depth contradicts the poses, and no other convention does better: {_said(given)}"
        return problem("poses", text, "check that poses, depth and intrinsics belong together")
    return note("poses", f"depth and poses agree moderately: {_said(given)}")


def _along_axis(view: DepthView) -> np.ndarray:
    camera = view.intrinsics
    v, u = np.indices(view.depth_m.shape)
    x, y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
    return view.depth_m / np.sqrt(1 + x * x + y * y)


def ranked_readings(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], reading: Reading) -> list[Reading]:
    """Readings of the same written poses by how well depth agrees; of the best alike, what changes least first.

    Camera axes without a name are only tried where none with a name convinces.
    """
    few = list(pairs[:: max(1, len(pairs) // SCREENED_PAIRS)])
    given = [view.world_from_camera for view in views]

    def score(other: Reading) -> float:
        return _score(agreement(with_poses(views, reread(given, reading, other)), few))

    scored = [(other, score(other)) for other in _named_readings(reading)]
    if max(value for _, value in scored) < CONVINCING:
        scored += [(other, score(other)) for other in _nameless_readings(reading)]
    scored.sort(key=lambda item: -item[1])
    alike = sum(value >= scored[0][1] - ALIKE for _, value in scored)
    near = sorted((other for other, _ in scored[:alike]), key=lambda other: _changed(reading, other))
    return near + [other for other, _ in scored[alike:]]


def best_factor(
    views: Sequence[DepthView], pairs: Sequence[tuple[int, int]], scale_m: float
) -> tuple[float, Agreement]:
    """The factor of depth that makes `scale_m` a usual unit with which depth agrees best, and how well.

    Positions are divided instead of depth multiplied, so that the tolerance stays what it is. Units with which no
    room or street would be seen are left out; of units alike, that which makes a room of it is taken.
    """
    few = list(pairs[:: max(1, len(pairs) // SCREENED_PAIRS)])
    median_m = median_depth_m(views)
    factors = [unit_m / scale_m for unit_m in SCALES_M]
    likely = [factor for factor in factors if USUAL_M[0] <= median_m * factor <= USUAL_M[1]]
    scores = {factor: _score(agreement(_moved_less(views, factor), few)) for factor in likely}
    if not scores:
        return 1.0, NOTHING
    near = [factor for factor, score in scores.items() if score >= max(scores.values()) - ALIKE / 3]
    chosen = min(near, key=lambda factor: abs(np.log(median_m * factor / LIKELY_M)))
    return chosen, agreement(_moved_less(views, chosen), pairs)


def median_depth_m(views: Sequence[DepthView]) -> float:
    """Of all measurements, as they were read."""
    return float(np.median(np.concatenate([grid_points(view)[:, 2] for view in views]) if views else 0.0))


def _moved_less(views: Sequence[DepthView], factor: float) -> list[DepthView]:
    poses = [view.world_from_camera.copy() for view in views]
    for pose in poses:
        pose[:3, 3] /= factor
    return with_poses(views, poses)


def reread(poses: Sequence[np.ndarray], reading: Reading, other: Reading) -> list[np.ndarray]:
    """The poses that `other` makes of what `reading` made `poses` of."""
    swaps = other.quaternion != reading.quaternion
    written = (reading.written(pose) for pose in poses)
    return [other.read(_reordered(motion, other.quaternion) if swaps else motion) for motion in written]


def changes(reading: Reading, other: Reading) -> list[str]:
    """The options that turn one reading into the other."""
    found = [f"--poses {other.poses}"] if other.poses != reading.poses else []
    found += [f"--quaternion {other.quaternion}"] if other.quaternion != reading.quaternion else []
    return found + ([f"--axes {other.axes}"] if other.axes and other.axes != reading.axes else [])


def described(reading: Reading, other: Reading) -> str:
    """One phrase for what the written poses look like."""
    parts = [other.poses] if other.poses != reading.poses else []
    parts += [f"quaternions in the order {other.quaternion}"] if other.quaternion != reading.quaternion else []
    if not np.allclose(other.from_camera, reading.from_camera):
        parts += [f"camera axes {other.axes or ''}".strip() + f" ({_axes_said(other.from_camera)})"]
    return f"the poses look like {', '.join(parts)}" if parts else "the poses look as they were read"


def rotations() -> Iterator[np.ndarray]:
    """The 24 rotations that turn axes into axes."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                yield matrix


def _named_readings(reading: Reading) -> Iterator[Reading]:
    yield reading
    if reading.fixed:
        return
    orders = reading.quaternion, OTHER[reading.quaternion]
    for way, order, (axes, matrix) in itertools.product((FORWARD, BACKWARD), orders, FROM_CAMERA.items()):
        yield replace(reading, poses=way, quaternion=order, axes=axes, from_camera=matrix)


def _nameless_readings(reading: Reading) -> Iterator[Reading]:
    if reading.fixed:
        return
    for way, matrix in itertools.product((FORWARD, BACKWARD), rotations()):
        if not any(np.allclose(matrix, known) for known in FROM_CAMERA.values()):
            yield replace(reading, poses=way, axes="", from_camera=matrix)


def _changed(reading: Reading, other: Reading) -> float:
    """How much one must change to read otherwise; axes without a name count more."""
    turned = not np.allclose(other.from_camera, reading.from_camera)
    return (
        (other.poses != reading.poses)
        + (other.quaternion != reading.quaternion)
        + turned * (1.0 if other.axes else 2.5)
    )


def _reordered(motion: np.ndarray, order: str) -> np.ndarray:
    """The motion whose quaternion has the numbers of this one's read in `order` instead of the other one."""
    quaternion_xyzw = quaternion_of(motion)
    return pose_from_quaternion(motion[:3, 3], np.roll(quaternion_xyzw, -1 if order == "wxyz" else 1))


def _score(found: Agreement) -> float:
    """The share, less where views that follow each other hardly overlap."""
    return 0.0 if np.isnan(found.share) else found.share * found.overlap / (found.overlap + 0.1)


def _beats(found: Agreement, given: Agreement) -> bool:
    share = 0.0 if np.isnan(given.share) else given.share
    return found.pairs >= FEW_PAIRS and found.share >= max(POOR, share + GAIN) and _score(found) > 1.15 * _score(given)


def _contrast(looks: str, found: Agreement, given: Agreement) -> str:
    share = 0.0 if np.isnan(given.share) else given.share
    return f"{looks}: depth agrees in {found.share:.0%} instead of {share:.0%} of the points"


def _said(found: Agreement) -> str:
    error = f", median error {found.median_error_m * 1000:.0f} mm" if found.pairs else ""
    share = f"{found.share:.0%}" if found.pairs else "none"
    return f"depth agrees in {share} of the points{error}, over {found.pairs} pairs of frames"


def _axes_said(from_camera: np.ndarray) -> str:
    """Where each written axis points in the image."""
    words = []
    for name, row in zip("xyz", from_camera, strict=True):
        axis = int(np.argmax(np.abs(row)))
        words.append(f"{name} {DIRECTIONS[int(row[axis] < 0)][axis]}")
    return ", ".join(words)


def _lifted(rotation: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = rotation
    return motion
