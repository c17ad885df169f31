"""What is read of a run's processes, and how it is summed up."""

import subprocess
import sys

import psutil
import pytest

from prior_sg.deploy.benches.footprint import COMMAND, SERVE, Memory, look, memory_of, summed
from prior_sg.services.roles import NAMES

IDLE = "import sys, time; print(flush=True); time.sleep(60)"


MAPPED = """
import mmap, sys, time
own = bytearray(b"1") * 60_000_000
with open(sys.argv[1], "rb") as file:
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
sum(mapped[::4096])
print(flush=True)
time.sleep(60)
"""


def every(mb, own_mb=1.0, **of):
    return {name: Memory(of.get(name, mb), 1.0, own_mb) for name in (*NAMES, COMMAND)}


def test_processes_are_known_by_their_service_and_workers_are_one():
    named = ("segmenter", "feature_pyramid", "feature_pyramid", "no_service_of_ours")
    modules = [SERVE, SERVE, SERVE, "another.module"]
    processes = [
        subprocess.Popen([sys.executable, "-c", IDLE, module, name], stdout=subprocess.PIPE)
        for module, name in zip(modules, named, strict=True)
    ]
    try:
        for process in processes:
            process.stdout.readline()
        found = look(psutil.Process())
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert set(found) == {COMMAND, "segmenter", "feature_pyramid"}
    assert found["feature_pyramid"].mb == pytest.approx(2 * found["segmenter"].mb, rel=0.1)
    assert 0 < found["segmenter"].own_mb < found["segmenter"].share_mb <= found["segmenter"].mb


def test_pages_of_files_are_resident_but_not_a_process_own(tmp_path):
    (tmp_path / "library").write_bytes(b"1" * 40_000_000)
    process = subprocess.Popen([sys.executable, "-c", MAPPED, tmp_path / "library"], stdout=subprocess.PIPE)
    try:
        process.stdout.readline()
        found = memory_of(process.pid)
    finally:
        process.kill()
        process.wait()
    assert found.mb > 100.0 and 60.0 < found.own_mb < 80.0


def test_start_end_and_most_of_each_and_of_all():
    start = {"segmenter": Memory(50.0, 20.0, 10.0)}
    partly = {"segmenter": Memory(900.0, 900.0, 900.0)}  # while the others are gone
    found = summed(start, [every(100.0), every(100.0, segmenter=400.0), every(120.0, 2.0), partly])
    assert (found["segmenter_start_mb"], found["segmenter_end_mb"], found["segmenter_most_mb"]) == (50.0, 120.0, 400.0)
    assert found["segmenter_start_share_mb"] == 20.0 and "ingest_start_mb" not in found
    assert (found["total_end_mb"], found["total_most_mb"], found["total_end_share_mb"]) == (840.0, 1000.0, 7.0)
    assert (found["segmenter_start_own_mb"], found["total_end_own_mb"]) == (10.0, 14.0)


def test_each_kind_of_memory_is_at_most_what_it_was_at_any_look():
    found = summed({}, [every(100.0, 5.0), every(120.0, 2.0)])
    assert (found["scene_store_most_mb"], found["scene_store_most_own_mb"]) == (120.0, 5.0)
    assert (found["total_most_mb"], found["total_most_own_mb"]) == (840.0, 35.0)


def test_a_run_that_never_stood_has_no_figures():
    with pytest.raises(RuntimeError, match="never stood"):
        summed({}, [{COMMAND: Memory(1.0, 1.0, 1.0)}])
