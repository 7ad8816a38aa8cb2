"""Only the run loop pushes frames into operations, and takes results and steps; see docs/architecture.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LOOP = "engine/base/running.py"
CALLS = {"push", "result", "finish", "next_pass", "start_second_pass", "after_last_frame", "apply"}
NAMES = {"operation", "step", "configured", "kind"}  # of operations, steps and their classes, in any module
COPIES = {"with_options", "configured_for", "copy_for_run"}  # methods that return an operation
BASES = {"Operation", "Step"}


RELEVANT = re.compile(rf"^class \w+\(|\.({'|'.join(CALLS)})\(", re.MULTILINE)  # others need no parsing


def modules() -> dict[str, ast.Module]:
    """Return the modules that derive a class, or call a method that may be that of an operation or a step."""
    packages = [path.parent for path in ROOT.glob("*/__init__.py")]
    files = [file for package in packages for file in package.rglob("*.py")]
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    return {name: ast.parse(text) for name, text in texts.items() if RELEVANT.search(text)}


def last_name(node: ast.expr) -> str:
    """Return the name of a variable or an attribute, without leading underscores."""
    name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    return name.lstrip("_")


@cache
def nodes_of(tree: ast.Module) -> list[ast.AST]:
    """Return all nodes of a module."""
    return [*ast.walk(tree)]


def classes_of(trees: list[ast.Module]) -> set[str]:
    """Return the names of all classes that are derived from operations or steps."""
    names = set(BASES)
    defined = [node for tree in trees for node in nodes_of(tree) if isinstance(node, ast.ClassDef)]
    while more := {node.name for node in defined if names & {*map(last_name, node.bases)}} - names:
        names |= more
    return {name.lstrip("_") for name in names}


class Calls(ast.NodeVisitor):
    """Lines on which a module calls operations or steps that are not part of another operation."""

    def __init__(self, tree: ast.Module, classes: set[str]) -> None:
        self.lines: list[int] = []
        self._classes, self._inside = classes, False  # of a class of operations or steps
        self._names = NAMES | {name for node in nodes_of(tree) for name in self._assigned(node)}
        self.visit(tree)

    def _makes(self, node: ast.expr | None) -> bool:
        """Return whether an expression makes an operation or a step."""
        if not isinstance(node, ast.Call):
            return False
        return last_name(node.func) in self._classes | NAMES | COPIES

    def _assigned(self, node: ast.AST) -> Iterator[str]:
        """Yield the names that are assigned, or annotated as, an operation or a step."""
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            if {last_name(part) for part in ast.walk(node.annotation)} & BASES:  # type: ignore[arg-type]
                yield node.arg.lstrip("_") if isinstance(node, ast.arg) else last_name(node.target)
        elif isinstance(node, ast.Assign) and self._makes(node.value):
            yield from map(last_name, node.targets)
        elif isinstance(node, ast.NamedExpr) and self._makes(node.value):
            yield last_name(node.target)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        before, self._inside = self._inside, node.name.lstrip("_") in self._classes
        self.generic_visit(node)
        self._inside = before

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        if not isinstance(node.func, ast.Attribute) or node.func.attr not in CALLS:
            return
        receiver = node.func.value
        if last_name(receiver) == "step" and node.func.attr != "apply":  # a future or a distance
            return
        is_part = self._inside and isinstance(receiver, ast.Attribute)  # self._fit.push
        if not is_part and (self._makes(receiver) or last_name(receiver) in self._names - {"", "self"}):
            self.lines.append(node.lineno)


def calls_in(text: str) -> list[int]:
    tree = ast.parse(text)
    return Calls(tree, classes_of([tree]) | {"Onset"}).lines


@pytest.mark.parametrize(
    "text",
    [
        "operation.push(frames)",
        "self._operation.result()",
        "plan.operation.result()",
        "kind(**options).push(frames)",
        "Onset(dark=0).push(frames)",
        "search = Onset()\nsearch.push(frames)",
        "turns = operation.with_options(per_turn=False)\nturns.result()",
        "def run(one: Operation, frames): one.push(frames)",
        "def run(ones: list[Step], maps):\n for step in ones: step.apply(maps)",
        "class Live:\n def push(self, frames): self.operation.push(frames)",
    ],
)
def test_a_call_of_an_operation_or_a_step_is_found(text):
    assert len(calls_in(text)) == 1


@pytest.mark.parametrize(
    "text",
    [
        "run = Run(operation)\nrun.push(frames)\nrun.result()",
        "future.result()",
        "step.result()",
        "device.finish()",
        "pose.apply(points)",
        "class Own(Onset):\n def result(self): return super().result()",
        "class Own(Operation):\n def push(self, frames): self._part.push(frames)",
    ],
)
def test_other_calls_are_not_found(text):
    assert calls_in(text) == []


def test_only_the_run_loop_calls_operations_and_steps():
    trees = modules()
    classes = classes_of([*trees.values()])
    assert LOOP in trees
    lines_by_file = {name: Calls(tree, classes).lines for name, tree in trees.items() if name != LOOP}
    assert {name: lines for name, lines in lines_by_file.items() if lines} == {}
