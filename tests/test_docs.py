"""Commands in the documentation are valid: all are parsed; test_blocks.py runs many of them."""

import pkgutil
import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest
import yaml

from mirrorskin.cli import groups
from mirrorskin.cli.main import app

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def blocks_of(page, language):
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def commands_of(page):
    """Return the words of each mirrorskin command in a page's shell blocks."""
    lines = "".join(blocks_of(page, "sh")).replace("\\\n", " ").splitlines()
    split = [shlex.split(line, comments=True) for line in lines]
    return [words[1:] for words in split if words[:1] == ["mirrorskin"]]


WRITTEN = [(page.name, words) for page in PAGES for words in commands_of(page)]
# Where a message is put together, or a value is filled in, it cannot be found as a whole.
FILLED_IN = re.compile(
    r"\.\.\.|[:;,] |[()'\"]| of mean|horizontal|PoCL|pyopencl|NAME.cl|/dev/videoN|[A-Z]+_[A-Z_]+|\b[NM]\b|\d+"
)
COMMAND = app
NAMING = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
FOLDERS = (
    "bench",
    "cli",
    "docs",
    "engine",
    "evaluation",
    "examples",
    "hw",
    "io",
    "kernels",
    "tests",
    "twin",
    "view",
)
SOURCES = [
    "/setup.py",
    *(f"/{path.relative_to(ROOT)}" for name in FOLDERS for path in (ROOT / name).rglob("*.*")),
]
OTHER_OPTIONS = {  # of developers' scripts, of other programs, and of a user's operation
    *("--freeze", "--only", "--gpus", "--group-add", "--list-formats-ext", "--memory-limit"),
    *("--no-deps", "--now", "--lean", "--travel-offset", "--false-alarms"),
}
CLASSES = ("light.py", "first_light.py")  # of the page about operations, the first block and the last


def test_there_are_commands():
    assert len(WRITTEN) >= 40


@pytest.mark.parametrize(("page", "words"), WRITTEN, ids=[f"{page}: {' '.join(w)}" for page, w in WRITTEN])
def test_a_command_of_the_documentation_is_understood(page, words, monkeypatch, tmp_path):
    monkeypatch.setattr(groups.ExistingPath, "convert", click.Path.convert)  # files need not be there
    monkeypatch.chdir(tmp_path)
    first, *_, last = blocks_of(DOCS / "operations.md", "python")
    for name, code in zip(CLASSES, (first, last), strict=True):
        Path(name).write_text(code, encoding="utf-8")
    understood(words)


def test_messages_in_troubleshooting_are_those_of_the_program():
    folders = ("cli", "engine", "hw", "io", "kernels", "twin", "view")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    source = "".join(file.read_text(encoding="utf-8") for file in files)
    joined = re.sub(r"""["']\s*\n\s*f?["']""", "", source)
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^ *> (.*)$", page, re.MULTILINE)
    assert len(messages) > 60
    parts = [part.strip() for line in messages for part in FILLED_IN.split(line)]
    assert [part for part in parts if len(part) > 8 and part not in joined] == []


@pytest.mark.parametrize("page", [*sorted(ROOT.glob("*.md")), *PAGES], ids=lambda page: page.name)
def test_every_table_of_a_page_is_one(page):
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for block in text.split("\n\n"):
        lines = [line.strip() for line in block.strip("\n").splitlines()]
        rows = [line for line in lines if line.startswith("|")]
        if rows:
            assert lines[-len(rows) :] == rows, f"a table stands between blank lines: {lines[0]}"
            assert re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", rows[1] if rows[1:] else ""), f"no head: {rows[0]}"
            assert len({cells_of(row) for row in rows}) == 1, f"rows differ in length: {rows[0]}"


LONGEST = 100  # columns
WRAPPED = [
    *sorted(ROOT.glob("*.md")),
    *PAGES,
    *sorted((ROOT / "tests").rglob("*.md")),
    *sorted((ROOT / "bench").glob("*.md")),
]
WHOLE = ("|", "#", ">", "$$", "![")  # starts of a table, a heading, a message, a formula and a picture


@pytest.mark.parametrize("page", WRAPPED, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_lines_of_a_page_are_short(page):
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    long = [line for line in text.splitlines() if len(line) > LONGEST and not line.lstrip().startswith(WHOLE)]
    assert [line for line in long if " " in re.sub(r"`[^`]*`", "", line.strip().removeprefix("- "))] == []


def test_terms_of_the_glossary_are_in_alphabetical_order():
    page = (DOCS / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^- \*\*([^*]+)\*\*", page, re.MULTILINE)
    assert len(terms) > 80
    assert terms == sorted(terms)


def test_a_command_that_is_none_is_not_understood():
    with pytest.raises(Exception, match="such"):
        understood(["reconstruct", "press.h5", "--travel-stop", "1mm"])


def cells_of(row):
    """Count the cells of a table's row; a bar within code or a formula separates none."""
    return re.sub(r"`[^`]*`|\$[^$]*\$", "", row).replace(r"\|", "").count("|") - 1


def understood(words):
    """Parse a command as the command line does, and do nothing."""
    command, above = COMMAND, None
    words = [word for word in words if word != "&"]
    while True:
        context = command.make_context(command.name, list(words), parent=above)
        if not hasattr(command, "resolve_command"):
            return
        rest = [*getattr(context, "_protected_args", []), *context.args]
        if not rest and command.invoke_without_command:
            return
        _, command, words = command.resolve_command(context, rest)
        above = context


def named_in(page):
    """Return what a page names as code outside of blocks."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return set(re.findall(r"`([^`\n]+)`", text))


def options_of(command, above=None):
    """Return the options of a command and of all commands in it."""
    context = click.Context(command, parent=above)
    names = {
        name
        for parameter in command.get_params(context)
        for name in (*parameter.opts, *parameter.secondary_opts)
    }
    inner = command.list_commands(context) if hasattr(command, "list_commands") else ()
    return names.union(*(options_of(command.get_command(context, name), context) for name in inner))


@pytest.mark.parametrize("page", NAMING, ids=lambda page: page.name)
def test_options_that_a_page_names_exist(page):
    named = {word for text in named_in(page) for word in re.findall(r"(?<![\w-])--[a-z][a-z\d-]+", text)}
    assert named <= options_of(COMMAND) | OTHER_OPTIONS


@pytest.mark.parametrize("page", NAMING, ids=lambda page: page.name)
def test_source_files_that_a_page_names_exist(page):
    named = {text for text in named_in(page) if re.fullmatch(r"[\w/.-]+\.(py|cl|clh)", text)}
    named = {name for name in named if Path(name).stem not in ("FILE", "NAME", "mine", "lab")}  # the user's
    assert {name for name in named if not any(path.endswith(f"/{name}") for path in SOURCES)} == set()


@pytest.mark.parametrize("page", NAMING, ids=lambda page: page.name)
def test_python_names_of_a_page_exist(page):
    pattern = r"((?:mirrorskin\.)?(?:engine|hw|io|kernels|twin|view)\.[\w.]+)(?:\(.*\))?"
    for name in (match[1] for text in named_in(page) if (match := re.fullmatch(pattern, text))):
        pkgutil.resolve_name("mirrorskin." + name.removeprefix("mirrorskin."))


def test_every_kind_of_finding_is_explained():
    """Warnings and notes about frames and results are in one table of the documentation."""
    sources = [path for folder in ("io", "engine") for path in (ROOT / folder).rglob("*.py")]
    kinds = {kind for path in sources for kind in re.findall(r'\bFinding\(\s*"([^"]+)"', path.read_text())}
    page = (DOCS / "troubleshooting.md").read_text()
    assert len(kinds) > 20
    assert {kind for kind in kinds if f"`{kind}`" not in page} == set()


def test_the_hook_and_the_environment_have_the_same_minor_version_of_ruff():
    hook = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"][0]["rev"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    minor = int(re.fullmatch(r"v0\.(\d+)\.\d+", hook)[1])
    assert f"ruff>=0.{minor},<0.{minor + 1}" in project["optional-dependencies"]["dev"]


def test_phrases_that_contributing_asks_to_avoid_are_not_used():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"][-1][
        "hooks"
    ]
    phrase, files, without = (re.compile(hooks[0][key]) for key in ("entry", "files", "exclude"))
    phrase = re.compile(phrase.pattern, re.IGNORECASE)
    folders = ("cli", "docs", "engine", "hw", "io", "kernels", "twin", "view")
    paths = [ROOT / "README.md", *(path for name in folders for path in (ROOT / name).rglob("*.*"))]
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    checked = [name for name in names if files.search(name) and not without.search(name)]
    offenders = [name for name in checked if phrase.search((ROOT / name).read_text(encoding="utf-8"))]
    assert len(checked) > 100
    assert offenders == []
