"""The package ``mirrorskin``: this folder, the packages in it, and the packages in these."""

import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

_HERE = Path(__file__).parent
_DEVELOPMENT = {"bench", "evaluation"}  # packages of a checkout, which are not installed
_HOME = tomllib.loads((_HERE / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mirrorskin"]["home"]
_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)")


class BuildModules(build_py):
    """Leaves this file out, which is in the folder of the package ``mirrorskin``."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Return the modules of a package as (package, module, file)."""
        modules = super().find_package_modules(package, package_dir)
        return [module for module in modules if module[1] != "setup"]


def long_description() -> str:
    """Return README.md with links and pictures that work outside of the repository."""

    def absolute(link: re.Match[str]) -> str:
        picture, words, path = link.groups()
        return f"{picture}[{words}]({_HOME}/{'raw' if picture else 'blob'}/main/{path})"

    return _LINK.sub(absolute, (_HERE / "README.md").read_text(encoding="utf-8"))


folders = {path.parent.name for path in _HERE.glob("*/__init__.py")} - _DEVELOPMENT
packages = find_packages(include=[*folders, *(f"{folder}.*" for folder in folders)])
setup(
    long_description=long_description(),
    long_description_content_type="text/markdown",
    project_urls={
        "Homepage": _HOME,
        "Documentation": f"{_HOME}/blob/main/docs/index.md",
        "Changelog": f"{_HOME}/blob/main/CHANGELOG.md",
        "Issues": f"{_HOME}/issues",
    },
    packages=["mirrorskin", *(f"mirrorskin.{name}" for name in packages)],
    package_dir={"mirrorskin": "."},
    cmdclass={"build_py": BuildModules},
)
