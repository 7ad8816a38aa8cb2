"""The packages of the namespace ``mirrorskin``: the top folders that have types, and the folders in them."""

from pathlib import Path

from setuptools import find_packages, setup

folders = [path.parent.name for path in Path(__file__).parent.glob("*/py.typed")]
packages = find_packages(include=[*folders, *(f"{folder}.*" for folder in folders)])
setup(packages=[f"mirrorskin.{name}" for name in packages], package_dir={"mirrorskin": "."})
