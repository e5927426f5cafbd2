"""The site builds; links, commands, settings and names exist; tables are their files; the prose is plain."""

import ast
import importlib
import inspect
import re
import shlex
import sys
from collections.abc import Iterator
from functools import reduce
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), *map(ROOT.joinpath, ("README.md", "CONTRIBUTING.md", "SECURITY.md"))])
LINKING = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "benchmarks" / "README.md"]
LONGEST_SENTENCE, MOST_NUMBERS, LONGEST_LINE, WIDEST_TABLE, LONGEST_TABLE = 25, 2, 120, 6, 12
BANNED = re.compile(
    r"\b(nobody|taken? apart|told apart|comes? along|given away|rendered again|as read|encoders say|asked of|"
    r"odd (?:pictures?|images?)|go on with|goes on|gone on|pictures?|at hand|where this was written|"
    r"numbers that are none|lessons)\b",
    re.IGNORECASE,
)
HEADLESS = re.compile(rf"{BANNED.pattern}|\bwhat\b(?!.*\?$)", re.IGNORECASE)  # a question may ask it


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


sys.path.insert(0, str(DOCS))  # pages imports its tables from beside it
pages, reference = map(importlib.import_module, ("pages", "reference"))
COMMANDS = dict(reference.all_commands())


@pytest.mark.parametrize("path", LINKING, ids=named)
def test_links_files_and_names_exist(path):
    text = path.read_text(encoding="utf-8")
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", text)
    missing = [link for link in links if not (path.parent / link).exists()]
    named_file = r"`((?:src/derender|tests|benchmarks|docs|examples|lab)/)([\w/.-]+)(?:::[\w.\[\]-]+)?`"
    for folder, name in re.findall(named_file, text):
        missing += [] if (ROOT / folder / name).exists() else [folder + name]
    missing += [dotted for dotted in set(re.findall(r"`(derender(?:\.\w+)+)`", text)) if not follow(dotted)]
    for file, name in set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)):
        missing += [] if re.search(rf"def {name}\b", (ROOT / file).read_text()) else [f"{file}::{name}"]
    assert not missing


def follow(dotted: str) -> bool:
    """Whether a dotted name leads to a module or to something in one."""
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for part in parts[cut:]:
            if not hasattr(value, part):
                return False
            value = getattr(value, part)
        return True
    return False


@pytest.mark.parametrize("path", PAGES, ids=named)
def test_commands_can_be_parsed_and_settings_exist(path):
    known = script_settings()
    for block in re.findall(r"```(?:sh|console)\n(.*?)```", path.read_text(), re.DOTALL):
        for line in re.findall(r"(?:^|&& )(derender .*)", block.replace("\\\n", " "), re.MULTILINE):
            words = shlex.split(line, comments=True)
            cut = 3 if words[1] in ("evaluate", "synth") else 2
            name = " ".join(words[:cut])
            COMMANDS[name].make_context(name, words[cut:])
            keys = re.findall(r'--set "?([\w.]+)=', line)
            assert name not in ("derender train", "derender refine") or known.issuperset(keys), line


def script_settings() -> set[str]:
    """Keys of --set, whole and by their last part."""
    from derender.baselines import TRAINED, baseline_config
    from derender.training.config import FinetuneConfig
    from derender.training.distillation import RefineConfig

    flat = reference.flat
    keys = {*flat(FinetuneConfig()), *flat(RefineConfig())}
    keys |= {key for name in TRAINED for key in flat(baseline_config(name))}
    return keys | {".".join(key.split(".")[cut:]) for key in keys for cut in range(1, key.count(".") + 1)}


@pytest.mark.parametrize("path", pages.pages(), ids=named)
def test_tables_are_their_files(path):
    text = path.read_text()
    assert pages.with_tables(text) == text, "run: python docs/pages.py"


def sentences(text: str) -> list[str]:
    """Sentences of a page; code, tables, comments, and pictures are left out, a link counts as its words."""
    text = re.sub(r"```.*?```|<!--.*?-->|\$\$.*?\$\$", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"^(?:\||#|:::|!\[).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"(`+).+?\1|\$[^$]*\$", "code", text, flags=re.DOTALL)
    blocks = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text)
    return [one for block in blocks for one in re.split(r"(?<=[.!?:])\s+", " ".join(block.split())) if one]


@pytest.mark.parametrize("path", PAGES, ids=named)
def test_prose_is_plain(path):
    text = path.read_text()
    long = [one for one in sentences(text) if len(words_of(one)) > LONGEST_SENTENCE]
    wide = [line for line in text.splitlines() if len(line) > LONGEST_LINE and not line.startswith("|")]
    words = [hit[0] for one in sentences(text) for hit in HEADLESS.finditer(one) if path.name != "prose.md"]
    long += [one for one in sentences(text) if numbers_of(one) > MOST_NUMBERS]
    tables = re.findall(r"((?:^\|.*\n)+)", text, re.MULTILINE)
    large = [rows[:60] for rows in tables if rows.count("\n") - 2 > LONGEST_TABLE]
    large += [rows[:60] for rows in tables if rows.split("\n")[0].count("|") - 2 > WIDEST_TABLE]
    assert not (long + wide + words + large), "\n".join([*long, *wide, *words, *large])


def numbers_of(sentence: str) -> int:
    """Numbers of a sentence; a formula, and a size such as 64 x 64, count at most once."""
    formula = r"\([^()]*,[^()]*\)|[\w()]+ ?[=/] ?[^,;:]*|\d+ x \d+"
    return len(re.findall(r"(?<![\w.-])\d[\d,.]*", re.sub(formula, "X", sentence)))


def messages(path: Path) -> list[str]:
    """What the program says: each string of a module but its docstrings, or the text of a page's source."""
    text = path.read_text()
    if path.suffix == ".py":
        tree = ast.parse(text)
        unsaid = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        result: list[str] = []
        for node in ast.walk(tree):
            if id(node) not in unsaid and isinstance(node, (ast.JoinedStr, ast.BinOp, ast.Constant)):
                unsaid.update(map(id, ast.walk(node)))
                result.append(message(node))
        return result
    if path.suffix == ".js":
        return re.findall(r"[\"`]((?:[^\"`\n])*)[\"`]", text)
    text = re.sub(r"<(?:style|script|pre)\b.*?</(?:style|script|pre)>", "", text, flags=re.DOTALL)
    quoted = re.findall(r'"([^"]*)"', " ".join(re.findall(r"\{[{%].*?[}%]\}|<[^>]+>", text, re.DOTALL)))
    plain = re.sub(r"\{%.*?%\}", "\n\n", re.sub(r"\{\{.*?\}\}", "X", text), flags=re.DOTALL)
    return [*quoted, *re.split(r"</?(?!b>|/?strong|/?code|/?em|/?a\b|span)[^>]*>|\n\s*\n", plain)]


def message(node: ast.AST) -> str:
    """The text of a string, with X for each value in it."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else "X"
    parts = [node.left, node.right] if isinstance(node, ast.BinOp) else getattr(node, "values", ())
    return "".join(map(message, parts)) if parts else "X"


def docstrings(path: Path) -> Iterator[str]:
    """Docstrings of a module and of all in it; an argument and a row of a list are texts of their own."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            text = inspect.cleandoc(str(node.value.value))
            yield re.sub(r"^(?=.*\S {2,}\S)|^ +[\w*, ]+: ", "\n\n", text, flags=re.MULTILINE)


@pytest.mark.parametrize("path", sorted((ROOT / "src/derender").iterdir()), ids=named)
def test_messages_and_docstrings_of_the_program_are_plain(path):
    """Errors, notices, help, pages of reports and of the viewer; and what the code says of itself."""
    result = path.rglob("*") if path.is_dir() else [path]
    files = [one for one in result if one.suffix in (".py", ".html", ".js")]
    result = [(file, one) for file in files for text in messages(file) for one in unclear(text)]
    for file in files:
        texts = docstrings(file) if file.suffix == ".py" else ()
        result += [(file, one) for text in texts for one in sentences(text) if too_hard(one)]
    assert not result, "\n".join(f"{named(file)}: {one}" for file, one in result)


def unclear(text: str) -> list[str]:
    """Sentences of a text that are too long or hold a banned word."""
    text = re.sub(r"[\w/]+(?:\.\w+)+", "code", text)
    result = sentences(text) if " " in text and "{" not in text and "#version" not in text else []
    return [one for one in result if too_hard(one)]


def too_hard(sentence: str) -> bool:
    return len(words_of(sentence)) > LONGEST_SENTENCE or BANNED.search(sentence) is not None


def words_of(sentence: str) -> list[str]:
    return re.findall(r"[\w'-]+", sentence)


def test_a_long_sentence_is_seen(tmp_path):
    long = "word " * 30
    assert max(len(one.split()) for one in sentences(f"One two. {long}.\n\n| " + "cell " * 40)) == 31
    shown = {
        "a.py": f'"""{long}"""\nraise ValueError(f"{long} {{x}}" + "ends")\n',
        "a.html": f'{{% call b.figure("{long}") %}}<p>nobody <b>sees</b> it</p><script>{long}</script>',
        "a.js": f"const text = `{long}`;",
    }
    for name, count in {"a.py": 1, "a.html": 2, "a.js": 1}.items():
        (tmp_path / name).write_text(shown[name])
        assert len([one for text in messages(tmp_path / name) for one in unclear(text)]) == count
    assert numbers_of("From 1 to 2 in 3.") == 3 and HEADLESS.search("It does what it can.")
    assert [too_hard(one) for text in docstrings(tmp_path / "a.py") for one in sentences(text)] == [True]


def test_the_readme_is_short_and_its_python_runs(capsys, tmp_path, monkeypatch):
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150 and max(map(len, text.splitlines())) <= LONGEST_LINE
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(re.findall(r"^(?!import|from)\w", block, re.MULTILINE)) == 5
    names = {"__name__": "readme"}
    monkeypatch.chdir(tmp_path)
    exec(compile(smaller(block), "README.md", "exec"), names)
    assert len(names["features"]) == 4
    assert all((tmp_path / name).exists() for name in ("relit.png", "turned.png"))


@pytest.mark.parametrize("path", [one for one in PAGES if "tutorials" not in one.parts], ids=named)
def test_python_blocks_compile(path):
    for block in re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "derender":
                assert follow(f"derender.{node.attr}"), node.attr
            if isinstance(node, ast.Call) and re.match(r"(derender\.)?evaluate\.", ast.unparse(node.func)):
                called = getattr(importlib.import_module("derender.evaluation"), node.func.attr)
                inspect.signature(called).bind(*node.args, **{word.arg: word.value for word in node.keywords})


def test_conventions_name_their_tests():
    rules = re.split(r"^### ", (DOCS / "reference" / "conventions.md").read_text(), flags=re.MULTILINE)[1:]
    assert len(rules) >= 10
    assert not [rule.splitlines()[0] for rule in rules if not re.search(r"`tests/[\w/]+\.py::\w+`", rule)]


SMALLER = (  # sooner, with the same words, but for none of few images that are unlike the others
    ("generate(1, 512", "generate(1, 160"), ("yaw_deg=60)", "yaw_deg=60, fit_steps=1)"),
    ("generate(1, 384", "generate(1, 128"), ("yaw_deg=15)", "yaw_deg=15, fit_steps=1)"),
    ("generate(8, 64", "generate(1, 64"), ("generate(160", "generate(40"), ("--count 200", "--count 120"),
    ("--preset small", "--preset small --set image_size=32 --set width=8 --set light_width=8"),
    ("images=64", "images=96"),
    ("Under 1 % of the images are unlike the others (± under 1 %)", "No image is unlike the others"),
)  # fmt: skip


def smaller(text: str) -> str:
    """The steps of a page with less to do."""
    return reduce(lambda done, pair: done.replace(*pair), SMALLER, text)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", pages.TUTORIALS)
def test_a_tutorial_runs_and_prints_what_it_shows(name):
    """Words and layout must be the page's; measured numbers may differ between machines."""
    text = smaller((DOCS / "tutorials" / f"{name}.md").read_text())
    done, made = pages.run_tutorial(text)
    assert measured(done) == measured(text)
    assert set(re.findall(r"\(\.\./images/tutorials/([\w-]+\.png)\)", text)) <= made.keys()


def measured(text: str) -> str:
    alike = re.sub(r" +", " ", re.sub(r"[-+]?\d+(?:\.\d+)?", "#", text))
    return alike.replace("majority yes", "chance yes")  # both have an adjusted Rand index of about 0


@pytest.mark.filterwarnings("ignore")  # of Python; Sphinx counts its own
def test_the_site_builds_without_a_warning(tmp_path, capsys):
    for name in ("sphinx.cmd.build", "myst_parser", "furo"):
        pytest.importorskip(name, reason="the site needs the dependency group docs: pip install --group docs")
    words = ["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(tmp_path)]
    assert sys.modules["sphinx.cmd.build"].main(words) == 0, capsys.readouterr().err[-3000:]
    assert "derender evaluate cluster" in (tmp_path / "reference" / "commands.html").read_text()
    assert "template_share" in (tmp_path / "reference" / "settings.html").read_text()
