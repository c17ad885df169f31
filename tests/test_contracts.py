"""The architecture: pure modules stay pure, cores know nothing of their shells, and nothing imports in circles."""

import ast
import re

import grimp
import pytest

from tests.help.paths import ROOT
from tests.help.planted import PLANTED, caught, copied, file_of, in_a_pure_room, pure_modules

IMPURE_CALLS = re.compile(
    r"(open|print|input|(np|numpy)\.(load|save|savez\w*|loadtxt|savetxt|genfromtxt|fromfile|memmap|random\..+)"
    r"|cv2\.(imread|imwrite|VideoCapture))"
)


@pytest.fixture(scope="module")
def imports():
    """Who imports whom, within the package, also inside functions."""
    graph = grimp.build_graph("prior_sg", cache_dir=None)
    return {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}


def test_a_clock_in_any_pure_module_breaks_a_contract(tmp_path):
    package, modules = copied(tmp_path), pure_modules()
    assert caught(package) == set()
    for module in modules:
        file = file_of(module, package)
        file.write_text(file.read_text(encoding="utf-8") + PLANTED, encoding="utf-8")
    assert caught(package) == set(modules)


def test_the_pure_rooms_are_found():
    found = pure_modules()
    for module in ("schemas.codec", "services.geometry", "services.segmenter.core.energy.bound"):
        assert f"prior_sg.{module}" in found
    for module in ("services.registry", "services.runtime.bus", "services.feature_pyramid.worker", "services"):
        assert f"prior_sg.{module}" not in found


def test_pure_modules_call_nothing_that_touches_the_world():
    """What imports cannot show: files opened, terminals written, hidden random numbers."""
    faults = []
    for module in pure_modules():
        file = file_of(module, ROOT / "src" / "prior_sg")
        calls = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)]
        faults += [f"{module}:{c.lineno}" for c in calls if IMPURE_CALLS.fullmatch(ast.unparse(c.func))]
    assert faults == []


def test_cores_import_nothing_else_of_their_service(imports):
    core = re.compile(r"(prior_sg\.services\.\w+)\.core\b")
    faults = [
        f"{module} imports {other}"
        for module, others in imports.items()
        if (inside := core.match(module))
        for other in others
        if other.startswith(inside[1]) and not other.startswith(inside[0])
    ]
    assert faults == []


def test_services_import_in_no_circle(imports):
    """Every module can be put after all that it imports."""
    left = {module: others for module, others in imports.items() if module.startswith("prior_sg.services")}
    while ready := [module for module, others in left.items() if not others & left.keys()]:
        for module in ready:
            del left[module]
    assert sorted(left) == []


def test_shared_modules_beside_the_services_are_in_the_pure_room():
    shared = [file.relative_to(ROOT) for file in (ROOT / "services").glob("*.py")]
    assert {file.stem for file in shared if not in_a_pure_room(file)} == {
        "__init__",
        "registry",
        "roles",
        "compiled",
        "compiling",
        "folders",
    }
