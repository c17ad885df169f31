"""Why a path is no source: what it is instead, or what it lacks, and what to do."""

from collections.abc import Callable
from pathlib import Path

from prior_sg.services.ingest.sources import dataset, own_files, pose_lists

FOLDERS_LOOKED_AT, NAMED = 200, 5
RECORDINGS = (".mcap", ".db3", ".bag")
KINDS = {
    (".zstd",): "it is a packed part of a ROS bag: give the folder that holds it and its metadata.yaml",
    (".zip", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".7z", ".rar"): "it is an archive: unpack it and give the folder",
    (".ply", ".pcd", ".obj", ".glb", ".stl", ".las", ".laz"): "it holds geometry without images: give the recording",
    (".mp4", ".avi", ".mov", ".mkv", ".webm"): "it is a film without depth and poses: give a folder with these",
    (".sens",): "it is a packed ScanNet scan: export it with SensReader and give the folder",
    (".json", ".csv", ".txt", ".log", ".yaml", ".yml"): "it is one file of a recording: give the folder that holds it",
}


def hint(path: Path, fits: Callable[[Path], bool]) -> str:
    """One phrase on a path that has no layout, empty when nothing better can be said; `fits` tells sources."""
    if not path.is_dir():
        return next((said for endings, said in KINDS.items() if path.suffix.lower() in endings), "it is no folder")
    children = sorted(child for child in path.iterdir() if not child.name.startswith("."))
    if not children:
        return "it is an empty folder"
    inner = [child.name for child in children[:FOLDERS_LOOKED_AT] if child.is_dir() and fits(child)]
    if inner:
        return f"these folders in it are sources, give one of them: {', '.join(inner[:NAMED])}"
    files = [child.name for child in children if child.suffix in RECORDINGS]
    return f"it holds recordings, give one of them: {', '.join(files[:NAMED])}" if files else _lacking(path)


def _lacking(path: Path) -> str:
    """What a folder lacks to be one in our layout or in one of one's own."""
    for held, missing in ((dataset.CAMERA, dataset.TRAJECTORY), (dataset.TRAJECTORY, dataset.CAMERA)):
        if (path / held).is_file() and not (path / missing).exists():
            return f"it has {held} but no {missing}"
    parts = {
        "colour (rgb/ or color/)": own_files.COLORS,
        "depth (depth/)": own_files.DEPTHS,
        "poses (pose/)": own_files.POSES,
    }
    lacks = [name for name, names in parts.items() if own_files.folder_of(path, names) is None]
    if len(lacks) != 1:
        return ""
    if "pose" not in lacks[0]:
        return f"it has no folder of {lacks[0]}"
    others = sorted(child.name for child in path.iterdir() if not child.name.startswith("."))
    held = ", ".join(name for name in others if name.lower() not in (*own_files.COLORS, *own_files.DEPTHS))
    found = f"; what lies there ({held[:120]}) is none" if held else ""
    return f"it has no folder of {lacks[0]}: understood are {pose_lists.UNDERSTOOD}{found}"
