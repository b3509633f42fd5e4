"""The rules of the house, kept by a walk over the syntax trees of the sources.

Rooms stand in one order, and a module imports only what stands left of its own cell.
Rooms that are not built yet have their place already; a new room must take one.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import excite

ROOT = Path(excite.__file__).parent
MODULES = sorted(path.relative_to(ROOT).with_suffix("").as_posix() for path in ROOT.rglob("*.py"))
modules = pytest.mark.parametrize("module", MODULES)

CELLS = [
    {"__init__"},
    {"description", "files"},
    {"policy", "records", "safety"},
    {"plant"},
    {"excitation"},
    {"simulation"},
    {"information"},
    {"estimation"},
    {"evaluation"},
    {"objective"},
    {"env"},
    {"gymnasium_env"},
    {"training"},
    {"names"},
    {"design"},
    {"study"},
    {"engine"},
    {"rig", "identification"},
    {"benchmark"},
    {"report", "export"},
    {"live"},
    {"web"},
    {"cli"},
    {"__main__"},
]
PLACE = {room: i for i, rooms in enumerate(CELLS) for room in rooms}
PURE = CELLS[PLACE["plant"] : PLACE["training"] + 1]

DOORS = {
    "gymnasium": ["gymnasium_env"],
    "stable_baselines3": ["training/ppo"],
    "torch": ["training/ppo"],
    "optax": ["training/gradient", "design"],
    "optimistix": ["estimation/nls"],
    "optuna": ["design"],
    "safetensors": ["policy"],
    "scipy.io": ["records"],
    "pydantic": ["study"],
    "tomlkit": ["study"],
    "dask": ["engine"],
    "distributed": ["engine"],
    "onnx": ["export"],
    "fmpy": ["rig/fmu"],
    "quanser": ["rig/quanser"],
    "matplotlib": ["report"],
    "fastapi": ["web"],
    "starlette": ["web"],
    "uvicorn": ["web"],
    "flask": ["web"],
    "click": ["cli"],
    "rich": ["cli"],
}
WITHOUT_JAX = (
    "description",
    "files",
    "policy",
    "records",
    "safety",
    "rig/base",
    "rig/quanser",
    "report",
    "web",
)
INHERITED = {"derivative", "output", "from_transfer_function"}  # documented by the contract


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse((ROOT / f"{module}.py").read_text(encoding="utf-8"))


def room_of(module: str) -> str:
    return module.split("/")[0]


def belongs(module: str, places: list[str] | tuple[str, ...]) -> bool:
    return any(module == place or module.startswith(f"{place}/") for place in places)


def resolved(name: str) -> str | None:
    """The module behind a path inside the package, a folder by its `__init__`."""
    for module in (name, f"{name}/__init__" if name else "__init__"):
        if module in MODULES:
            return module
    return None


@cache
def inner_imports(module: str) -> frozenset[str]:
    """Modules of the package that a module imports, wherever in the file."""
    found = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.ImportFrom) and node.level:
            parents = [".", *module.split("/")][: -node.level]
            base = "/".join([*parents[1:], *(node.module or "").split(".")]).strip("/")
            for alias in node.names:
                target = resolved(f"{base}/{alias.name}".strip("/")) or resolved(base)
                assert target is not None, f"{module}: nothing behind {base}"
                found.add(target)
    return frozenset(found)


def outer_imports(module: str) -> Iterator[str]:
    """Dotted names of what a module imports from outside the package."""
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_outer(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def behind(module: str) -> set[str]:
    """Everything that an import of this module loads of the package, itself included."""
    seen, waiting = set(), [module]
    while waiting:
        current = waiting.pop()
        if current not in seen:
            seen.add(current)
            folders = current.split("/")[:-1]
            packages = (resolved("/".join(folders[:i])) for i in range(len(folders) + 1))
            waiting.extend([*inner_imports(current), *(p for p in packages if p)])
    return seen


# ---------------------------------------------------------------------- directions


def test_the_walk_finds_the_imports_it_is_to_judge():
    assert "plant/base" in inner_imports("plant/aero2")
    assert "description" in inner_imports("plant/aero2")
    assert "estimation/base" in behind("estimation/arx")
    assert "jax" in set(outer_imports("simulation"))


def test_every_room_has_its_place_in_the_order():
    assert {room_of(module) for module in MODULES} <= PLACE.keys()


@modules
def test_a_module_imports_only_rooms_left_of_its_own(module):
    own = room_of(module)
    for target in inner_imports(module):
        if room_of(target) == own:
            assert "/" in module, f"{module} imports {target} of its own cell"
        else:
            assert PLACE[room_of(target)] < PLACE[own], f"{module} imports {target}"


@pytest.mark.parametrize("module", [m for m in MODULES if "/" in m and room_of(m) != "cli"])
def test_inside_a_folder_base_comes_first_and_init_last(module):
    folder = module.rpartition("/")[0]
    siblings = {t for t in inner_imports(module) if t.rpartition("/")[0] == folder}
    if module.endswith("/base"):
        assert not siblings
    elif not module.endswith("/__init__"):
        assert siblings <= {f"{folder}/base"}


@modules
def test_no_module_imports_itself_in_a_circle(module):
    seen, waiting = set(), list(inner_imports(module))
    while waiting:
        current = waiting.pop()
        if current not in seen:
            seen.add(current)
            waiting.extend(inner_imports(current))
    assert module not in seen


@modules
def test_the_package_is_imported_relatively_inside_itself(module):
    assert not [name for name in outer_imports(module) if is_outer(name, "excite")]


@modules
def test_imports_stand_at_the_top_but_for_the_command_line(module):
    if room_of(module) != "cli":
        imports = (ast.Import, ast.ImportFrom)
        functions = [n for n in ast.walk(tree_of(module)) if isinstance(n, ast.FunctionDef)]
        hidden = [n.lineno for f in functions for n in ast.walk(f) if isinstance(n, imports)]
        assert not hidden


@modules
def test_third_parties_have_one_door_each(module):
    for name in outer_imports(module):
        for package, doors in DOORS.items():
            if is_outer(name, package):
                assert belongs(module, doors), f"{module} imports {name}"


@pytest.mark.parametrize("module", [m for m in MODULES if belongs(m, WITHOUT_JAX)])
def test_what_shows_and_runs_needs_no_jax(module):
    for loaded in behind(module):
        for name in outer_imports(loaded):
            assert not is_outer(name, "jax"), f"{module} loads jax through {loaded}"
            assert not is_outer(name, "equinox"), f"{module} loads equinox through {loaded}"


def test_jax_is_not_loaded_through_third_parties_either():
    rooms = [m for m in MODULES if belongs(m, WITHOUT_JAX) and m != "rig/quanser"]
    names = ", ".join("excite." + m.replace("/", ".").removesuffix(".__init__") for m in rooms)
    code = f"import sys, {names}; print(*sorted({{'jax', 'jaxlib', 'equinox'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_rig_uses_only_the_first_two_cells():
    allowed = CELLS[0] | CELLS[1] | CELLS[2] | {"rig"}
    for module in MODULES:
        if belongs(module, ("rig/base", "rig/quanser")):
            assert {room_of(m) for m in behind(module)} <= allowed, module


# ------------------------------------------------------------------ silent and pure


@modules
def test_only_the_command_line_prints(module):
    if room_of(module) != "cli":
        calls = [n.func for n in ast.walk(tree_of(module)) if isinstance(n, ast.Call)]
        assert not [f.lineno for f in calls if isinstance(f, ast.Name) and f.id == "print"]


@modules
def test_there_is_no_assert_outside_tests(module):
    assert not [n.lineno for n in ast.walk(tree_of(module)) if isinstance(n, ast.Assert)]


@pytest.mark.parametrize("module", [m for m in MODULES if any(room_of(m) in c for c in PURE)])
def test_from_plant_to_training_there_is_no_file_clock_log_or_global_state(module):
    forbidden = ("logging", "time", "datetime", "random", "os", "io", "pathlib", "numpy.random")
    for name in outer_imports(module):
        assert not any(is_outer(name, package) for package in forbidden), name
    for node in ast.walk(tree_of(module)):
        text = ast.unparse(node) if isinstance(node, ast.Attribute | ast.Call) else ""
        # Stable-Baselines3 shuffles with NumPy's global state, which checkpoints must keep.
        if module == "training/ppo" and text.startswith(("np.random.get", "np.random.set")):
            continue
        assert not text.startswith(("np.random.", "open(", "jax.config.update"))


# ------------------------------------------------------------- names, sizes, words


@modules
def test_no_room_is_named_after_no_subject(module):
    assert not {"utils", "helpers", "common", "core", "misc", "types"} & set(module.split("/"))


@modules
def test_files_are_short(module):
    num_lines = len((ROOT / f"{module}.py").read_text(encoding="utf-8").splitlines())
    assert num_lines <= 400


Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(module: str) -> list[Function]:
    return [n for n in ast.walk(tree_of(module)) if isinstance(n, Function)]


def code_lines(function: Function, lines: list[str]) -> int:
    """Lines of a function without decorators, docstring, blank lines and comments."""
    numbers = set(range(function.lineno, (function.end_lineno or 0) + 1))
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        numbers -= set(range(first.lineno, (first.end_lineno or 0) + 1))
    texts = [lines[n - 1].strip() for n in numbers]
    return sum(bool(text) and not text.startswith("#") for text in texts)


@modules
def test_functions_are_short_and_take_at_most_six_arguments(module):
    lines = (ROOT / f"{module}.py").read_text(encoding="utf-8").splitlines()
    for function in functions(module):
        where = f"{module}.{function.name}"
        num_lines, num_arguments = code_lines(function, lines), len(arguments(function))
        assert num_lines <= 60, where
        assert num_arguments <= 6, where


def arguments(function: Function) -> list[ast.arg]:
    a = function.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    return [arg for arg in every if arg.arg not in ("self", "cls")]


def public(module: str) -> Iterator[ast.ClassDef | Function]:
    """Public classes and functions of a module, and public methods of public classes."""
    waiting: list[ast.stmt] = list(tree_of(module).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node
            waiting.extend(node.body)
        elif isinstance(node, Function):
            inherited = room_of(module) == "plant" and module != "plant/base"
            special = node.name.startswith("__") and node.name != "__call__"
            private = node.name.startswith("_") and not node.name.startswith("__")
            if not (private or special or (inherited and node.name in INHERITED)):
                yield node


@modules
def test_everything_public_is_documented(module):
    assert ast.get_docstring(tree_of(module)), f"{module} has no docstring"
    missing = [node.name for node in public(module) if not ast.get_docstring(node)]
    assert not missing


@modules
def test_everything_public_is_annotated(module):
    for node in public(module):
        if isinstance(node, Function):
            assert node.returns is not None, f"{module}.{node.name} has no return annotation"
            bare = [arg.arg for arg in arguments(node) if arg.annotation is None]
            assert not bare, f"{module}.{node.name}: {bare}"
