"""Who may import whom, and how large a file or a function may be (ARCHITECTURE.md, section 1)."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("rodif_core", "server", "worker", "labeling_ui", "migrations")
MAX_FILE_LINES = 700
MAX_FUNCTION_LINES = 60
MIGRATION_FOLDER = ROOT / "migrations" / "versions"  # one straight list of statements each

# What the REST side may know of the mathematics: names, errors, and the noise in labels.
CORE_FOR_SERVER = {"rodif_core", "rodif_core.spec", "rodif_core.errors", "rodif_core.preferences"}
CORE_FOR_SERVER |= {"rodif_core.preferences.noise"}
HEAVY = {"torch", "mujoco", "viser", "gymnasium", "safetensors", "trimesh", "imageio"}
SERVICE = {"fastapi", "starlette", "uvicorn", "sqlalchemy", "alembic", "celery", "kombu"}
SERVICE |= {"pydantic", "pydantic_settings", "viser", "httpx2", "jinja2"}
TORCH_FREE_CORE = ("rodif_core.spec", "rodif_core.errors", "rodif_core.trajectory")
TORCH_FREE_CORE += ("rodif_core.gate", "rodif_core.preferences")


@dataclass(frozen=True)
class Import:
    """One imported module, and whether it happens when the importing module is loaded."""

    target: str
    when_loaded: bool


def files_of(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> dict[str, Path]:
    return {module_name(path): path for room in ROOMS for path in files_of(room)}


@cache
def imports_of(path: Path) -> frozenset[Import]:
    found = set()
    for node, when_loaded in walk(ast.parse(path.read_text()), when_loaded=True):
        if isinstance(node, ast.Import):
            found |= {Import(alias.name, when_loaded) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = absolute(path, node)
            found.add(Import(base, when_loaded))
            found |= {
                Import(f"{base}.{alias.name}", when_loaded)
                for alias in node.names
                if f"{base}.{alias.name}" in modules()
            }
    return frozenset(found)


def walk(node: ast.AST, *, when_loaded: bool) -> Iterator[tuple[ast.AST, bool]]:
    """All nodes; code in functions and under TYPE_CHECKING does not run when loading."""
    yield node, when_loaded
    for child in ast.iter_child_nodes(node):
        later = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            later = True
        yield from walk(child, when_loaded=when_loaded and not later)


def absolute(path: Path, node: ast.ImportFrom) -> str:
    if node.level == 0:
        return node.module or ""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    base = package[: len(package) - node.level + 1]
    return ".".join([*base, node.module] if node.module else base)


def within(target: str, packages: Iterable[str]) -> bool:
    return any(target == name or target.startswith(f"{name}.") for name in packages)


def offences(room: str, forbidden: Iterable[str], allowed: Iterable[str] = ()) -> list[str]:
    return [
        f"{path.relative_to(ROOT)} imports {item.target}"
        for path in files_of(room)
        for item in imports_of(path)
        if within(item.target, forbidden) and item.target not in set(allowed)
    ]


def test_rodif_core_imports_no_other_room():
    assert offences("rodif_core", [room for room in ROOMS if room != "rodif_core"]) == []


def test_rodif_core_knows_no_http_sql_queue_or_viewer():
    assert offences("rodif_core", SERVICE) == []


def test_server_imports_only_the_torch_free_names_of_rodif_core():
    allowed = CORE_FOR_SERVER | {
        item.target
        for path in files_of("server")
        for item in imports_of(path)
        if item.target.rpartition(".")[0] in CORE_FOR_SERVER and item.target not in modules()
    }
    assert offences("server", ["rodif_core"], allowed) == []


def test_server_imports_no_simulator_network_or_viewer():
    assert offences("server", HEAVY) == []


def test_server_never_imports_worker():
    assert offences("server", ["worker"]) == []


def test_worker_never_imports_the_api():
    assert offences("worker", ["server.api", "server.app"]) == []


def test_replays_and_pages_import_neither_server_nor_worker():
    assert offences("labeling_ui", ["server", "worker", "migrations"]) == []


def test_pages_speak_rest_only():
    site = ROOT / "labeling_ui" / "site"
    pages = [path for path in site.rglob("*") if path.suffix in (".js", ".html", ".css")]
    assert pages
    for path in pages:
        text = path.read_text().replace("http://www.w3.org/", "")  # names of XML vocabularies
        assert "http://" not in text and "https://" not in text, f"{path.name}: a foreign address"
    for path in files_of("labeling_ui/site"):
        assert not any(within(item.target, ROOMS) for item in imports_of(path)), path


@pytest.mark.parametrize("name", TORCH_FREE_CORE)
def test_shared_names_import_no_torch(name: str):
    reached = reachable(name)
    assert not any(within(target, HEAVY) for target in reached), sorted(reached)


def reachable(name: str) -> set[str]:
    """Everything that is loaded with a module of ours, and with what lies in a package of ours."""
    open_names = [module for module in modules() if within(module, [name])]
    seen: set[str] = set()
    while open_names:
        module = open_names.pop()
        if module in seen:
            continue
        seen.add(module)
        if module in modules():
            open_names += [i.target for i in imports_of(modules()[module]) if i.when_loaded]
    return seen


def test_no_import_circle():
    edges = {
        name: {
            item.target
            for item in imports_of(path)
            if item.when_loaded and item.target in modules() and item.target != name
        }
        for name, path in modules().items()
    }
    done: set[str] = set()
    trail: list[str] = []

    def visit(name: str) -> None:
        if name in done:
            return
        assert name not in trail, " → ".join([*trail[trail.index(name) :], name])
        trail.append(name)
        for target in sorted(edges[name]):
            # A module's own package holds only its docstring; `from package import module` in the
            # package itself would be a circle and is found as one.
            if not (name.startswith(f"{target}.") and not edges[target]):
                visit(target)
        trail.pop()
        done.add(name)

    for name in edges:
        visit(name)


def test_loading_the_api_loads_no_torch():
    code = f"import sys; import server.app;print(sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_no_file_is_above_700_lines():
    sizes = {path: len(path.read_text().splitlines()) for path in modules().values()}
    assert {str(p.relative_to(ROOT)): n for p, n in sizes.items() if n > MAX_FILE_LINES} == {}


def test_no_function_is_above_60_lines():
    found = {}
    for path in modules().values():
        if path.parent == MIGRATION_FOLDER:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    found[f"{path.relative_to(ROOT)}:{node.name}"] = lines
    assert found == {}


def test_a_forbidden_import_would_be_found(tmp_path: Path):
    path = tmp_path / "example.py"
    path.write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\n"
        "def f():\n    from rodif_core import rollout\n"
    )
    found = {
        item
        for node, when_loaded in walk(ast.parse(path.read_text()), when_loaded=True)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for item in [(ast.unparse(node), when_loaded)]
    }
    assert ("import torch", False) in found
    assert ("from rodif_core import rollout", False) in found
    assert ("from typing import TYPE_CHECKING", True) in found
