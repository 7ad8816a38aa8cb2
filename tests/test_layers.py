"""The house's import rule (pyproject.toml, importlinter) holds."""

from pathlib import Path

from importlinter.cli import lint_imports

ROOT = Path(__file__).parent.parent


def test_imports_follow_the_layers(capsys):
    failed = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert not failed, capsys.readouterr().out


def test_every_folder_is_under_the_rule():
    packages = {path.parent.name for path in ROOT.glob("*/py.typed")}
    rule = (ROOT / "pyproject.toml").read_text(encoding="utf-8").split("root_packages = ")[1].splitlines()[0]
    assert packages == {name.split(".")[1].strip('"') for name in rule.strip("[]").split(", ")}
