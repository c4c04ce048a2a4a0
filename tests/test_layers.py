"""Who may know whom, read from the sources: imports, includes, lengths of files, constants of two languages."""

import ast
import re
from pathlib import Path

import pytest

import diffvbd as dv
from diffvbd import energies, memory, ops, reference, safeguards

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "diffvbd"
CSRC = ROOT / "csrc"
needs_csrc = pytest.mark.skipif(not CSRC.exists(), reason="the C++ sources are not here")


def module_of(path: Path) -> str:
    """'mesh.io' for diffvbd/mesh/io.py, '' for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> set[str]:
    """Absolute names of everything a file imports, lazily or not, relative imports resolved."""
    package = ["diffvbd", *path.relative_to(PACKAGE).parent.parts] if PACKAGE in path.parents else []
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *(node.module or "").split(".")] if node.module else base
            found |= {".".join([*base, alias.name]) for alias in node.names}
    return found


PYTHON = {module_of(path): imports_of(path) for path in sorted(PACKAGE.rglob("*.py"))}


def layer_users(layer: str) -> set[str]:
    """Modules that import diffvbd.<layer> or something in it."""
    name = f"diffvbd.{layer}"
    return {m for m, imports in PYTHON.items() if any(i == name or i.startswith(name + ".") for i in imports)}


def in_layer(module: str, layer: str) -> bool:
    return module == layer or module.startswith(layer + ".")


def test_the_sources_are_found() -> None:
    assert {"", "ops", "model", "step", "rollout", "mesh.io", "reference.sweep", "tasks.runner"} <= PYTHON.keys()
    assert "diffvbd.metric.rest_metric" in PYTHON["model"] and "torch" in PYTHON["step"]
    assert {"model", "step", "adjoints"} <= layer_users("ops")


def test_layers_import_only_what_lies_below() -> None:
    layers = ("mesh", "model", "step", "rollout", "tasks")
    for low, upper in enumerate(layers):
        for module in layer_users(upper):
            below = [layer for layer in layers[:low] if in_layer(module, layer)]
            assert not below, f"{module} imports {upper}"
    assert {m for m in layer_users("tasks") if not in_layer(m, "tasks")} <= {"cli", "__main__"}


def test_mesh_and_ops_stand_alone() -> None:
    for module, imports in PYTHON.items():
        inside = {i for i in imports if i.startswith("diffvbd")}
        if in_layer(module, "mesh"):
            assert all(i.startswith("diffvbd.mesh") for i in inside), module
            assert not any(i.split(".")[0] == "torch" for i in imports), module
        if module == "ops":
            assert not inside


def test_reference_is_independent_of_what_it_checks() -> None:
    """It takes a Model as an argument; it imports nothing of the package but itself."""
    modules = [m for m in PYTHON if in_layer(m, "reference")]
    assert len(modules) >= 5
    for module in modules:
        inside = {i for i in PYTHON[module] if i.startswith("diffvbd")}
        assert all(i.startswith("diffvbd.reference") for i in inside), module


def test_tasks_use_the_public_interface() -> None:
    public = {f"diffvbd.{name}" for name in dv.__all__} | {"diffvbd", "diffvbd.losses", "diffvbd.viz"}
    for module, imports in PYTHON.items():
        if in_layer(module, "tasks"):
            inside = {i for i in imports if i.startswith("diffvbd") and not i.startswith("diffvbd.tasks")}
            assert inside <= public, module


def test_nothing_imports_tests_or_benchmarks_and_dependencies_are_declared() -> None:
    roots = {(m, i.split(".")[0]) for m, imports in PYTHON.items() for i in imports}
    assert not {(m, i) for m, i in roots if i in ("tests", "bench", "pytest", "hypothesis", "conftest")}
    optional = {"matplotlib", "mpl_toolkits", "pyvista", "pytetwild", "scipy"}
    assert {m for m, i in roots if i in optional} <= {"viz", "mesh.tetrahedralize", "testing"}


def test_optional_packages_are_imported_where_they_are_used() -> None:
    """Not at the top of a file: import diffvbd works without them."""
    for path in PACKAGE.rglob("*.py"):
        top = [
            n for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, (ast.Import, ast.ImportFrom))
        ]
        names = {a.name.split(".")[0] for n in top if isinstance(n, ast.Import) for a in n.names}
        names |= {(n.module or "").split(".")[0] for n in top if isinstance(n, ast.ImportFrom)}
        assert not names & {"matplotlib", "mpl_toolkits", "pyvista", "pytetwild", "scipy"}, path.name


def test_only_ops_names_the_compiled_operators() -> None:
    pattern = re.compile(r"torch\.ops\b|torch\.library\b|\bdiffvbd::|\bload_library\b")
    using = {path.name for path in PACKAGE.rglob("*.py") if pattern.search(path.read_text(encoding="utf-8"))}
    assert using == {"ops.py"}


# --- C++ --------------------------------------------------------------------------------------------------------------


def sources(folder: str) -> list[Path]:
    return sorted(p for p in (CSRC / folder).rglob("*") if p.suffix in (".h", ".cpp", ".cu", ".cuh"))


def includes(path: Path) -> list[str]:
    return re.findall(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]', path.read_text(encoding="utf-8"), re.MULTILINE)


def layer_includes(folder: str) -> set[str]:
    """Layers of csrc whose headers a layer includes."""
    found = set()
    for path in sources(folder):
        for name in includes(path):
            target = (path.parent / name).resolve()
            if CSRC.resolve() in target.parents:
                found.add(target.relative_to(CSRC.resolve()).parts[0])
    return found - {folder}


@needs_csrc
def test_core_and_energies_know_no_torch() -> None:
    for folder in ("core", "energies"):
        paths = sources(folder)
        assert len(paths) >= 4
        for path in paths:
            assert path.suffix == ".h", path
            text = path.read_text(encoding="utf-8")
            assert not any(re.match(r"torch|ATen|c10|Python\.h|cuda", name) for name in includes(path)), path
            assert "torch::" not in text and "at::" not in text, path


@needs_csrc
def test_cpp_layers_include_only_what_lies_below() -> None:
    assert layer_includes("energies") <= {"core"}
    # vertex.h alone knows the list of energies: it is the algorithm that runs them
    assert layer_includes("core") <= {"energies"}
    assert [p.name for p in sources("core") if any("energies/" in name for name in includes(p))] == ["vertex.h"]
    assert layer_includes("cpu") == {"core"}
    assert layer_includes("cuda") <= {"core"}


# --- files ------------------------------------------------------------------------------------------------------------


def test_files_are_short() -> None:
    folders = [f for f in (PACKAGE, CSRC, ROOT / "tests", ROOT / "bench") if f.exists()]
    paths = [p for f in folders for p in f.rglob("*") if p.suffix in (".py", ".h", ".cpp", ".cu")]
    assert len(paths) > 40
    lengths = {str(p.relative_to(ROOT)): len(p.read_text(encoding="utf-8").splitlines()) for p in paths}
    assert not {name: n for name, n in lengths.items() if n > 400}


# --- twins ------------------------------------------------------------------------------------------------------------


def constant(path: str, name: str) -> int:
    (value,) = re.findall(rf"constexpr int {name} = (\d+);", (CSRC / path).read_text(encoding="utf-8"))
    return int(value)


@needs_csrc
def test_constants_agree_across_languages() -> None:
    assert memory.LANES == constant("core/views.h", "kLanes")
    assert ops.REST_SCALARS == constant("cpu/run.cpp", "kRestScalars")
    floor, anchor = (CSRC / "energies" / f"{name}.h" for name in ("floor_barrier", "anchor"))
    strides = [int(re.findall(r"stride = (\d+);", p.read_text(encoding="utf-8"))[0]) for p in (floor, anchor)]
    assert dv.FloorBarrier(normal=[(0, 1, 0)] * 3).count() == 3 * strides[0]
    assert dv.Anchor(1.0).count() == strides[1]
    assert energies.MAX_PLANES * strides[0] + strides[1] <= constant("energies/energies.h", "kMaxEnergyData")
    guard = re.findall(r"(\d+) \* std::numeric_limits<T>::epsilon\(\)", floor.read_text(encoding="utf-8"))
    assert guard == [str(safeguards.GUARD_ULPS)]


@needs_csrc
def test_safeguard_constants_exist_once() -> None:
    """They reach the kernels as arguments; no header repeats them."""
    text = "".join(p.read_text(encoding="utf-8") for f in ("core", "energies", "cpu") for p in sources(f))
    code = re.sub(r"//[^\n]*", "", text)
    assert safeguards.FILTER_ETA == 0.9 and not re.search(r"\b0\.9\b", code)
    assert safeguards.SATURATION_EPS == 1e-12 and not re.search(r"\b1e-0?12\b", code)


@needs_csrc
def test_tape_rows_and_policies_agree() -> None:
    text = (CSRC / "cpu" / "scene.h").read_text(encoding="utf-8")
    (policies,) = re.findall(r"enum TapePolicy \{([^}]*)\}", text)
    values = {name: int(number) for name, number in re.findall(r"(\w+) = (\d+)", policies)}
    assert values == {"kNoTape": ops.NO_TAPE, "kCompactTape": ops.COMPACT_TAPE, "kFullTape": ops.FULL_TAPE}
    pattern = r"policy == kFullTape \? \(filters \? (\d+) : (\d+)\) : policy == kCompactTape \? (\d+)"
    (rows,) = re.findall(pattern, text)
    floor = dv.FloorBarrier.bit
    kinds = ((ops.FULL_TAPE, floor), (ops.FULL_TAPE, 0), (ops.COMPACT_TAPE, floor))
    assert [int(n) for n in rows] == [ops.tape_rows(*kind) for kind in kinds]
    assert ops.tape_rows(ops.NO_TAPE, floor) == 0


@needs_csrc
def test_the_list_of_energies_is_the_same_everywhere() -> None:
    text = (CSRC / "energies" / "energies.h").read_text(encoding="utf-8")
    (listed,) = re.findall(r"using VertexEnergies = EnergyList<([^>]*)>", text)
    assert listed.split(", ") == [kind.__name__ for kind in energies.VERTEX_ENERGIES]
    assert [kind.bit for kind in energies.VERTEX_ENERGIES] == [4 << k for k in range(len(energies.VERTEX_ENERGIES))]
    (elastic,) = re.findall(r"kExactBlock = (\d+), kPaperBlock = (\d+)", text)
    assert [int(n) for n in elastic] == [dv.StableNeoHookean(block).bit for block in ("exact", "paper")]
    for kind in (dv.StableNeoHookean, *energies.VERTEX_ENERGIES):
        assert (CSRC / "energies" / f"{kind.name}.h").exists()
        assert kind.name in reference.energies.ENERGIES
