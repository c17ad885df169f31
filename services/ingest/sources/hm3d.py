"""Walks through HM3D scenes as HOV-SG renders them with habitat-sim.

rgb/SCENE_NNNNNN.png      8 bit (1080 x 720); depth/SCENE_NNNNNN.png 16 bit, millimetres, along the optical axis
pose/SCENE_NNNNNN.txt     sixteen numbers in one line: world_from_camera

Habitat's conventions: the world has y up, and the camera x right, y UP, z BACKWARD; the loader turns both. The images
span 90 degrees horizontally and have square pixels, so fx = fy = width / 2. The renderer's axis goes through the corner
between the middle pixels, which is (width - 1) / 2 where pixel 0 has its centre at 0 (HOV-SG writes width / 2, half a
pixel beside it). Zero is the scene's own; give the floor's height as floor_m. Steps of 0.2 m or 5 degrees without
stamps: 5 Hz are assumed, a metre per second. Ground truth: poses; HOV-SG's own graph of floors, regions and objects is
not read, regions.json is where one lies beside the folders.
Source: github.com/hovsg/HOV-SG, hovsg/data/hm3dsem/habitat_utils.py (save_obs, make_sensor_spec),
hovsg/data/hm3dsem/gen_hm3dsem_walks_from_poses.py and hovsg/dataloader/hm3dsem.py (_load_pose).
"""

from functools import partial
from pathlib import Path

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    file_of,
    first_size,
    images_of,
    numbered,
    truth_beside,
)

NAME = "hm3d"
COLORS, DEPTHS, POSES = "rgb", "depth", "pose"
LOOKS = f"{COLORS}/SCENE_NNNNNN.png, {DEPTHS}/ and {POSES}/SCENE_NNNNNN.txt without a camera file (HM3D walk)"
FILE = r".+_(\d{6})\."  # plain numbers are anybody's
CAMERA_FILES = ("*intrinsic*", "*camera*", "*calib*")
UP = (0.0, 1.0, 0.0)
RATE_HZ = 5.0


def fits(path: Path) -> bool:
    """Whether a folder has this layout: HOV-SG names files by scene, and writes no camera."""
    return (
        (path / DEPTHS).is_dir()
        and bool(numbered(path / COLORS, FILE + "png") and numbered(path / POSES, FILE + "txt"))
        and not any(file for pattern in CAMERA_FILES for file in path.glob(pattern))
    )


def load(path: Path, options: ReadOptions) -> Found:
    """An HM3D walk. Raises SourceError."""
    name = FILE if numbered(path / COLORS, FILE + "png") else r"(?:.*[_-])?(\d+)\."
    colors, depths = numbered(path / COLORS, name + "png"), numbered(path / DEPTHS, name + "png")
    poses = numbered(path / POSES, name + "txt")
    width_px, height_px = first_size(list(colors.values()), path / COLORS)
    focal_px = width_px / 2
    intrinsics = Intrinsics(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
    convention = Convention(axes="opengl").changed(options)

    def entry(number: int) -> Entry:
        return Entry(
            number,
            round(number * options.frame_ns(RATE_HZ)),
            lambda: convention.of_text(file_of(poses, number, "pose")),
            partial(images_of, colors, depths, number),
        )

    return Found(
        NAME,
        path,
        Camera(intrinsics),
        MILLIMETRE,
        [entry(number) for number in sorted(colors.keys() | depths.keys() | poses.keys())],
        up=UP,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{COLORS}/, {DEPTHS}/ and {POSES}/ hold files named SCENE_NNNNNN, and no camera lies beside them",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )
