"""The house's import rule (pyproject.toml, importlinter) holds."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_imports_follow_the_layers():
    # In a process of its own: within this one it would disable the loggers of all tests that follow.
    command = Path(sys.executable).with_name("lint-imports"), "--no-cache"
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Contracts: 2 kept, 0 broken" in done.stdout


def test_every_folder_is_under_the_rule():
    packages = {path.parent.name for path in ROOT.glob("*/py.typed")}
    rule = (ROOT / "pyproject.toml").read_text(encoding="utf-8").split("root_packages = ")[1].splitlines()[0]
    assert packages == {name.split(".")[1].strip('"') for name in rule.strip("[]").split(", ")}
