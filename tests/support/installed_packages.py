"""Packages with entry points, as if they were installed."""

from __future__ import annotations

from pathlib import Path


def install(folder: Path, group: str, **names: str) -> None:
    """Write the entry points of an installed package, in a group, to a folder of ``sys.path``."""
    facts = folder / "package_of_a_test-1.0.dist-info"
    facts.mkdir(parents=True, exist_ok=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: package-of-a-test\nVersion: 1.0\n")
    points = "".join(f"{name} = {place}\n" for name, place in names.items())
    (facts / "entry_points.txt").write_text(f"[{group}]\n{points}")
