"""The package ``mirrorskin``: this folder, the packages in it, and the packages in these."""

from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py


class BuildModules(build_py):
    """Leaves this file out, which is in the folder of the package ``mirrorskin``."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Return the modules of a package as (package, module, file)."""
        modules = super().find_package_modules(package, package_dir)
        return [module for module in modules if module[1] != "setup"]


folders = [path.parent.name for path in Path(__file__).parent.glob("*/__init__.py")]
packages = find_packages(include=[*folders, *(f"{folder}.*" for folder in folders)])
setup(
    packages=["mirrorskin", *(f"mirrorskin.{name}" for name in packages)],
    package_dir={"mirrorskin": "."},
    cmdclass={"build_py": BuildModules},
)
