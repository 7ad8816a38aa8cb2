r"""Formulas: LaTeX between dollars becomes MathML, which browsers draw without any script.

``pymdownx.arithmatex`` finds them in the Markdown and leaves them as ``\(...\)`` and ``\[...\]``.
"""

from __future__ import annotations

import html
import re
from itertools import pairwise
from xml.etree.ElementTree import Element, tostring

from latex2mathml.converter import convert_to_element
from mkdocs.exceptions import PluginError

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
# latex2mathml lacks arg, and takes no digits in names.
_NAME = re.compile(r"\\operatorname\{(\w+)\}|\\(arg)(?![a-zA-Z])")
_UNKNOWN = re.compile(r">\s*(\\[A-Za-z]+)")  # what it does not know it leaves as it is
_PRIMES = {"\N{PRIME}", "\N{DOUBLE PRIME}"}
_SIGNS = {"\N{MINUS SIGN}", "+", "\N{PLUS-MINUS SIGN}"}
_CLOSING = {")", "]", "}", "|", "!"}
_TIGHT = {"/", "|", "\N{DOUBLE VERTICAL LINE}"}
_THIN = "0.167em"


def with_formulas(page: str, name: str) -> str:
    """Return a page of HTML with its formulas as MathML.

    Parameters
    ----------
    page : str
    name : str
        What messages call it.

    Raises
    ------
    mkdocs.exceptions.PluginError
        A formula is no LaTeX that can be translated.
    """
    page = _BLOCK.sub(lambda match: f'<div class="formula">{_mathml(match[1], "block", name)}</div>', page)
    return _INLINE.sub(lambda match: _mathml(match[1], "inline", name), page)


def _mathml(quoted: str, display: str, name: str) -> str:
    latex = html.unescape(quoted).strip()
    try:
        named = _NAME.sub(lambda match: f"\\text{{{match[1] or match[2]}}}", latex)
        formula = convert_to_element(named, display=display)
    except Exception as error:  # latex2mathml raises many kinds
        raise PluginError(f"{name}: {latex}: {type(error).__name__} {error}") from error
    parts = list(formula.iter())
    for part in parts:
        part.text = html.unescape(part.text or "")
        if part.tag == "mo" and len(part.text) > 1 and part.text.isalpha():
            part.tag = "mi"  # min and max, which are names as cos is
    for part in parts:
        _draw_bar(part)
        _lower_prime(part)
        _bind_signs(part)
        _set_apart(part)
    markup = tostring(formula, encoding="unicode")
    unknown = _UNKNOWN.search(markup)
    if unknown:
        raise PluginError(f"{name}: {latex}: {unknown[1]} cannot be translated")
    return markup


def _draw_bar(part: Element) -> None:
    """Draw a line over all that it is over: as a sign it is as short as the font has it."""
    if part.tag == "mover" and part[-1].text == "\N{HORIZONTAL BAR}":
        part.tag = "mrow"
        part.remove(part[-1])
        part.set("style", "border-top: 0.06em solid; padding-top: 0.1em")


def _lower_prime(part: Element) -> None:
    """Place a prime next to its letter: the sign is high already, and an exponent would raise it again."""
    if part.tag == "msup" and part[-1].text in _PRIMES:
        part.tag = "mrow"


def _bind_signs(part: Element) -> None:
    """Leave out spaces that TeX does not have: round bars, and behind a sign that belongs to what follows."""
    for element in part:
        if element.tag == "mo" and element.text in _TIGHT:
            element.attrib |= {"lspace": "0", "rspace": "0"}
    for left, right in pairwise(part):
        if left.tag == right.tag == "mo" and right.text in _SIGNS and left.text not in _CLOSING:
            right.set("form", "prefix")


def _set_apart(part: Element) -> None:
    """Put thin spaces round the names of functions, as TeX does."""
    if part.tag not in ("mrow", "mtd", "math"):
        return
    gaps = [
        at
        for at, (left, right) in enumerate(pairwise(list(part)), 1)
        if (_is_function(left) or _is_function(right)) and "mo" not in (left.tag, right.tag)
    ]
    for at in reversed(gaps):
        part.insert(at, Element("mspace", width=_THIN))


def _is_function(part: Element) -> bool:
    """Tell whether it is a name such as cos, or one with an index or exponent."""
    if part.tag in ("msup", "msub", "msubsup"):
        return _is_function(part[0])
    return part.tag in ("mi", "mtext") and len(part.text or "") > 1 and (part.text or "").isalnum()
