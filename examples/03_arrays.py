"""Frames from arrays in memory, as a simulator or a driver has them: a bare room of 4 x 4 x 2.6 m, drawn here.

python examples/03_arrays.py
"""

import numpy as np

import prior_sg

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 160.0
CAMERA = np.array(((FOCAL_PX, 0, 159.5), (0, FOCAL_PX, 119.5), (0, 0, 1)))
LOW_M, HIGH_M = np.array((0.0, 0.0, 0.0)), np.array((4.0, 4.0, 2.6))


def pose(x_m: float, y_m: float, turn_rad: float) -> np.ndarray:
    """world_from_camera (4, 4) of a level camera 1.3 m above the floor."""
    forward, down = np.array((np.cos(turn_rad), np.sin(turn_rad), 0.0)), np.array((0.0, 0.0, -1.0))
    world_from_camera = np.eye(4)
    world_from_camera[:3] = np.stack((np.cross(down, forward), down, forward, (x_m, y_m, 1.3)), axis=1)
    return world_from_camera


def depth_of_room(world_from_camera: np.ndarray) -> np.ndarray:
    """Depth image (h, w), metres, of the walls around the camera."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays_camera = np.stack(((u - 159.5) / FOCAL_PX, (v - 119.5) / FOCAL_PX, np.ones_like(u)), axis=-1)
    rays_world = rays_camera @ world_from_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        ways_m = (np.where(rays_world > 0, HIGH_M, LOW_M) - world_from_camera[:3, 3]) / rays_world
    return np.where(np.isfinite(ways_m), ways_m, np.inf).min(axis=-1)


def main() -> prior_sg.Scene:
    """Print what a camera that turns in two spots of the room makes of it."""
    color = np.full((HEIGHT, WIDTH, 3), (200, 180, 150), np.uint8)
    with prior_sg.Mapper(environment="residential home", task="real-estate listing") as mapper:
        for number in range(12):
            view = pose(1.4 if number < 6 else 2.6, 2.0, number * np.pi / 3)
            mapper.add(
                color=color,
                depth=depth_of_room(view),
                intrinsics=CAMERA,
                world_from_camera=view,
                stamp_ns=number * 500_000_000,
            )
        scene = mapper.scene
    print(scene)
    print("highest place:", scene.places.positions_m[:, 2].max(), "m; widest:", scene.places.radii_m.max(), "m")
    return scene


if __name__ == "__main__":
    main()
