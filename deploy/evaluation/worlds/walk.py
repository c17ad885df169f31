"""How somebody goes through a world with a camera: poses of a scanner, who sees all, and of a passer-by."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from prior_sg.deploy.evaluation.worlds.plan import Plan, Room, Unbuildable
from prior_sg.deploy.evaluation.worlds.ways import CELL_M, Ways

Manner = Literal["scanner", "passer-by"]
NARROW_CELLS = 4  # half of a doorway: the middle keeps 0.35 m from both sides
ROOM_FOR_A_STAND_M2 = 36.0
MOST_STANDS = {"scanner": 4, "passer-by": 1}
AIRY_CELLS = 6  # stands keep that far from obstacles where there is room
SETTLING, STRAY_M = 4, 0.4  # rounds in which stands spread over a room, and how far off they then are
CANDIDATES = 1500  # for the stands in one room
VISITED_SHARE = 0.65  # of the regions, by a passer-by
Track = list[tuple[np.ndarray, float]]  # points on the ground, and the heading there
TURN_RAD = np.radians(40)
SPEED_M_S, TURNING_RAD_S = 0.9, 1.2
LOOK_AHEAD_M = 1.2


def walked(plan: Plan, ways: Ways, manner: Manner) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) in ns and poses (n, 4, 4) of the camera. Raises Unbuildable where a region cannot be entered."""
    rng = plan.rng
    chosen = plan.rooms if manner == "scanner" else _passed(plan.rooms, rng)
    candidates = _candidates(chosen, ways)
    stands = [_stands(room, nodes, ways, manner, rng) for room, nodes in zip(chosen, candidates, strict=True)]
    stops = _tour(ways, np.concatenate(stands), rng)
    return _poses(plan, [ways.position_m(leg) for leg in stops], manner)


def _passed(rooms: Sequence[Room], rng: np.random.Generator) -> list[Room]:
    count = max(3, round(VISITED_SHARE * len(rooms)))
    return [rooms[i] for i in sorted(rng.permutation(len(rooms))[:count].tolist())]


def _candidates(rooms: Sequence[Room], ways: Ways) -> list[np.ndarray]:
    """The nodes of each room where one may stand, all in reach of each other."""
    roomy = (ways.clearance >= NARROW_CELLS).reshape(-1)
    inside = [np.flatnonzero(_within(room, ways) & roomy) for room in rooms]
    if not all(len(nodes) for nodes in inside):
        empty = [room.label for room, nodes in zip(rooms, inside, strict=True) if not len(nodes)]
        raise Unbuildable(f"nobody can stand in {empty[0]}")
    clearance = ways.clearance.reshape(-1)
    first = max(inside, key=len)
    reached = ways.reached(int(first[np.argmax(clearance[first])]), NARROW_CELLS)
    found = [nodes[reached[nodes]] for nodes in inside]
    for room, nodes in zip(rooms, found, strict=True):
        if not len(nodes):
            raise Unbuildable(f"nobody gets into {room.label}")
    return found


def _within(room: Room, ways: Ways) -> np.ndarray:
    held = np.zeros(ways.heights.shape, bool)
    for rect in room.rects:
        low = [round((rect[k] - ways.origin_m[k]) / CELL_M) for k in (0, 1)]
        high = [round((rect[k + 2] - ways.origin_m[k]) / CELL_M) for k in (0, 1)]
        held[low[0] : high[0], low[1] : high[1]] = True
    z_m = ways.origin_m[2] + ways.heights * ways.voxel_m
    held &= (ways.heights >= 0) & (z_m >= room.z_m - 0.1) & (z_m < room.top_m - 0.1)
    return held.reshape(-1)


def _stands(room: Room, nodes: np.ndarray, ways: Ways, manner: Manner, rng: np.random.Generator) -> np.ndarray:
    """Nodes far from each other and from obstacles; more in larger rooms."""
    count = int(np.clip(round(room.area_m2 / ROOM_FOR_A_STAND_M2), 1, MOST_STANDS[manner]))
    clearance = ways.clearance.reshape(-1)[nodes]
    nodes = nodes[clearance >= min(int(clearance.max()), AIRY_CELLS)]
    nodes = nodes[rng.permutation(len(nodes))[:CANDIDATES]]
    points_m = ways.position_m(nodes)
    centers_m = points_m[rng.integers(len(points_m), size=count)]
    for _ in range(SETTLING):
        owner = np.argmin(np.linalg.norm(points_m[:, None] - centers_m, axis=2), axis=1)
        centers_m = np.stack(
            [points_m[owner == k].mean(axis=0) if (owner == k).any() else centers_m[k] for k in range(count)]
        )
    centers_m += rng.normal(0, STRAY_M, centers_m.shape) * (1, 1, 0)
    return np.unique([nodes[np.argmin(np.linalg.norm(points_m - center_m, axis=1))] for center_m in centers_m])


def _tour(ways: Ways, stands: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Ways from stand to stand, always to the nearest not yet visited; the first is the start alone."""
    here = int(stands[rng.integers(len(stands))])
    wanted = np.zeros(ways.heights.size, bool)
    wanted[stands] = True
    wanted[here] = False
    legs = [np.array([here])]
    while wanted.any():
        leg = ways.nearest(here, wanted, NARROW_CELLS)
        if not len(leg):
            raise Unbuildable("a stand cannot be reached")
        here = int(leg[-1])
        wanted[here] = False
        legs.append(leg)
    return legs


def _poses(plan: Plan, legs_m: list[np.ndarray], manner: Manner) -> tuple[np.ndarray, np.ndarray]:
    rng = plan.rng
    height_m = rng.uniform(1.25, 1.55)
    down_rad = np.radians(rng.uniform(4, 12))
    track: Track = []
    for points_m in legs_m:
        track += _stride(plan, points_m, manner) if len(points_m) > 1 else []
        track += _turned(points_m[-1], track[-1][1] if track else 0.0, rng) if manner == "scanner" else []
    track = _with_turns(track)
    stamps, poses, now_s = [], [], 0.0
    for index, (ground_m, yaw) in enumerate(track):
        if index:
            before_m, before_yaw = track[index - 1]
            turned = abs(_wrapped(yaw - before_yaw)) / TURNING_RAD_S
            now_s += max(0.2, float(np.linalg.norm(ground_m - before_m)) / SPEED_M_S, turned)
        eye_m = ground_m + np.array([0, 0, height_m + rng.normal(0, 0.02)])
        poses.append(_looking(eye_m, yaw, down_rad + rng.normal(0, 0.05), rng.normal(0, 0.015)))
        stamps.append(round(now_s * 1e9))
    return np.array(stamps, np.int64), np.array(poses)


def _stride(plan: Plan, points_m: np.ndarray, manner: Manner) -> Track:
    """Points along a way with the direction in which it goes on; a scanner looks around at its end."""
    rng, stride_m = plan.rng, plan.stride_m
    along_m = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))))
    sway = np.radians(6 if manner == "scanner" else 14)
    stops_m = np.arange(stride_m, along_m[-1] - (stride_m / 2 if manner == "scanner" else -0.01), stride_m)
    at_m, ahead_m = (
        np.stack([np.interp(where, along_m, points_m[:, axis]) for axis in range(3)], axis=1)
        for where in (stops_m, np.minimum(stops_m + LOOK_AHEAD_M, along_m[-1]))
    )
    track = []
    yaw = float(np.arctan2(*(points_m[-1] - points_m[0])[1::-1]))
    for here, there in zip(at_m, ahead_m, strict=True):
        if np.linalg.norm((there - here)[:2]) > 0.3:
            yaw = float(np.arctan2(there[1] - here[1], there[0] - here[0]))
        track.append((here, yaw + rng.normal(0, sway)))
    return track


def _turned(ground_m: np.ndarray, yaw: float, rng: np.random.Generator) -> Track:
    """Looking around: a full turn, in steps that overlap."""
    count = int(rng.integers(4, 6))
    sign = 1 if rng.random() < 0.5 else -1
    return [(ground_m, yaw + sign * (2 * np.pi * k / count + rng.normal(0, 0.08))) for k in range(count)]


def _with_turns(track: Track) -> Track:
    """The same with looks between two that would lie too far apart."""
    full = track[:1]
    for ground_m, yaw in track[1:]:
        before_m, before = full[-1]
        turn = _wrapped(yaw - before)
        moved = bool(np.linalg.norm(ground_m - before_m) > 0.01)
        between = int(abs(turn) / (2 * TURN_RAD)) if moved else 0
        full += [(before_m, before + turn * (k + 1) / (between + 1)) for k in range(between)]
        full.append((ground_m, yaw))
    return full


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _looking(eye_m: np.ndarray, yaw: float, down: float, roll: float) -> np.ndarray:
    """world_from_camera of a camera that looks along a heading, tilted down, rolled about its axis."""
    forward = np.array([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    below = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * below
    pose[:3, 1] = np.cos(roll) * below - np.sin(roll) * right
    pose[:3, 2] = forward
    pose[:3, 3] = eye_m
    return pose
