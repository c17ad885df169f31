"""Which modules are to be pure, and whether the import contracts notice one that is not.

`python -m tests.help.planted` plants a clock in one pure module after the other, in a copy of the package, and says how
many of them the contracts caught.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.help.paths import ROOT

PLANTED = "\nimport time\n"
SAYS_PURE = re.compile(r"\([^()]*\bpure\b[^()]*\)")
# Modules outside a service's folder that are no pure ones: the list of services, and what depends on the machine.
SHELL = {f"services/{name}.py" for name in ("registry", "roles", "compiled", "compiling", "folders")}


def pure_modules(root: Path = ROOT) -> list[str]:
    """Every module of the rooms that are pure, and every other one that says of itself that it is."""
    files = [
        file.relative_to(root) for room in ("schemas", "services", "deploy") for file in root.glob(f"{room}/**/*.py")
    ]
    return sorted(module_of(file) for file in files if in_a_pure_room(file) or says_pure(root / file))


def in_a_pure_room(file: Path) -> bool:
    """Schemas, what services share without being run, and the core of each service."""
    room, *inner = file.parts
    beside = len(inner) == 1 and inner[0] != "__init__.py" and file.as_posix() not in SHELL
    return room == "schemas" or (room == "services" and (beside or inner[1:2] == ["core"]))


def says_pure(file: Path) -> bool:
    """Whether a module's docstring claims it."""
    return bool(SAYS_PURE.search(ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""))


def module_of(file: Path) -> str:
    """Name of the module in a file of the package, given from its root."""
    return ".".join(("prior_sg", *file.with_suffix("").parts)).removesuffix(".__init__")


def file_of(module: str, package: Path) -> Path:
    """The file of a module in a copy of the package."""
    path = package.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def copied(folder: Path) -> Path:
    """A copy of the package and its contracts in a folder: where the package lies."""
    not_source = shutil.ignore_patterns("__pycache__", "*.nb[ci]", "*.mcap", "*.png", "*.md")
    shutil.copytree(ROOT / "src" / "prior_sg", folder / "prior_sg", ignore=not_source)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder / "prior_sg"


def caught(package: Path) -> set[str]:
    """Modules that the contracts name for importing a clock."""
    code = "from importlinter.cli import lint_imports_command as check; check()"
    environment = os.environ | {"PYTHONPATH": str(package.parent), "COLUMNS": "200"}
    command = [sys.executable, "-c", code, "--no-cache"]
    ran = subprocess.run(command, cwd=package.parent, env=environment, capture_output=True, text=True, check=False)
    found = set(re.findall(r"(prior_sg[\w.]*) -> time\b", ran.stdout))
    if (ran.returncode == 0) == bool(found):
        raise RuntimeError(ran.stdout + ran.stderr)
    return found


def one_by_one() -> tuple[int, int]:
    """In how many pure modules a clock was planted, and how many of those alone the contracts caught. Minutes."""
    modules, noticed = pure_modules(), 0
    with tempfile.TemporaryDirectory() as folder:
        package = copied(Path(folder))
        for module in modules:
            file = file_of(module, package)
            before = file.read_text(encoding="utf-8")
            file.write_text(before + PLANTED, encoding="utf-8")
            noticed += caught(package) == {module}
            file.write_text(before, encoding="utf-8")
    return len(modules), noticed


if __name__ == "__main__":
    planted, noticed = one_by_one()
    print(f"{planted} planted, {noticed} caught")
    sys.exit(planted != noticed)
