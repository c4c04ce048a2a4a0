"""Who may know whom, read from the sources: imports, includes, lengths of files, constants of two languages."""

import ast
import re
from pathlib import Path

import torch
from helpers.paths import CSRC, PACKAGE, needs_csrc

import diffvbd as dv
from diffvbd import energies, ops, reference, safeguards
from diffvbd.ops import coarse_arrays, regimes
from diffvbd.step import memory


def module_of(path: Path) -> str:
    """'mesh.io' for diffvbd/mesh/io.py, '' for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def running(path: Path) -> ast.Module:
    """A file without what only type checkers read."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body if not is_for_types_only(node)]
    return tree


def imports_of(path: Path) -> set[str]:
    """Absolute names of everything a file imports, lazily or not, relative imports resolved."""
    package = ["diffvbd", *path.relative_to(PACKAGE).parent.parts] if PACKAGE in path.parents else []
    found = set()
    for node in ast.walk(running(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *(node.module or "").split(".")] if node.module else base
            found |= {".".join([*base, alias.name]) for alias in node.names}
    return found


FILES = {module_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}
PYTHON = {module: imports_of(path) for module, path in FILES.items()}

# What may be imported, lowest first: each room knows only those before it. A file beside the rooms is a room of one.
ROOMS = (
    "_version", "safeguards", "mask", "checks", "distributed", "tuples", "said", "lasting", "scopes", "reference",
    "energies", "mesh", "ops", "contact",
    "model", "adjoint", "step", "rollout", "inspect", "colliders", "solvers", "losses", "viz", "testing", "", "tasks",
    "cli_mesh", "cli_scene", "cli_view", "cli", "__main__",
)  # fmt: skip
OPTIONAL = {
    "matplotlib",
    "mpl_toolkits",
    "pxr",
    "pytetwild",
    "pyvista",
    "scipy",
    "trimesh",
    "viser",
    "websockets",
}  # packages of extras
# Both only when they are asked: Model.memory() for what a rollout would take, diffvbd.contact for what users call.
UPWARD = {("model.model", "rollout.memory"), ("contact", "inspect.contact")}


def arrows() -> set[tuple[str, str]]:
    """(importing module, imported module) of the package, lazy imports included."""
    found = set()
    for module, imports in PYTHON.items():
        for name in imports:
            if name.split(".")[0] != "diffvbd":
                continue
            parts = name.split(".")[1:]
            while parts and ".".join(parts) not in FILES:
                parts = parts[:-1]
            found.add((module, ".".join(parts)))
    return {(a, b) for a, b in found if a != b}


def circle(arrows: set[tuple[str, str]]) -> list[str]:
    """Modules that import one another in a circle, or none."""
    left = {module for arrow in arrows for module in arrow}
    while left:
        free = {a for a in left if not any(b in left for source, b in arrows if source == a)}
        if not free:
            return sorted(left)
        left -= free
    return []


def layer_users(layer: str) -> set[str]:
    """Modules that import diffvbd.<layer> or something in it."""
    name = f"diffvbd.{layer}"
    return {m for m, imports in PYTHON.items() if any(i == name or i.startswith(name + ".") for i in imports)}


def in_layer(module: str, layer: str) -> bool:
    return module == layer or module.startswith(layer + ".")


def test_the_sources_are_found() -> None:
    found = {"", "ops.sweep", "model.model", "step.advance", "rollout.rollout", "mesh.io", "tasks.runner"}
    assert found <= PYTHON.keys()
    assert "diffvbd.model.rest.rest_metric" in PYTHON["model.model"] and "torch" in PYTHON["step.advance"]
    assert {"model.model", "step.advance", "adjoint.routes"} <= layer_users("ops")
    assert {room.split(".")[0] for room in FILES} == set(ROOMS) and len(arrows()) > 200


def test_rooms_import_only_what_lies_below() -> None:
    def floor(module: str) -> int:
        return ROOMS.index(module.split(".")[0])

    up = {(a, b) for a, b in arrows() if floor(b) > floor(a)}
    assert up == UPWARD


def test_no_files_import_each_other_in_a_circle() -> None:
    assert not circle(arrows() - UPWARD)
    assert circle({("a", "b"), ("b", "c"), ("c", "a"), ("c", "d")}) == ["a", "b", "c"]


def test_mesh_and_ops_stand_alone() -> None:
    for module, imports in PYTHON.items():
        inside = {i for i in imports if i.startswith("diffvbd")}
        if in_layer(module, "mesh"):
            assert all(i.startswith("diffvbd.mesh") for i in inside), module
            assert not any(i.split(".")[0] == "torch" for i in imports), module
        if module == "ops.build_cuda":
            assert not inside
    assert layer_users("ops.load") <= {m for m in PYTHON if in_layer(m, "ops")}


def test_reference_is_independent_of_what_it_checks() -> None:
    """It takes a Model as an argument; it imports nothing of the package but itself."""
    modules = [m for m in PYTHON if in_layer(m, "reference")]
    assert len(modules) >= 5
    for module in modules:
        inside = {i for i in PYTHON[module] if i.startswith("diffvbd")}
        assert all(i.startswith("diffvbd.reference") for i in inside), module


def test_tasks_use_the_public_interface() -> None:
    public = {f"diffvbd.{name}" for name in dv.__all__} | {"diffvbd", "diffvbd.losses", "diffvbd.viz"}
    public.add("diffvbd.mesh.write.replace")  # how a file is written so that a full disk leaves no half of it
    for module, imports in PYTHON.items():
        if in_layer(module, "tasks"):
            inside = {i for i in imports if i.startswith("diffvbd") and not i.startswith("diffvbd.tasks")}
            assert inside <= public, module


def test_nothing_imports_tests_or_benchmarks_and_dependencies_are_declared() -> None:
    roots = {(m, i.split(".")[0]) for m, imports in PYTHON.items() for i in imports}
    assert not {(m, i) for m, i in roots if i in ("tests", "bench", "pytest", "hypothesis", "conftest")}
    importers = {m for m, i in roots if i in OPTIONAL}
    allowed = {"mesh.read", "mesh.repair", "mesh.tetrahedralize", "mesh.usd", "testing.scenes"}
    assert {m for m in importers if not m.startswith("viz.")} <= allowed


def test_optional_packages_are_imported_where_they_are_used() -> None:
    """Not at the top of a file: import diffvbd works without them."""
    for path in PACKAGE.rglob("*.py"):
        top = [
            n for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, (ast.Import, ast.ImportFrom))
        ]
        names = {a.name.split(".")[0] for n in top if isinstance(n, ast.Import) for a in n.names}
        names |= {(n.module or "").split(".")[0] for n in top if isinstance(n, ast.ImportFrom)}
        assert not names & OPTIONAL, path.name


def test_only_ops_names_the_compiled_operators() -> None:
    """One file loads the objects, one room knows what is in them."""

    def naming(pattern: str) -> set[str]:
        texts = {module_of(path): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
        return {module for module, text in texts.items() if re.search(pattern, text)}

    assert naming(r"\bload_library\b") == {"ops.load"}
    named = naming(r"\btorch\.ops\b|\btorch\.library\b|\bdiffvbd::")
    assert "ops.sweep" in named and all(in_layer(module, "ops") for module in named), named


# --- C++ --------------------------------------------------------------------------------------------------------------


CPP = (".h", ".cpp", ".cu", ".cuh")
TORCH = r"torch|ATen|c10|Python\.h"


def sources(folder: str) -> list[Path]:
    return sorted(p for p in (CSRC / folder).rglob("*") if p.suffix in CPP)


def includes(path: Path) -> list[str]:
    return re.findall(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]', path.read_text(encoding="utf-8"), re.MULTILINE)


def code_of(path: Path) -> str:
    """Text without comments."""
    return re.sub(r"//[^\n]*", "", path.read_text(encoding="utf-8"))


def targets(path: Path) -> set[str]:
    """Files of csrc that a file includes, relative to csrc."""
    found = [(path.parent / name).resolve() for name in includes(path)]
    return {t.relative_to(CSRC.resolve()).as_posix() for t in found if CSRC.resolve() in t.parents and t.exists()}


# lowest first: each folder includes only what comes before it, and cpu and cuda not each other
CPP_ROOMS = ("core", "energies", "sweep", "contact", "subspace", "cpu", "cuda", "bind")
SHARED = CPP_ROOMS[: CPP_ROOMS.index("cpu")]


def inclusions() -> set[tuple[str, str]]:
    paths = [path for folder in CPP_ROOMS for path in sources(folder)]
    return {(path.relative_to(CSRC).as_posix(), target) for path in paths for target in targets(path)}


@needs_csrc
def test_shared_headers_know_no_torch() -> None:
    for folder, files in {"core": 3, "energies": 3, "sweep": 3, "contact": 3, "subspace": 3}.items():
        assert folder in SHARED
        paths = sources(folder)
        assert len(paths) >= files
        for path in paths:
            assert path.suffix == ".h", path
            text = path.read_text(encoding="utf-8")
            assert not any(re.match(rf"{TORCH}|cuda", name) for name in includes(path)), path
            assert "torch::" not in text and "at::" not in text, path


@needs_csrc
def test_cpp_rooms_include_only_what_lies_below() -> None:
    assert sorted(p.name for p in CSRC.iterdir()) == sorted(CPP_ROOMS)
    found = inclusions()
    assert len(found) > 100
    for path, target in found:
        (upper, *upper_names), (lower, *_) = path.split("/"), target.split("/")
        assert CPP_ROOMS.index(lower) <= CPP_ROOMS.index(upper), f"{path} includes {target}"
        backend = {"cpu": "cuda", "cuda": "cpu"}.get(upper_names[0] if upper == "bind" else upper)
        assert backend not in target.split("/")[:2], f"{path} includes {target}"
    assert not circle(found)
    # schemas are text: of ours they include the lists of fields alone
    assert {target for path, target in found if path == "bind/schema.cpp"} == {"bind/fields.h"}


@needs_csrc
def test_tensors_end_where_the_operators_are_registered() -> None:
    """Everything behind works on raw pointers; of torch the CPU's loops know the thread pool, CUDA's nothing."""
    bindings = set(sources("bind"))
    assert len(bindings) >= 12
    assert {p for p in sources(".") if re.search(r"\bTensor\b", code_of(p))} <= bindings
    names = {kind: {p.name for p in sources(f"bind/{kind}") if p.suffix == ".cpp"} for kind in ("cpu", "cuda")}
    assert names["cpu"] - {"anderson.cpp"} == names["cuda"]  # which CUDA has in torch
    for path in sources("cuda"):
        assert path.suffix in (".cu", ".cuh", ".h"), path
        assert not any(re.match(TORCH, name) for name in includes(path)), path


# --- twins ------------------------------------------------------------------------------------------------------------


def constant(path: str, name: str) -> int:
    """Value of `constexpr int ..., name = n, ...;`, where n may be written as `int64_t{a} << b`."""
    statements = re.findall(r"constexpr int(?:64_t)? ([^;]*);", code_of(CSRC / path))
    (value,) = [v for s in statements for v in re.findall(rf"\b{name} = ([^,]+)", s)]
    parsed = re.fullmatch(r"(?:int64_t\{(\d+)\}|(\d+))(?: << (\d+))?", value.strip())
    assert parsed, f"{name} = {value}"
    return int(parsed[1] or parsed[2]) << int(parsed[3] or 0)


@needs_csrc
def test_constants_agree_across_languages() -> None:
    assert ops.LANES == {"cpu": constant("core/views.h", "kLanes"), "cuda": constant("core/views.h", "kSlice")}
    assert ops.REST_SCALARS == constant("energies/tet.h", "rest")
    assert ops.PLAN_HEADER == constant("core/views.h", "kPlanHeader")
    assert coarse_arrays.ROW == constant("core/views.h", "kRow")
    twin = reference.coarse
    lengths = code_of(CSRC / "subspace" / "coarse.h") + code_of(CSRC / "core" / "safeguards.h")
    names = {"kFractions": twin.HALVINGS, "kDecrease": twin.DECREASE, "kRounding": twin.ROUNDING,
             "kFailures": twin.REFUSALS}  # fmt: skip
    assert {name: float(*re.findall(rf"{name} = ([\d.e-]+);", lengths)) for name in names} == names
    matrix = code_of(CSRC / "subspace" / "coarse_matrix.h")
    assert float(*re.findall(r"kCollapsed = ([\d.e-]+);", matrix)) == twin.LEAST_TURN
    assert memory.WORKSPACE_BUDGET == constant("bind/cuda/sweep.h", "kWorkspaceBudget")
    floor, anchor = (CSRC / "energies" / f"{name}.h" for name in ("floor_barrier", "anchor"))
    strides = [int(re.findall(r"stride = (\d+);", p.read_text(encoding="utf-8"))[0]) for p in (floor, anchor)]
    assert dv.FloorBarrier(normal=[(0, 1, 0)] * 3).count() == 3 * strides[0]
    fade = float(*re.findall(r"kFade = ([\d.]+);", code_of(CSRC / "energies" / "log_barrier.h")))
    assert fade == energies.FADE == reference.energies.FADE
    assert dv.Anchor(1.0).count() == strides[1]
    assert energies.MAX_PLANES * strides[0] + strides[1] <= constant("energies/energies.h", "kMaxEnergyData")
    guard = re.findall(r"(\d+) \* std::numeric_limits<T>::epsilon\(\)", floor.read_text(encoding="utf-8"))
    assert guard == [str(reference.energies.GUARD)] == [str(reference.rigid.GUARD)]
    start = code_of(CSRC / "energies" / "floor_start.h")
    assert float(*re.findall(r"kParallel = ([\d.e-]+);", start)) == reference.energies.PARALLEL
    assert constant("energies/floor_start.h", "kMostPlanes") == energies.MAX_PLANES


@needs_csrc
def test_regimes_and_plans_agree() -> None:
    (listed,) = re.findall(r"enum Regime \{([^}]*)\}", code_of(CSRC / "cuda" / "step.h"))
    codes = {name.lower(): int(number) for name, number in re.findall(r"\bk(\w+) = (\d+)", listed)}
    assert codes == regimes.CODES
    lanes = [constant("cuda/step.h", f"k{name}Lanes") for name in ("Few", "Some", "SomeReverse", "Many")]
    assert lanes == [regimes.FEW_LANES, regimes.SOME_LANES, regimes.SOME_REVERSE_LANES, regimes.MANY_LANES]
    assert regimes.SMALL_MESH == constant("core/views.h", "kSmallMesh") >= regimes.TINY_VERTICES
    # the host gets a plan's header in an order of its own, with active vertices, tets and slots first
    (order,) = re.findall(r"order\[kPlanHeader\] = \{([^}]*)\}", code_of(CSRC / "bind" / "cuda" / "sweep.h"))
    sizes = ops.plan_sizes(torch.arange(100), "cuda")
    assert [sizes[int(n)] for n in order.split(",")] == list(range(ops.PLAN_HEADER))
    colors = 3  # both the place of the number of colors in the header and, in this plan, that number
    assert list(sizes[ops.PLAN_HEADER :]) == [ops.PLAN_HEADER + n for n in range(colors + 1)]


@needs_csrc
def test_safeguard_constants_exist_once() -> None:
    """They reach the kernels as arguments; no header repeats them."""
    code = "".join(code_of(p) for p in sources("."))
    code = code.replace("kRestFraction = 0.9", "").replace("kKept = 0.9", "")  # others
    assert safeguards.FILTER_ETA == 0.9 and not re.search(r"\b0\.9\b", code)
    assert safeguards.SATURATION_EPS == 1e-12 and not re.search(r"\b1e-0?12\b", code)


@needs_csrc
def test_tape_rows_and_policies_agree() -> None:
    text = (CSRC / "core" / "views.h").read_text(encoding="utf-8")
    (policies,) = re.findall(r"enum TapePolicy \{([^}]*)\}", text)
    values = {name: int(number) for name, number in re.findall(r"(\w+) = (\d+)", policies)}
    assert values == {"kNoTape": ops.NO_TAPE, "kCompactTape": ops.COMPACT_TAPE, "kFullTape": ops.FULL_TAPE}


@needs_csrc
def test_the_list_of_energies_is_the_same_everywhere() -> None:
    text = (CSRC / "energies" / "energies.h").read_text(encoding="utf-8")
    (listed,) = re.findall(r"using VertexEnergies = EnergyList<([^>]*)>", text)
    assert listed.split(", ") == [kind.__name__ for kind in energies.VERTEX_ENERGIES]
    contact, first = constant("energies/energies.h", "kContact"), constant("energies/energies.h", "kFirstVertexBit")
    assert [kind.bit for kind in energies.VERTEX_ENERGIES] == [
        1 << first + k for k in range(len(energies.VERTEX_ENERGIES))
    ]
    assert dv.PairBarrier.bit == dv.Friction.bit == contact == 1 << first - 1
    (elastic,) = re.findall(r"kExactBlock = (\d+), kPaperBlock = (\d+)", text)
    assert [int(n) for n in elastic] == [dv.StableNeoHookean(block).bit for block in ("exact", "paper")]
    for kind in (dv.StableNeoHookean, *energies.VERTEX_ENERGIES):
        assert (CSRC / "energies" / f"{kind.name}.h").exists()
        assert kind.name in reference.energies.ENERGIES
